"""Candidates between spheres and the solids of which the signed distance of a sphere is exact: boxes and cylinders."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.contact.candidates import Finder, Slots, nearest
from pbfd_torch.contact.primitives import BoxSurface, CylinderSurface
from pbfd_torch.contact.surface import Placed, Surface, Tangent
from pbfd_torch.tensors.vectors import applied, in_frames, mapped
from pbfd_torch.tensors.worlds import replaced


@dataclass(frozen=True, eq=False)
class BallPairs(Finder):
    """Spheres beside solids.

    Attributes:
        pair, first, second: `[m]` the number of each pair, the sphere's body, the solid's.
        position, radius: `[m, 3]`, `[m]` the sphere's centre in its body's frame, and its radius [m].
        frame: `[m, 3, 4]` of the solid in its body [m].
    """

    pair: Tensor
    first: Tensor
    second: Tensor
    position: Tensor
    radius: Tensor
    frame: Tensor

    @abstractmethod
    def _solid(self, index: Tensor) -> Surface:
        """The solids of pairs `[*, n]` in their own frames."""

    @abstractmethod
    def _thickness(self, index: Tensor) -> Tensor:
        """Of the solids of pairs `[*, n]` [m]."""

    def _placed(self, index: Tensor) -> Placed:
        return Placed(self._solid(index), self.frame[index])

    def find(self, bodies: Tensor, ahead: Tensor, reach: Tensor) -> Slots:
        """See `Finder`."""
        first, second = bodies[..., self.first, :3, :], bodies[..., self.second, :3, :]
        centers = applied(first[..., :3], self.position) + first[..., 3]
        seen = in_frames(second, centers)
        gap = self._placed(torch.arange(len(self.pair), device=self.pair.device)).field(seen).distance - self.radius
        moves = reach[..., self.first] + reach[..., self.second]
        which, filled, dropped = nearest(gap, gap < moves, self.slots)
        seen = seen.take_along_dim(which[..., None].expand(*which.shape, 3), -2)
        later = in_frames(ahead[..., self.second, :3, :], mapped(ahead[..., self.first, :3, :], self.position))
        freely = torch.linalg.vector_norm(later.take_along_dim(which[..., None].expand(*which.shape, 3), -2) - seen, dim=-1)
        surface = Tangent.before(self._placed(which), seen, freely, moves.gather(-1, which), self._thickness(which))
        return Slots(
            filled=filled,
            pair=self.pair[which],
            first=self.first[which],
            position=self.position[which],
            radius=self.radius[which],
            second=self.second[which],
            surface=surface,
            dropped=dropped,
        )


# their numbers are replaced at once: parameters were checked when the shapes were made
_BOX = BoxSurface(torch.ones(1, 3))
_CYLINDER = CylinderSurface(torch.ones(1), torch.ones(1))


@dataclass(frozen=True, eq=False, kw_only=True)
class BallBoxPairs(BallPairs):
    """`half_extents`: `[m, 3]` of the boxes [m]."""

    half_extents: Tensor

    def _solid(self, index: Tensor) -> Surface:
        return replaced(_BOX, half_extents=self.half_extents[index])

    def _thickness(self, index: Tensor) -> Tensor:
        return 2 * self.half_extents.amin(-1)[index]


@dataclass(frozen=True, eq=False, kw_only=True)
class BallCylinderPairs(BallPairs):
    """`size`: `[m, 2]` radius and half length of the cylinders [m]."""

    size: Tensor

    def _solid(self, index: Tensor) -> Surface:
        radius, half_length = self.size[index].unbind(-1)
        return replaced(_CYLINDER, radius=radius, half_length=half_length)

    def _thickness(self, index: Tensor) -> Tensor:
        return 2 * self.size.amin(-1)[index]
