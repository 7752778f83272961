"""How loaders speak: errors that name the file, and lines on what is left out."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

from pbfd_torch.errors import InputError, ModelError, NotModelledWarning

T = TypeVar("T")


def existing_file(path: str | os.PathLike[str]) -> Path:
    """`path` as an existing, readable, non-empty file; raises `ModelError` saying which of these it is not."""
    file = Path(path)
    try:
        if file.is_dir():
            raise ModelError("is a directory: must be a file", file=str(file))
        if not file.is_file():
            raise ModelError("no such file", file=str(file))
        with file.open("rb") as stream:
            if not stream.read(1):
                raise ModelError("the file is empty", file=str(file))
    except OSError as error:
        raise ModelError(f"cannot be read: {error.strerror or error}", file=str(file)) from error
    return file


def first_bytes(file: Path, count: int) -> bytes:
    """At most so many."""
    with file.open("rb") as stream:
        return stream.read(count)


@contextmanager
def naming(file: str, element: str = "") -> Iterator[None]:
    """Adds the file, and where it is missing the element, to errors raised inside."""
    try:
        yield
    except ModelError as error:
        raise ModelError(error.reason, element=error.element or element, file=error.file or file) from error
    except InputError as error:
        raise ModelError(str(error), element=element, file=file) from error


def listing(names: Iterable[str], most: int = 5) -> str:
    """«a, b, c and 4 more»."""
    every = list(names)
    rest = len(every) - most
    return ", ".join(every) if rest <= 1 else f"{', '.join(every[:most])} and {rest} more"


def progress(items: Sequence[T], what: str) -> Iterable[T]:
    """The items, with a bar on a terminal once they have taken a second."""
    return tqdm(items, desc=what, delay=1.0, leave=False) if sys.stderr.isatty() else items


@contextmanager
def announced(what: str, count: int, slow_from: int) -> Iterator[None]:
    """Says on a terminal what is being done to so many, from as many on as take more than a second."""
    if count < slow_from or not sys.stderr.isatty():
        yield
        return
    with tqdm(total=count, desc=what, leave=False) as bar:
        yield
        bar.update(count)


def warn_not_modelled(file: Path, lines: Sequence[str]) -> tuple[str, ...]:
    """One `NotModelledWarning` a line, and the lines without repetitions. Python shows a warning of one text from one place
    once, so each file and feature is shown once in a process."""
    unique = tuple(dict.fromkeys(lines))
    for line in unique:
        warnings.warn(f"{file}: not modelled: {line}", NotModelledWarning, stacklevel=2)
    return unique
