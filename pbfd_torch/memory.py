"""How much memory there is for what somebody asks for or a file claims."""

from __future__ import annotations

import os
import re
from pathlib import Path

from pbfd_torch.errors import InputError

LEAST_OF_A_WORLD = 2**14  # bytes that a world of one free body takes at least while it is stepped
SHARE = 0.5  # of the memory that is available: what one request may take
_MEMINFO = Path("/proc/meminfo")
_GROUP = Path("/sys/fs/cgroup")  # of a container, which may have less than its machine
_UNKNOWN = 2**33  # [bytes], where no system call tells


def available() -> int:
    """Bytes that this process can still have without others being swapped out, as far as the system tells."""
    return max(0, min(_of_machine(), _of_container()))


def share() -> int:
    """Bytes that one request may take: half of what is available."""
    return int(SHARE * available())


def most_worlds() -> int:
    """How many of the smallest worlds have room in that."""
    return max(1, share() // LEAST_OF_A_WORLD)


def require_room(name: str, worlds: float) -> None:
    """Raises `InputError` naming who asks for more worlds than that, fewer than one, or no whole number of them."""
    if not isinstance(worlds, int) or not 1 <= worlds <= most_worlds():
        raise InputError(
            f"{name} is {worlds}: must be from 1 to {most_worlds()}, which have {LEAST_OF_A_WORLD // 1024} KiB each "
            f"in half of the memory that is available, {gibibytes(share())}"
        )


def gibibytes(count: float) -> str:
    """Bytes as a text in GiB."""
    return f"{count / 2**30:.3g} GiB"


def _of_machine() -> int:
    if _MEMINFO.exists() and (found := re.search(r"^MemAvailable: +(\d+) kB", _MEMINFO.read_text(), re.MULTILINE)):
        return 1024 * int(found[1])
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return _UNKNOWN


def _of_container() -> int:
    most, now = (_GROUP / name for name in ("memory.max", "memory.current"))
    try:
        return int(most.read_text()) - int(now.read_text())
    except (OSError, ValueError):  # no container, or "max": without a limit
        return 2**63
