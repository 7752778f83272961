"""Candidates between convex bodies of which one or both are cylinders or ellipsoids: these touch by support points, which move over
them as they turn (`terms.supported`), where polytopes have corners.

`manifold` finds where the bodies overlap, a polytope standing for the curved body. Of a cylinder the ends of that along its axis
are what counts: there its two rims are put, and the corners themselves hold it where it lies flat. An ellipsoid is its own support.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.contact.candidates import Slots
from pbfd_torch.contact.manifold import Manifold
from pbfd_torch.contact.polytope_pairs import POINTS, PolytopePairs
from pbfd_torch.tensors.vectors import dot, rotated

RIMS = 2
_SHORT = 1e-3  # of a cylinder's length: rims nearer to one another are one


@dataclass(frozen=True, eq=False)
class CurvedSlots(Slots):
    """Attributes:
    form: `[*batch, n, 3, 3]` M of the ellipsoid around each point, in its body's frame [m²].
    axis: `[*batch, n, 3]` of the rim that it belongs to, likewise.
    lying: `[*batch, n]`, see `shapes.Supports`.
    """

    form: Tensor
    axis: Tensor
    lying: Tensor


@dataclass(frozen=True, eq=False)
class CurvedPairs(PolytopePairs):
    """Pairs of convex bodies of which some are curved."""

    def _manifolds(self, poses: Tensor, world: Tensor, row: Tensor, moves: Tensor) -> tuple[Manifold, Tensor]:
        found, gap = super()._manifolds(poses, world, row, moves)
        shape, (turn, plane) = self._incident(row, found), self._sides(poses, world, row, found)
        curved, half = self.table.curved[shape], self.table.half[shape]
        along = torch.where(found.mask, found.point[..., 2], found.point[:, :1, 2])
        ends = torch.stack((along.amin(-1), along.amax(-1)), -1).clamp(-half[:, None], half[:, None])
        rims = torch.nn.functional.pad(ends[..., None], (2, 0))
        apart = torch.stack((curved, curved & (ends[:, 1] - ends[:, 0] > _SHORT * half)), -1)
        place = rotated(turn[:, None, :3, :3], rims) + turn[:, None, :3, 3]
        seen = rotated(plane[:, None, :3, :3].mT, place - plane[:, None, :3, 3])
        normal = rotated(turn[:, :3, :3].mT, rotated(plane[:, :3, :3], found.normal))  # in the frame of the curved body
        reach = dot(self.table.form[shape], normal.square()).sqrt()
        of_rims = dot(seen, found.normal[:, None]) - found.offset[:, None] - reach[:, None]
        held = found.mask & ~(curved & (half == 0))[:, None]
        whole = dataclasses.replace(found, point=torch.cat((found.point, rims), 1), mask=torch.cat((held, apart), 1))
        return whole, torch.cat((gap, of_rims), 1)

    def _incident(self, row: Tensor, found: Manifold) -> Tensor:
        return torch.where(found.swapped, self.second[row], self.first[row])

    def _sides(self, poses: Tensor, world: Tensor, row: Tensor, found: Manifold) -> tuple[Tensor, Tensor]:
        """Poses of the bodies that give the points and the plane."""
        a, b = poses[world, self.first[row]], poses[world, self.second[row]]
        swapped = found.swapped[:, None, None]
        return torch.where(swapped, b, a), torch.where(swapped, a, b)

    def _of_points(self, slots: Slots, shape: Tensor, spot: Tensor) -> CurvedSlots:
        """The slots with what is curved about their points: their shapes, and which points of theirs they are, `[*batch, n]`."""
        rim = spot >= POINTS
        turn = self.frame[shape][..., :3, :3]
        form = turn @ torch.diag_embed(self.table.form[shape] * rim[..., None]) @ turn.mT
        cylinder = self.table.curved[shape] & (self.table.half[shape] > 0)
        lying = torch.where(cylinder, torch.where(rim, -1, 1), 0)
        fields = {field.name: getattr(slots, field.name) for field in dataclasses.fields(slots)}
        return CurvedSlots(**fields, form=form, axis=turn[..., 2], lying=lying)
