"""Structures of tensors: dataclasses, tuples and lists that hold tensors, themselves in others."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.tensors.worlds import replaced


class Constant:
    """What holds no number of a scene: the same in all worlds and without derivatives. Its tensors are nobody's business."""


def fields_of(value: Any) -> Iterator[tuple[str, Any]]:
    """The fields of a dataclass that may hold tensors: of numbers only those that might be one."""
    if not dataclasses.is_dataclass(value) or isinstance(value, Constant | type):
        return
    for field in dataclasses.fields(value):
        x = getattr(value, field.name)
        if not isinstance(x, float) or "Tensor" in str(field.type):
            yield field.name, x


def tensors_of(structure: Any) -> list[Tensor]:
    """All tensors in a structure of dataclasses, tuples and lists, in a fixed order."""
    if isinstance(structure, Tensor):
        return [structure]
    items = structure if isinstance(structure, list | tuple) else [x for _, x in fields_of(structure)]
    return [x for item in items for x in tensors_of(item)]


def mapped_tensors(structure: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """The same structure with the function of every tensor in it; what has none that changes is kept as it is."""
    if isinstance(structure, Tensor):
        return function(structure)
    if isinstance(structure, list | tuple):
        items = [mapped_tensors(x, function) for x in structure]
        same = all(a is b for a, b in zip(items, structure, strict=True))
        return structure if same else type(structure)(items)
    fields = {key: mapped_tensors(x, function) for key, x in fields_of(structure)}
    return replaced(structure, **fields) if fields else structure


def in_dtype(structure: Any, dtype: torch.dtype) -> Any:
    """The same structure with its floating-point tensors in another type."""
    return mapped_tensors(structure, lambda x: x.to(dtype) if x.is_floating_point() else x)
