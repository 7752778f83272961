"""Files that appear whole or not at all, whatever interrupts their writing."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """A file to write bytes to, which gets its name once everything is on disk; until then the one that was there stays.

    Folders are made. What a killed process leaves is hidden and called `.….part`. Raises `OSError` where it cannot be written."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with part.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # a name that survives a power failure while its bytes do not would look like a result
        os.replace(part, target)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_whole(path: str | os.PathLike[str], content: str | bytes) -> None:
    """A text (in UTF-8) or bytes as a `whole_file`."""
    with whole_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def write_figure(path: Path, figure: Figure) -> None:
    """A picture as a `whole_file`, of the kind that its name ends in."""
    with whole_file(path) as file:
        figure.savefig(file, format=path.suffix.removeprefix("."))
