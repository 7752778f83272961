"""The numbers of a scene by name, and the same scene with other ones: what is optimised, identified or randomised.

A name is the path of attributes that leads to the number: `articulation.pseudo_inertia`, `terms.1.friction.mu`, `gravity`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.scene import Scene
from pbfd_torch.topology import Topology
from pbfd_torch.worlds import replaced

_PARTS = ("articulation", "terms", "gravity")  # of a scene: what a step knows of it


def parameters(scene: Scene) -> dict[str, Tensor]:
    """Every number that a step depends on and that may carry a gradient or differ between worlds, by name. Numbers that are held as
    Python's come as tensors of no dimension."""
    like = scene.articulation
    found = {}
    for part in _PARTS:
        for name, value in _named(getattr(scene, part), part):
            found[name] = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    return found


def with_parameters(scene: Scene, values: Mapping[str, Tensor]) -> Scene:
    """The scene with the numbers of these names replaced; they may require gradients. With one value per world, rows
    `[*batch]` come before the shape it has: a μ of one number takes `[worlds, 1]`, since it is the same for all contacts. It is not
    validated again: masses and inertias must stay physical (`pseudo_inertia_of` sees to that). Raises `InputError` for an unknown
    name, and for a dtype or device that is not the scene's."""
    like = scene.articulation
    for name, value in values.items():
        if value.dtype != like.dtype or value.device != like.device:
            raise InputError(f"{name} is {value.dtype} on {value.device}: must be {like.dtype} on {like.device}")
    left = dict(values)
    parts = {part: _changed(getattr(scene, part), part, left) for part in _PARTS}
    if left:
        raise InputError(f"no parameter named {', '.join(left)}: the names are {', '.join(parameters(scene))}")
    return replaced(scene, **parts)


def _changed(value: Any, name: str, values: dict[str, Tensor]) -> Any:
    """The structure with those of the values that are in it, which are taken out of the dictionary."""
    if name in values:
        return values.pop(name)
    if not any(key.startswith(f"{name}.") for key in values):
        return value
    if isinstance(value, list | tuple):
        return tuple(_changed(x, f"{name}.{k}", values) for k, x in enumerate(value))
    fields = dict(_fields(value))
    return replaced(value, **{key: _changed(x, f"{name}.{key}", values) for key, x in fields.items()}) if fields else value


def _named(value: Any, name: str) -> Iterator[tuple[str, float | Tensor]]:
    if isinstance(value, Tensor):
        if value.is_floating_point():
            yield name, value
    elif isinstance(value, float):
        yield name, value
    elif isinstance(value, list | tuple):
        for k, x in enumerate(value):
            if not isinstance(x, float):  # what is a tuple of numbers stays one
                yield from _named(x, f"{name}.{k}")
    else:
        for key, x in _fields(value):
            yield from _named(x, f"{name}.{key}")


def _fields(value: Any) -> Iterator[tuple[str, Any]]:
    """The fields of a dataclass that may hold tensors: of numbers only those that might be one."""
    if not dataclasses.is_dataclass(value) or isinstance(value, Topology | type):
        return
    for field in dataclasses.fields(value):
        x = getattr(value, field.name)
        if not isinstance(x, float) or "Tensor" in str(field.type):
            yield field.name, x


def tensors_of(structure: Any) -> list[Tensor]:
    """All tensors in a structure of dataclasses, tuples and lists, in a fixed order."""
    if isinstance(structure, Tensor):
        return [structure]
    items = structure if isinstance(structure, list | tuple) else [x for _, x in _fields(structure)]
    return [x for item in items for x in tensors_of(item)]


def mapped_tensors(structure: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """The same structure with the function of every tensor in it; what has none that changes is kept as it is."""
    if isinstance(structure, Tensor):
        return function(structure)
    if isinstance(structure, list | tuple):
        items = [mapped_tensors(x, function) for x in structure]
        same = all(a is b for a, b in zip(items, structure, strict=True))
        return structure if same else type(structure)(items)
    fields = {key: mapped_tensors(x, function) for key, x in _fields(structure)}
    return replaced(structure, **fields) if fields else structure


def in_dtype(structure: Any, dtype: torch.dtype) -> Any:
    """The same structure with its floating-point tensors in another type."""
    return mapped_tensors(structure, lambda x: x.to(dtype) if x.is_floating_point() else x)
