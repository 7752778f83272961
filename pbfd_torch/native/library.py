"""Finds the best variant of the compiled core that this processor runs and loads it, once, when it is first asked for."""

from __future__ import annotations

import ctypes
import os
import platform
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Lock

import torch

from pbfd_torch.errors import InputError
from pbfd_torch.native.processor import runnable

INTERFACE = 15  # the version of src/interface.h that this file knows
FOLDER = Path(__file__).parent / "lib"
CHOICE = "PBFD_NATIVE_TARGET"
REMEDY = "install g++ and run pip install again, with --force-reinstall --no-deps --no-cache-dir"


@dataclass(frozen=True)
class Library:
    """One loaded variant of the core: the kind of processor that it is for, and its C functions."""

    target: str
    functions: ctypes.CDLL

    def lanes(self, dtype: torch.dtype) -> int:
        """How many worlds one register holds."""
        return self.functions.pbfd_lanes(dtype.itemsize)


def library() -> Library | None:
    """The compiled core, loaded at the first call; None where there is none, and `reason` says why. The environment variable
    `PBFD_NATIVE_TARGET` chooses a variant; raises `InputError` for one that cannot run here."""
    found = _once()
    return found if isinstance(found, Library) else None


def reason() -> str:
    """Why there is no compiled core, and how to change that; empty where there is one."""
    found = _once()
    return found if isinstance(found, str) else ""


def built() -> dict[str, Path]:
    """The variants that the installation has made, and their files."""
    return {file.stem.removeprefix("pbfd-"): file for file in sorted(FOLDER.glob("pbfd-*.so"))}


def loaded(file: Path) -> Library | str:
    """The library in a file, or why it cannot be used."""
    try:
        functions = ctypes.CDLL(str(file))
    except OSError as error:
        return f"the native library cannot be loaded ({error}): {REMEDY}"
    if (version := functions.pbfd_interface()) != INTERFACE:
        return f"the native library has interface {version}, and this is pbfd_torch for interface {INTERFACE}: {REMEDY}"
    functions.pbfd_target.restype = ctypes.c_char_p
    for name in ("pbfd_whole_numbers", "pbfd_real_numbers", "pbfd_room"):
        getattr(functions, name).restype = ctypes.c_long
    return Library(functions.pbfd_target().decode(), functions)


_lock = Lock()


def _once() -> Library | str:
    with _lock:
        return _found()


@cache
def _found() -> Library | str:
    """The best variant, or why there is none."""
    here = runnable()
    if not here:
        return f"there is no native library for this processor ({platform.machine()})"
    files = built()
    if not files:
        note = FOLDER / "none.txt"  # written by setup.py
        why = note.read_text(encoding="utf-8").strip() if note.exists() else "the native library has not been built"
        return f"{why}: {REMEDY}"
    choices = [target for target in here if target in files]
    if not choices:
        return f"the native libraries that were built ({', '.join(files)}) do not run on this processor: {REMEDY}"
    chosen = os.environ.get(CHOICE) or choices[0]
    if chosen not in choices:
        raise InputError(f"{CHOICE} is '{chosen}': must be one of {', '.join(choices)}")
    return loaded(files[chosen])
