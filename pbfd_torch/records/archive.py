"""Arrays and a JSON text that says what they are, in one compressed .npz: written whole, read within bounds and without running
anything that the file brings along."""

from __future__ import annotations

import json
import math
import os
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbfd_torch import memory
from pbfd_torch.errors import InputError
from pbfd_torch.files import whole_file

# what numpy and zipfile raise on damaged files
UNREADABLE = (
    OSError, ValueError, LookupError, AttributeError, TypeError, EOFError, RuntimeError, RecursionError, MemoryError,
    ArithmeticError, NotImplementedError, zipfile.BadZipFile, zlib.error, SyntaxError, tokenize.TokenError,
)  # fmt: skip
_LARGEST = 2**63  # of integers in the text


def write(path: str | os.PathLike[str], meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raises `InputError` where the file cannot be written; then what was there stays."""
    try:
        with whole_file(path) as file:
            np.savez_compressed(file, meta=np.array(json.dumps(meta)), **arrays)  # type: ignore[arg-type]  # arrays only
    except OSError as error:
        raise InputError(f"cannot write '{path}': {error.strerror or error}") from error


def read(path: str | os.PathLike[str], form: str, names: Iterable[str]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The text, which must say that it has this format, and the named arrays. All its numbers are finite, and integers of 64 bits.

    Raises `FileNotFoundError`, and `InputError` for a file that is damaged, foreign, or that claims more than `memory.share()`."""
    try:
        found: Any = np.load(path, allow_pickle=False)
        if isinstance(found, np.ndarray):
            raise InputError("it is a single array")
        with found as file:
            size, most = sum(entry.file_size for entry in file.zip.infolist()), memory.share()
            if size > most:
                raise InputError(
                    f"it claims {memory.gibibytes(size)}: must be at most {memory.gibibytes(most)}, "
                    f"{memory.SHARE:.0%} of the memory that is available"
                )
            meta = _meta(str(file["meta"]))
            if meta.get("format") != form:
                raise InputError(f"it has format {meta.get('format')!r}: must be {form!r}")
            return meta, {name: file[name] for name in names}
    except (FileNotFoundError, InputError):
        raise
    except UNREADABLE as error:
        raise InputError(f"{type(error).__name__} {error}") from error


def _meta(text: str) -> dict[str, Any]:
    meta = json.loads(text, parse_float=_finite, parse_constant=_finite, parse_int=_integer)
    if not isinstance(meta, dict):
        raise InputError(f"its meta is a {type(meta).__name__}: must be an object")
    return meta


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise InputError(f"its meta holds {text[:40]}: must be finite")
    return value


def _integer(text: str) -> int:
    if len(text) > 20 or not -_LARGEST <= int(text) < _LARGEST:
        raise InputError(f"its meta holds {text[:40]}: must be from -2⁶³ to 2⁶³ - 1")
    return int(text)
