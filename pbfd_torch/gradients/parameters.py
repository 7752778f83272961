"""The numbers of a scene by name, and the same scene with other ones: what is optimised, identified or randomised.

A name is the path of attributes that leads to the number: `articulation.pseudo_inertia`, `terms.1.friction.mu`, `gravity`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.checked import Array, as_tensor
from pbfd_torch.errors import InputError
from pbfd_torch.scene import Scene
from pbfd_torch.tensors.plain import wrapped
from pbfd_torch.tensors.structures import fields_of
from pbfd_torch.tensors.worlds import Census, replaced

_PARTS = ("articulation", "terms", "gravity")  # of a scene: what a step knows of it
_UNBOUNDED = ("lower", "upper", "control_range", "force_range")  # infinite where there is no bound
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


def with_parameters(scene: Scene, values: Mapping[str, Array]) -> Scene:
    """The scene with the numbers of these names replaced: tensors, which may require gradients, numpy arrays or lists. With one
    value per world, rows `[*batch]` come before the shape it has: a μ of one number takes `[worlds, 1]`, since it is the same for
    all contacts. What holds them is checked as when it was made, unless torch.func is at work on them. Raises `InputError` for an
    unknown name, for another dtype, device or last dimension than the scene's, for NaN, for infinity in what is no limit and no
    range, and for numbers out of their range; `ModelError` for bodies that no mass distribution has."""
    known = parameters(scene)
    unknown = values.keys() - known.keys()
    if unknown:
        raise InputError(f"no parameter named {', '.join(sorted(unknown))}: the names are {', '.join(known)}")
    census = Census()
    scene.take(census)
    ranks = {id(value): rank for value, rank in census.shown}
    left = {name: _checked(name, value, known[name], ranks.get(id(known[name]))) for name, value in values.items()}
    seen = not any(wrapped(x) for x in left.values())
    made: list[Any] = []
    parts = {part: _changed(getattr(scene, part), part, left, made) for part in _PARTS}
    changed = replaced(scene, **parts)
    if seen:
        with torch.no_grad():
            for holder in (*made, changed):
                getattr(holder, "__post_init__", bool)()
    return changed


def _checked(name: str, value: Array, present: Tensor, rank: int | None) -> Tensor:
    """The value as a tensor. rank: how many of its last dimensions are the parameter's own; None: it is the same in all worlds."""
    tensor = as_tensor(name, value, present.dtype, present.device)
    shape, known = tuple(tensor.shape), tuple(present.shape)
    event = known if rank is None else known[len(known) - rank :]
    if present.numel() == 1 and not shape:
        fits, must = True, ""
    elif present.ndim == 0:
        fits, must = shape[-1] == 1, "be of one number, or of one for each world: (*worlds, 1)"
    elif rank is None:
        fits, must = shape == known, f"have shape {known}, the same in all worlds"
    else:
        fits, must = shape[max(len(shape) - rank, 0) :] == event, f"end in {event}, after the number of worlds if any"
    if not fits:
        raise InputError(f"{name} has shape {shape}: must {must}")
    if not wrapped(tensor):
        bounded = name.rpartition(".")[2] not in _UNBOUNDED
        fine = torch.isfinite(tensor) if bounded else ~torch.isnan(tensor)
        if not bool(fine.all()):
            raise InputError(f"{name} holds NaN{' or infinity' if bounded else ''}: must be {'finite' if bounded else 'numbers'}")
    return tensor


def _changed(value: Any, name: str, values: dict[str, Tensor], made: list[Any]) -> Any:
    """The structure with those of the values that are in it, which are taken out of the dictionary; `made`: takes what was made
    anew, the inner before the outer."""
    if name in values:
        return values.pop(name)
    if not any(key.startswith(f"{name}.") for key in values):
        return value
    if isinstance(value, list | tuple):
        return tuple(_changed(x, f"{name}.{k}", values, made) for k, x in enumerate(value))
    fields = dict(fields_of(value))
    if not fields:
        return value
    changed = replaced(value, **{key: _changed(x, f"{name}.{key}", values, made) for key, x in fields.items()})
    made.append(changed)
    return changed


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
