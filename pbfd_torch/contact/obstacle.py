"""Obstacles: solids of the world, put somewhere, still or in prescribed motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pbfd_torch.contact.motion import Motion, Still
from pbfd_torch.contact.pairing import Touchable
from pbfd_torch.contact.polytope import thickness_of
from pbfd_torch.contact.shapes import Nearby, Shape, Solid
from pbfd_torch.contact.surface import Surface
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.constants import filled
from pbfd_torch.tensors.facts import fact
from pbfd_torch.tensors.shapes import broadcast_shapes
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.tree.articulation import homogeneous
from pbfd_torch.tree.rotations import quaternion_matrix


@dataclass(frozen=True, eq=False)
class Obstacle(Touchable):
    """A solid of the world. `position` [m] and `quaternion` (w, x, y, z) say where it is at time 0: three and four numbers, or
    tensors `[*batch, 3]` and `[*batch, 4]` where the worlds differ."""

    name: str
    shape: Solid
    position: tuple[float, float, float] | Tensor = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] | Tensor = (1.0, 0.0, 0.0, 0.0)
    motion: Motion = field(default_factory=Still)

    def __post_init__(self) -> None:
        self.require_friction(f"obstacle '{self.name}'")
        for what, value, length in (("position", self.position, 3), ("quaternion", self.quaternion, 4)):
            entries = torch.as_tensor(value)
            if entries.shape[-1:] != (length,) or not bool(torch.isfinite(entries).all()):
                raise InputError(f"{what} of '{self.name}' is {entries.tolist()}: must be {length} finite numbers a world")
        if not bool((torch.as_tensor(self.quaternion).abs().amax(-1) > 0).all()):
            raise InputError(f"quaternion of '{self.name}' is zero")

    def surface(self, dtype: torch.dtype, device: torch.device, reach: float = 0.0) -> Surface:
        """Its signed distance, in its own frame, right up to `reach` [m] at least."""
        shape = self.shape.reaching(reach) if isinstance(self.shape, Nearby) else self.shape
        return shape.surface(dtype, device)

    @property
    def thickness(self) -> float:
        """Of a convex solid [m]; infinite for others, which have no one side to be kept on."""
        return thickness_of(self.shape) if isinstance(self.shape, Shape) else math.inf

    def carrier(self, dtype: torch.dtype, device: torch.device) -> Carrier:
        """Where it is, for contact."""
        position = torch.as_tensor(self.position, dtype=dtype, device=device)
        turn = torch.as_tensor(self.quaternion, dtype=dtype, device=device)
        turn = quaternion_matrix(turn / torch.linalg.vector_norm(turn, dim=-1, keepdim=True))
        batch = broadcast_shapes(position.shape[:-1], turn.shape[:-2])
        return Carrier(homogeneous(turn.expand(*batch, 3, 3), position.expand(*batch, 3)), self.motion)


@dataclass(frozen=True, eq=False)
class Carrier:
    """The frame of an obstacle: its `start` `[*batch, 4, 4]` at time 0, and its motion."""

    start: Tensor
    motion: Motion

    def __post_init__(self) -> None:
        _ = self.belt

    def pose(self, time: Tensor) -> Tensor:
        """`[*batch, 4, 4]` at `time` `[*batch]` [s]."""
        return self.motion.pose(time) @ self.start if self.motion.moves else self.start

    @fact("start", "motion")
    def belt(self) -> Tensor:
        """Velocity of the running surface in the obstacle's frame `[3]` [m/s]."""
        return filled(self.motion.belt, self.start)

    def take(self, worlds: Worlds) -> Carrier:
        """The same obstacle in some worlds."""
        return replaced(self, start=worlds.pick(self.start, 2))
