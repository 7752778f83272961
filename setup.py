"""Builds the native core with the C++ compiler that is there. Everything else of the installation is in pyproject.toml.

The core, pbfd_torch/native/src, is two translation units, compiled once per kind of processor into plain shared objects, which
Python loads by ctypes: they know nothing of Python and torch. Where that fails the installation goes on without them, and a file
keeps the reason.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import platform
import runpy
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext
from setuptools.errors import CompileError

SOURCES = Path("pbfd_torch/native/src")
LIBRARIES = Path("pbfd_torch/native/lib")

# What one variant is called, and the flags that make it.
X86 = {f"x86-64-{level}": [f"-march=x86-64-{level}"] for level in ("v2", "v3", "v4")}
ARM = {"arm64": []}  # every 64-bit ARM has NEON
VARIANTS = {"x86_64": X86, "AMD64": X86, "arm64": ARM, "aarch64": ARM}

# The compiler fuses no products and sums by itself: the sources say where, so that one lane rounds as eight do.
# Worlds side by side fill the registers: vectors that a compiler makes of loops over a few joints only cost time.
FLAGS = [
    *("-std=c++17", "-O3", "-fno-tree-vectorize", "-ftree-slp-vectorize", "-fno-math-errno", "-ffp-contract=off"),
    *("-fno-exceptions", "-fno-rtti", "-Wall", "-Wextra"),
    *("-fPIC", "-fvisibility=hidden", "-fvisibility-inlines-hidden"),
    # GCC's bound on the growth of one translation unit would keep small functions out of line in the loops; Clang has none
    *("--param=inline-unit-growth=300", "-Wno-unused-command-line-argument"),
    "-Wno-bitwise-instead-of-logical",  # of Clang's: the mask of one world is a bool
]

# How the objects are linked: what is not the interface stays inside.
LINK = ["-shared", *([f"-Wl,--version-script={SOURCES / 'exports.map'}"] if sys.platform == "linux" else [])]

# Which variants, by name; else all of them in a wheel, and the one that this processor loads in an editable installation.
TARGETS = os.environ.get("PBFD_NATIVE_TARGETS", "")

# For continuous integration: warnings are errors, and errors stop the installation.
STRICT = os.environ.get("PBFD_NATIVE_STRICT", "") not in ("", "0")

# A folder that keeps what has been compiled: of the same sources by the same command it is taken from there.
CACHE = os.environ.get("PBFD_NATIVE_CACHE", "")


def compiler() -> list[str]:
    """The command that compiles C++, `CXX` or one that is found; empty where there is none."""
    named = shlex.split(os.environ.get("CXX", ""))
    return named or [name for name in ("c++", "g++", "clang++") if shutil.which(name)][:1]


def compiled(file: Path, flags: list[str]) -> str:
    """Compiles one variant of the core into `file`; what the compiler said against it, or nothing."""
    given = shlex.split(os.environ.get("CXXFLAGS", "")), shlex.split(os.environ.get("LDFLAGS", ""))
    strict = ["-Werror"] if STRICT else []
    command = [*compiler(), *FLAGS, *flags, *strict, *given[0]]
    kept = Path(CACHE, digest([*command, *LINK, *given[1]]) + ".so") if CACHE else None
    if kept is not None and kept.exists():
        shutil.copy(kept, file)
        return ""
    with tempfile.TemporaryDirectory() as room, ThreadPoolExecutor() as threads:
        objects = {unit: str(Path(room, unit.stem + ".o")) for unit in sorted(SOURCES.glob("*.cpp"))}
        said = list(threads.map(lambda unit: run([*command, "-c", str(unit), "-o", objects[unit]]), objects))
        failure = next(filter(None, said), "") or run([*command, *LINK, *objects.values(), *given[1], "-o", str(file)])
    if not failure and kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, kept)
    return failure


def run(command: list[str]) -> str:
    """Runs it; what it said against it, or nothing."""
    try:
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        return f"{command[0]}: {error.strerror}"
    return "" if ran.returncode == 0 else f"{command[0]} failed: {ran.stderr.strip() or f'exit status {ran.returncode}'}"


def runnable() -> list[str]:
    """The variants that this processor runs, the best one first, as the installed package finds them."""
    return list(runpy.run_path("pbfd_torch/native/processor.py")["runnable"]())


def digest(command: list[str]) -> str:
    """Of a command, its compiler and all sources."""
    found = hashlib.sha256(shlex.join(command).encode())
    with contextlib.suppress(OSError):  # it is going to be said when it compiles
        found.update(subprocess.run([*compiler(), "--version"], capture_output=True, check=False).stdout)
    for source in sorted(SOURCES.iterdir()):
        found.update(source.name.encode() + source.read_bytes())
    return found.hexdigest()


class BuildNative(build_ext):
    """Compiles all variants at once, into the build folder or, for an editable installation, into the checkout."""

    def run(self) -> None:
        folder = self.folder()
        shutil.rmtree(folder, ignore_errors=True)  # variants of an earlier build may be of other sources
        folder.mkdir(parents=True)
        if reason := self.build(folder):
            if STRICT:
                raise CompileError(reason)
            (folder / "none.txt").write_text(reason + "\n", encoding="utf-8")
            self.warn(f"{reason}. The installation goes on without the native core.")

    def build(self, folder: Path) -> str:
        """Compiles what can be compiled; the reason where that is nothing, or not everything and it must be."""
        machine = platform.machine()
        if machine not in VARIANTS:
            return f"pbfd_torch has no native core for the processor {machine}"
        if not compiler():
            return "no C++ compiler was found when pbfd_torch was installed"
        variants = VARIANTS[machine]
        targets = TARGETS.split(",") if TARGETS else runnable()[:1] if self.inplace else list(variants)
        if unknown := [target for target in targets if target not in variants]:
            return f"PBFD_NATIVE_TARGETS names {', '.join(unknown)}: some of {', '.join(variants)} must be named"
        with ThreadPoolExecutor() as threads:
            failures = list(threads.map(lambda target: self.variant(folder, target, variants[target]), targets))
        failed = [failure for failure in failures if failure]
        if failed and (STRICT or len(failed) == len(failures)):
            lines = failed[0].splitlines()
            error = next((line for line in lines if "error" in line), lines[0])
            return f"the native core could not be compiled when pbfd_torch was installed: {error}"
        return ""

    def variant(self, folder: Path, target: str, flags: list[str]) -> str:
        start = time.perf_counter()
        failure = compiled(folder / f"pbfd-{target}.so", flags)
        took = f"{time.perf_counter() - start:.1f} s"
        self.announce(f"native core for {target}: {failure or took}", logging.WARNING if failure else logging.INFO)
        return failure

    def folder(self) -> Path:
        return LIBRARIES if self.inplace else Path(self.build_lib) / LIBRARIES

    def names(self) -> list[str]:
        return sorted(file.name for file in self.folder().glob("*"))

    def get_outputs(self) -> list[str]:
        return [str(Path(self.build_lib) / LIBRARIES / name) for name in self.names()]

    def get_output_mapping(self) -> dict[str, str]:
        """Where the files of a strict editable installation are in the checkout."""
        return dict(zip(self.get_outputs(), [str(LIBRARIES / name) for name in self.names()], strict=True)) if self.inplace else {}


class PlatformWheel(bdist_wheel):
    """A wheel for this platform and every Python."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


setup(
    cmdclass={"build_ext": BuildNative, "bdist_wheel": PlatformWheel},
    # That there is one makes the wheel one for a platform; how it is built is said above.
    ext_modules=[Extension("pbfd_torch.native.core", sorted(map(str, SOURCES.glob("*.cpp"))))],
)
