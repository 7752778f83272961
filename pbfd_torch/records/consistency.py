"""Whether the arrays of a record fit each other: shapes, types, and values that a simulation can have left."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.looks.appearance import Appearance
from pbfd_torch.solvers.objective import FALLBACKS, Status, is_solved

COUNTS = {"status", "iterations", "evaluations", "fallbacks", "hazards", "suspect", "substeps", "lanes"}
PLACES = ("time", "q", "link_poses", "obstacle_poses", "center_of_mass")
"""What is finite in every step; all else is where a world's step is solved."""


def require_fitting(arrays: Mapping[str, Tensor], links: int) -> None:
    """Raises `InputError` naming the first array of a `Rollout` of so many links whose shape or type does not fit the others."""
    q, obstacles = arrays["q"], arrays["obstacle_poses"]
    if q.ndim < 2 or len(q) < 2:
        raise InputError(f"q has shape {tuple(q.shape)}: must be [T + 1 ≥ 2, *batch, nq]")
    batch, steps = tuple(q.shape[1:-1]), len(q) - 1
    slots = arrays["contact_depth"].shape[-1:]
    states: dict[str, tuple[int, ...]] = {
        "v": arrays["v"].shape[-1:],
        "link_poses": (links, 3, 4),
        "center_of_mass": (3,),
    }
    states |= {"linear_momentum": (3,), "angular_momentum": (3,), "kinetic_energy": (), "potential_energy": ()}
    solves: dict[str, tuple[int, ...]] = dict.fromkeys(
        ("status", "iterations", "evaluations", "residual_norm", "hazards", "suspect", "substeps"), ()
    )
    solves |= {"fallbacks": (len(FALLBACKS),), "contact_depth": slots}
    solves |= {f"contact_{what}": (*slots, 3) for what in ("point", "normal", "force", "slip")}
    expected: dict[str, tuple[int, ...]] = {"q": tuple(q.shape)}
    expected |= {name: (steps + 1, *batch, *shape) for name, shape in states.items()}
    expected |= {name: (steps, *batch, *shape) for name, shape in solves.items()}
    moving = 1 if len(obstacles.shape) and len(obstacles) == 1 else steps + 1
    expected |= {"time": (steps + 1,), "lanes": (), "obstacle_poses": (moving, *batch, *obstacles.shape[-3:-2], 3, 4)}
    for name, shape in expected.items():
        value = arrays[name]
        if tuple(value.shape) != tuple(shape):
            raise InputError(f"{name} has shape {tuple(value.shape)}: must be {tuple(shape)}")
        if name in COUNTS and (value.is_floating_point() or value.is_complex() or value.dtype == torch.bool):
            raise InputError(f"{name} is {value.dtype}: must be integers")
        if name not in COUNTS and value.dtype not in (torch.float64, torch.float32):
            raise InputError(f"{name} is {value.dtype}: must be floating-point numbers, torch.float64 or torch.float32")


def require_plausible(arrays: Mapping[str, Tensor], dangers: int) -> None:
    """Raises `InputError` naming the first array of fitting ones with a value that no simulation leaves, with its step and world;
    `dangers`: how many there are."""
    ranges = dict.fromkeys(COUNTS, (0, None)) | {"status": (int(min(Status)), int(max(Status))), "suspect": (-1, dangers - 1)}
    for name, (low, high) in sorted(ranges.items()):
        value = arrays[name].long()
        wrong = value < low if high is None else (value < low) | (value > high)
        _require_none(name, value, wrong, f"≥ {low}" if high is None else f"from {low} to {high}")
    time = arrays["time"]
    _require_none("time", time[1:], ~(time[1:] > time[:-1]), "later than the step before")
    solved = is_solved(arrays["status"])
    begun = torch.cat((solved[:1], solved))
    for name in sorted(arrays.keys() - COUNTS):
        value = arrays[name]
        wrong = ~value.isfinite()
        if name not in PLACES:
            where = solved if len(value) == len(solved) else begun
            wrong = wrong & where.reshape(where.shape + (1,) * (value.ndim - where.ndim))
        _require_none(name, value, wrong, "finite")


def _require_none(name: str, value: Tensor, wrong: Tensor, wanted: str) -> None:
    """Step k of an array with the start in it is the state after k steps."""
    if not bool(wrong.any()):
        return
    at = tuple(wrong.nonzero()[0].tolist())
    batch = {"time": 0, "lanes": 0}.get(name, 1)
    step = f" in step {at[0]}" if at else ""
    world = f" of world {', '.join(map(str, at[1 : 1 + batch]))}" if at[1 : 1 + batch] else ""
    raise InputError(f"{name} holds {value[at].item():g}{step}{world}: must be {wanted}")


def require_drawable(seen: Appearance, coordinates: int) -> None:
    """Raises `InputError` for joints with coordinates beyond those of q, offsets that are not finite, directions without length."""
    for mark in seen.joints:
        if not (mark.first >= 0 and mark.size >= 0 and mark.first + mark.size <= coordinates):
            raise InputError(f"joint '{mark.name}' has {mark.size} coordinates from {mark.first} on: q has {coordinates}")
    for plane in seen.planes:
        if not abs(plane.offset) < float("inf"):
            raise InputError(f"plane '{plane.name}' has offset {plane.offset} m: must be finite")
    directions = {f"normal of plane '{x.name}'": x.normal for x in seen.planes} | {"up": seen.up}
    for name, direction in directions.items():
        if not any(direction):
            raise InputError(f"the {name} is {direction}: must have a length")
