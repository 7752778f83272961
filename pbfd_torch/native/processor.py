"""Which variants of the core this processor runs."""

from __future__ import annotations

import platform
from collections.abc import Iterable
from pathlib import Path

# What the levels of x86-64 add to the one below, under the names of Linux: `pni` is SSE3 and `abm` is LZCNT. Linux lists what
# programs can use, not only what the chip has.
LEVELS = {
    "x86-64-v2": "cx16 lahf_lm pni popcnt sse4_1 sse4_2 ssse3",
    "x86-64-v3": "abm avx avx2 bmi1 bmi2 f16c fma movbe",
    "x86-64-v4": "avx512bw avx512cd avx512dq avx512f avx512vl",
}


def runnable() -> tuple[str, ...]:
    """The variants that this processor runs, the best one first."""
    machine = platform.machine()
    if machine in ("arm64", "aarch64"):
        return ("arm64",)
    if machine not in ("x86_64", "AMD64"):
        return ()
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8") as lines:
            return levels(lines)
    except OSError:  # not Linux: the level that every such machine has
        return ("x86-64-v2",)


def levels(cpuinfo: Iterable[str]) -> tuple[str, ...]:
    """The levels of x86-64 of a processor, the best one first, from the lines of Linux's `/proc/cpuinfo`."""
    flags = next((set(line.partition(":")[2].split()) for line in cpuinfo if line.startswith("flags")), set())
    found: list[str] = []
    for level, needed in LEVELS.items():
        if not flags.issuperset(needed.split()):
            break
        found.insert(0, level)
    return tuple(found)
