"""Structures of tensors whose leading dimensions are worlds: one function for all of them, one choice per world."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor


def mapped(function: Any, first: Any, *others: Any) -> Any:
    """The same structure of dataclasses and tuples with the function of the tensors at each place."""
    if isinstance(first, Tensor):
        return function(first, *others)
    if isinstance(first, tuple):
        return tuple(mapped(function, *items) for items in zip(first, *others, strict=True))
    if dataclasses.is_dataclass(first) and not isinstance(first, type):
        changes = {
            f.name: mapped(function, getattr(first, f.name), *(getattr(o, f.name) for o in others))
            for f in dataclasses.fields(first)
        }
        return dataclasses.replace(first, **changes)
    return first


def chosen(where: Tensor, first: Any, second: Any) -> Any:
    """`first` for the worlds in `where` `[*batch]`, `second` for the others, whatever dimensions their values have of their own."""

    def choose(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(where.reshape((*where.shape, *(1,) * (a.ndim - where.ndim))), a, b)

    return mapped(choose, first, second)
