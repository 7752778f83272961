"""Seeds as callers give them: one for all worlds together, or one for each."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np

from pbfd_torch.errors import InputError

LARGEST = 2**64 - 1


def checked_seed(seed: Any) -> int:
    """An integer of any library as Python's own. Raises `InputError` naming what is none from 0 to 2⁶⁴ − 1."""
    try:
        found = operator.index(seed)
    except TypeError:
        found = -1
    if isinstance(seed, bool) or not 0 <= found <= LARGEST:
        raise InputError(f"seed is {seed!r}: must be an integer from 0 to {LARGEST}")
    return found


def checked_seeds(seeds: Any, worlds: int) -> int | list[int | None] | None:
    """None, one seed, or a list, tuple or array with one for each world, where None leaves that world's sequence as it is. Raises
    `InputError` for anything else, naming it."""
    if seeds is None:
        return None
    if not isinstance(seeds, list | tuple | np.ndarray):
        return checked_seed(seeds)
    if len(seeds) != worlds:
        raise InputError(f"seed has {len(seeds)} entries: must be one number, or one for each of {worlds} worlds")
    return [None if seed is None else checked_seed(seed) for seed in seeds]
