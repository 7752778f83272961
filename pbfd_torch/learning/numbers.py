"""Checks of numbers that come from outside: from files and from settings."""

from __future__ import annotations

import math
import reprlib

from pbfd_torch.errors import InputError


def require_integer(name: str, value: object, low: int, high: int) -> None:
    """Raises `InputError` unless it is an integer from low to high."""
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise InputError(f"{name} is {reprlib.repr(value)}: must be an integer from {low} to {high}")


def require_real(name: str, value: object, low: float, high: float) -> None:
    """Raises `InputError` unless it is a finite number from low to high."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not (math.isfinite(value) and low <= value <= high):
        raise InputError(f"{name} is {reprlib.repr(value)}: must be a finite number from {low:g} to {high:g}")
