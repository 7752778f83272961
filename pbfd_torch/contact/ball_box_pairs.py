"""Candidates between spheres and boxes, in closed form: the signed distance of a sphere from a box is exact."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.contact.candidates import Finder, Slots, nearest
from pbfd_torch.contact.primitives import BoxSurface
from pbfd_torch.contact.surface import Placed, Tangent
from pbfd_torch.tensors.vectors import applied, in_frames, mapped
from pbfd_torch.tensors.worlds import replaced


@dataclass(frozen=True, eq=False)
class BallBoxPairs(Finder):
    """Spheres beside boxes.

    Attributes:
        pair, first, second: `[m]` the number of each pair, the sphere's body, the box's.
        position, radius: `[m, 3]`, `[m]` the sphere's centre in its body's frame, and its radius [m].
        frame, half_extents: `[m, 3, 4]`, `[m, 3]` of the box in its body [m].
    """

    pair: Tensor
    first: Tensor
    second: Tensor
    position: Tensor
    radius: Tensor
    frame: Tensor
    half_extents: Tensor

    def _box(self, index: Tensor) -> Placed:
        # no new checks: the sizes were checked when the shapes were made
        return Placed(replaced(_TEMPLATE, half_extents=self.half_extents[index]), self.frame[index])

    def find(self, bodies: Tensor, ahead: Tensor, reach: Tensor) -> Slots:
        """See `Finder`."""
        first, second = bodies[..., self.first, :3, :], bodies[..., self.second, :3, :]
        centers = applied(first[..., :3], self.position) + first[..., 3]
        seen = in_frames(second, centers)
        gap = self._box(torch.arange(len(self.pair), device=self.pair.device)).field(seen).distance - self.radius
        moves = reach[..., self.first] + reach[..., self.second]
        which, filled, dropped = nearest(gap, gap < moves, self.slots)
        thickness = 2 * self.half_extents.amin(-1)[which]
        seen = seen.take_along_dim(which[..., None].expand(*which.shape, 3), -2)
        later = in_frames(ahead[..., self.second, :3, :], mapped(ahead[..., self.first, :3, :], self.position))
        freely = torch.linalg.vector_norm(later.take_along_dim(which[..., None].expand(*which.shape, 3), -2) - seen, dim=-1)
        surface = Tangent.before(self._box(which), seen, freely, moves.gather(-1, which), thickness)
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


_TEMPLATE = BoxSurface(torch.ones(1, 3))
