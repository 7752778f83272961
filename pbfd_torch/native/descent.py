"""Steps that the compiled core has made, followed back by it (src/adjoint.h)."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.native.calls import whole
from pbfd_torch.native.ways import Ways
from pbfd_torch.tensors.structures import in_dtype


class Descent(ctypes.Structure):
    """`pbfd_descent` of src/interface.h."""

    _fields_ = (
        ("dt", ctypes.c_void_p),
        *(
            (name, ctypes.c_int)
            for name in ("alike", "halvings", "worlds", "first", "last", "steps", "rows", "held", "refined", "dropped")
        ),
        *((name, ctypes.c_double) for name in ("share", "jump")),
        ("given", ctypes.c_void_p * 10),
        ("found", ctypes.c_void_p * 10),
        *((name, ctypes.c_void_p) for name in ("control", "own", "poses")),
        ("timed", ctypes.c_int),
        *((name, ctypes.c_void_p) for name in ("detour", "halved", "eased", "ends", "constant")),
        ("cotangent", ctypes.c_void_p * 10),
        ("seen", ctypes.c_void_p * 10),
        *((name, ctypes.c_void_p) for name in ("by_control", "by_number", "by_dt", "singular")),
    )


@dataclass(frozen=True, eq=False)
class Trail:
    """How steps were made, where not as themselves.

    Attributes:
        detour: `[steps, *batch]` int, which row of the others says how a step was made; −1: as itself.
        halved, eased, ends: see `Ways`, of `n` steps.
    """

    detour: Tensor
    halved: Tensor
    eased: Tensor
    ends: Tensor

    @staticmethod
    def of(ways: Ways) -> Trail:
        """That of steps `[steps, *batch]`."""
        other = (ways.halved != 0) | (ways.eased[..., 0] != 0)
        detour = torch.where(other, other.reshape(-1).cumsum(0).reshape(other.shape) - 1, -1).int()
        return Trail(detour, ways.halved[other], ways.eased[other], ways.ends[other])

    @staticmethod
    def joined(trails: list[Trail]) -> Trail:
        """One after the other."""
        count, detours = 0, []
        for trail in trails:
            detours.append(torch.where(trail.detour < 0, -1, trail.detour + count))
            count += len(trail.halved)
        halved, eased, ends = (torch.cat([getattr(x, name) for x in trails]) for name in ("halved", "eased", "ends"))
        return Trail(torch.cat(detours), halved, eased, ends)


@dataclass(frozen=True, eq=False)
class Path:
    """Steps as they were made.

    Attributes:
        given: the core's fields of the state before the first, `[*batch, ...]`; found: those after each, `[steps, *batch, ...]`.
        control: `[steps, *batch, nu]`, or `[1, *batch, nu]` for all.
        poses: of the obstacles that move, see `Carriers.poses`.
        trail: how they were made. refined: whether Newton's method is to improve the ends, found in half the precision.
    """

    given: Mapping[str, Tensor]
    found: Mapping[str, Tensor]
    control: Tensor
    poses: Tensor
    trail: Trail
    refined: bool = False

    def precise(self) -> Path:
        """In double precision."""
        if self.control.dtype == torch.float64:
            return self
        given, found = ({name: x.double() for name, x in some.items()} for some in (self.given, self.found))
        trail = in_dtype(self.trail, torch.float64)
        return Path(given, found, self.control.double(), self.poses.double(), trail, refined=True)


class Back:
    """Room for derivatives by what a path was made of: of those by the fields of the last state, `last` `[rows, *batch, ...]`,
    or of one row of nothing.

    Attributes:
        by: those by the fields of the last state, which become those by the first one's, `[rows, *batch, ...]`.
        control: `[rows, steps, *batch, nu]`. singular: `[steps, *batch]` int, 1 where J is.
        numbers, step_size: by the numbers of the plan, `[*batch, n]`, and Δt `[*batch]`, where they are asked for.
    """

    def __init__(self, path: Path, last: Mapping[str, Tensor] | None, numbers: int) -> None:
        self._rows = 1 if last is None else len(next(iter(last.values())))
        room = {name: x.new_zeros((self._rows, *x.shape)) for name, x in path.given.items()}
        self.by = room if last is None else room | {name: x.contiguous().clone() for name, x in last.items()}
        batch = path.found["q"].shape[:-1]
        self.control = path.control.new_zeros((self._rows, *batch, path.control.shape[-1]))
        self.singular = torch.zeros(batch, dtype=torch.int32)
        self.numbers = path.control.new_zeros(*batch[1:], numbers) if numbers else None
        self.step_size = path.control.new_zeros(batch[1:]) if numbers else None

    def call(self, path: Path, seen: Mapping[str, Tensor | None], constant: Tensor | None, dropped: bool) -> Descent:
        """What the core is to be asked, but for what is not the path's. seen: derivatives by the fields after each step."""
        steps, *batch = path.found["q"].shape[:-1]
        self._kept = [None if x is None else whole(x.double(), tuple(x.shape)) for x in map(seen.get, path.found)]
        self._constant = None if constant is None else constant.int().contiguous()
        worlds = torch.Size(batch).numel()
        asked = Descent(worlds=worlds, last=worlds, steps=steps, rows=self._rows)
        asked.held, asked.refined, asked.dropped = len(path.control) == 1 and steps > 1, path.refined, dropped
        asked.given[: len(path.given)] = [x.data_ptr() for x in path.given.values()]
        asked.found[: len(path.found)] = [x.data_ptr() for x in path.found.values()]
        asked.control, asked.poses, asked.timed = path.control.data_ptr(), path.poses.data_ptr(), path.poses.shape[1]
        trail = path.trail
        asked.detour, asked.halved, asked.eased, asked.ends = (
            x.data_ptr() for x in (trail.detour, trail.halved, trail.eased, trail.ends)
        )
        asked.constant = None if self._constant is None else self._constant.data_ptr()
        asked.cotangent[: len(self.by)] = [x.data_ptr() for x in self.by.values()]
        asked.seen[: len(self._kept)] = [None if x is None else x.data_ptr() for x in self._kept]
        asked.by_control, asked.singular = self.control.data_ptr(), self.singular.data_ptr()
        asked.by_number = None if self.numbers is None else self.numbers.data_ptr()
        asked.by_dt = None if self.step_size is None else self.step_size.data_ptr()
        return asked
