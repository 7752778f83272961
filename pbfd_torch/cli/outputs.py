"""Whether results can be written where the user wants them, asked before the work that makes them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from pbfd_torch.errors import InputError


def check_folder(folder: Path, files: Sequence[str] = ()) -> None:
    """Raises `InputError` where a folder, new or not, cannot hold these files."""
    if not _writable(folder) or any((folder / name).is_dir() for name in files):
        raise InputError(f"--out is '{folder}': must be a folder, new or not, that can be written to")


def check_file(option: str, path: Path, *endings: str) -> None:
    """Raises `InputError` where a file of that name cannot be written, or does not end as one of its kind does."""
    if path.suffix not in endings:
        raise InputError(f"{option} is '{path}': must end in {' or '.join(endings)}")
    if path.is_dir() or not _writable(path.parent):
        raise InputError(f"{option} is '{path}': cannot be written there")


def _writable(folder: Path) -> bool:
    try:
        while not folder.exists() and folder != folder.parent:
            folder = folder.parent
        return folder.is_dir() and os.access(folder, os.W_OK)
    except OSError:  # a name that is too long, say
        return False
