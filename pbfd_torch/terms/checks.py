"""Checks of parameters at construction: a bad one is refused with a message that names it, its value and its range."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from pbfd_torch.errors import InputError


def require_non_negative(what: str, value: float | Tensor, unit: str = "") -> None:
    """Raises `InputError` unless every entry is finite and ≥ 0."""
    _require(what, value, unit, lambda x: x >= 0, "≥ 0")


def require_widening(factor: float) -> None:
    """Raises `InputError` unless the factor of a range of slip speeds is finite and ≥ 1."""
    if not (math.isfinite(factor) and factor >= 1):
        raise InputError(f"widening factor is {factor}: must be ≥ 1 and finite")


def require_positive(what: str, value: float | Tensor, unit: str = "") -> None:
    """Raises `InputError` unless every entry is finite and > 0."""
    _require(what, value, unit, lambda x: x > 0, "> 0")


def _require(what: str, value: float | Tensor, unit: str, fits: Callable[[Tensor], Tensor], where: str) -> None:
    entries = torch.as_tensor(value)
    good = torch.isfinite(entries) & fits(entries)
    if bool(good.all()):
        return
    wrong = entries[~good]
    shown = ", ".join(str(x) for x in wrong[:3].tolist())
    more = f" and {len(wrong) - 3} more entries" if len(wrong) > 3 else ""
    raise InputError(f"{what} is {shown}{unit and ' ' + unit}{more}: must be {where} and finite")
