"""Prescribed motion of obstacles: what the world does whatever the bodies do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.constants import filled
from pbfd_torch.tree.articulation import homogeneous
from pbfd_torch.tree.rotations import quaternion_exp, quaternion_matrix

Vector = tuple[float, float, float]


class Motion(Protocol):
    """How an obstacle moves from where it was put."""

    @property
    def moves(self) -> bool:
        """Whether its pose changes at all."""
        ...

    def pose(self, time: Tensor) -> Tensor:
        """World displacement of the obstacle at `time` `[*batch]` [s], rigid, `[*batch, 4, 4]`; the identity at 0."""
        ...

    @property
    def belt(self) -> Vector:
        """Velocity [m/s] with which its surface runs in the obstacle's own frame while the solid stays."""
        ...


def _require_finite(what: str, *values: float) -> None:
    if not all(math.isfinite(x) for x in values):
        raise InputError(f"{what} is {values}: must be finite")


def _shifted(shift: Tensor) -> Tensor:
    eye = torch.eye(3, dtype=shift.dtype, device=shift.device)
    return homogeneous(eye.expand(*shift.shape[:-1], 3, 3), shift)


@dataclass(frozen=True)
class Still:
    """Does not move."""

    moves: bool = False
    belt: Vector = (0.0, 0.0, 0.0)

    def pose(self, time: Tensor) -> Tensor:
        """See `Motion`."""
        return _shifted(time[..., None] * torch.zeros(3, dtype=time.dtype, device=time.device))


@dataclass(frozen=True)
class Conveyor:
    """A belt: the solid stays, its surface runs at `velocity` [m/s] in the obstacle's own frame, tangentially; what part of it is
    along the normal does nothing."""

    velocity: Vector
    moves: bool = False

    def __post_init__(self) -> None:
        _require_finite("belt velocity", *self.velocity)

    @property
    def belt(self) -> Vector:
        """See `Motion`."""
        return self.velocity

    def pose(self, time: Tensor) -> Tensor:
        """See `Motion`."""
        return Still().pose(time)


@dataclass(frozen=True)
class Turntable:
    """Turns at `rate` [rad/s] about the world `axis` through the world point `center` [m]."""

    rate: float
    axis: Vector = (0.0, 0.0, 1.0)
    center: Vector = (0.0, 0.0, 0.0)
    moves: bool = True
    belt: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        _require_finite("turntable rate", self.rate)
        _require_finite("turntable center", *self.center)
        if not (math.isfinite(math.hypot(*self.axis)) and math.hypot(*self.axis) > 0):
            raise InputError(f"turntable axis is {self.axis}: must be finite and not zero")

    def pose(self, time: Tensor) -> Tensor:
        """See `Motion`."""
        size = math.hypot(*self.axis)
        axis, center = filled([x / size for x in self.axis], time), filled(self.center, time)
        turn = quaternion_matrix(quaternion_exp(self.rate * time[..., None] * axis))
        return homogeneous(turn, center - (turn @ center[:, None]).squeeze(-1))


@dataclass(frozen=True)
class Lift:
    """Moves by `path(time)` [m] along the world `direction`; `path`: a smooth tensor function `[*batch] → [*batch]`, 0 at 0."""

    path: Callable[[Tensor], Tensor]
    direction: Vector = (0.0, 0.0, 1.0)
    moves: bool = True
    belt: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        _require_finite("lift direction", *self.direction)

    @staticmethod
    def steady(velocity: Vector) -> Lift:
        """Moves at a constant `velocity` [m/s]."""
        return Lift(lambda time: time, velocity)

    def pose(self, time: Tensor) -> Tensor:
        """See `Motion`."""
        return _shifted(self.path(time)[..., None] * filled(self.direction, time))
