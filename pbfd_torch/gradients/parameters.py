"""The numbers of a scene by name, and the same scene with other ones: what is optimised, identified or randomised.

A name is the path of attributes that leads to the number: `articulation.pseudo_inertia`, `terms.1.friction.mu`, `gravity`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.scene import Scene
from pbfd_torch.tensors.structures import fields_of
from pbfd_torch.tensors.worlds import replaced

_PARTS = ("articulation", "terms", "gravity")  # of a scene: what a step knows of it
_MEASURES = ("deep",)  # tell when a step has a hazard: no motion depends on them


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
    fields = dict(fields_of(value))
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
        for key, x in fields_of(value):
            if key not in _MEASURES:
                yield from _named(x, f"{name}.{key}")
