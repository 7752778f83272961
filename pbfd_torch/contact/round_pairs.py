"""Candidates between round bodies: spheres and capsules, in closed form.

Of each pair the first body gives spheres on its axis and the second one is a capsule: the signed distance of a sphere from a
capsule is exact. Two capsules touch at the nearest points of their axes, and nearly parallel ones along all that lies side by
side: three spheres, at the nearest point and at both ends of the overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.contact.candidates import Finder, Slots, nearest
from pbfd_torch.contact.primitives import SegmentSurface
from pbfd_torch.contact.segments import share_of
from pbfd_torch.contact.surface import Tangent
from pbfd_torch.tensors.constants import indices
from pbfd_torch.tensors.vectors import applied, dot, in_frames
from pbfd_torch.tensors.worlds import replaced


@dataclass(frozen=True)
class Round:
    """A sphere or a capsule on a body: all points within `radius` [m] of the segment from `start` to `end` in the body's frame."""

    body: int
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float

    @property
    def long(self) -> bool:
        """A capsule."""
        return self.start != self.end


@dataclass(frozen=True, eq=False)
class RoundPairs(Finder):
    """Pairs of round colliders. `pair` `[m]`: the number of each pair; `first`, `second`: `[m]` bodies; `axes`: `[m, 4, 3]` the
    ends of the first one's axis, then of the second one's; `radii`: `[m, 2]`."""

    pair: Tensor
    first: Tensor
    second: Tensor
    axes: Tensor
    radii: Tensor

    @staticmethod
    def of(pairs: Sequence[tuple[int, Round, Round]], slots: int, like: Tensor) -> RoundPairs:
        """From pairs (number, one, other) of round colliders; `like`: dtype and device."""
        # spheres give points, capsules are solids
        ordered = [(k, b, a) if a.long and not b.long else (k, a, b) for k, a, b in pairs]

        return RoundPairs(
            indices([k for k, _, _ in ordered], like.device),
            indices([a.body for _, a, _ in ordered], like.device),
            indices([b.body for _, _, b in ordered], like.device),
            like.new_tensor([[a.start, a.end, b.start, b.end] for _, a, b in ordered]),
            like.new_tensor([[a.radius, b.radius] for _, a, b in ordered]),
            slots=slots,
        )

    def find(self, bodies: Tensor, ahead: Tensor, reach: Tensor) -> Slots:
        """See `Finder`."""
        ends, later = self._ends(bodies), self._ends(ahead)
        a, b, c, d = ends.unbind(-2)
        along = _places(a, b, c, d)  # [*, m, 3]
        centers = a[..., None, :] + along[..., None] * (b - a)[..., None, :]
        gap = _distance(centers, c[..., None, :], d[..., None, :]) - self.radii.sum(-1)[:, None]
        moves = (reach[..., self.first] + reach[..., self.second])[..., None]
        near = gap < moves
        long = (self.axes[:, 0] != self.axes[:, 1]).any(-1)[:, None]
        near = near & (long | (torch.arange(3, device=near.device) == 0))
        order, filled, dropped = nearest(gap.flatten(-2), near.flatten(-2), self.slots)
        which = order // 3
        share = along.flatten(-2).gather(-1, order)[..., None]
        axis = self.axes[which]
        solid = replaced(_TEMPLATE, start=axis[..., 2, :], end=axis[..., 3, :], radius=self.radii[which][..., 1])
        seen = in_frames(bodies[..., self.second, :3, :][..., None, :, :], centers)
        seen = seen.flatten(-3, -2).take_along_dim(order[..., None].expand(*order.shape, 3), -2)
        shift = (later - ends).take_along_dim(which[..., None, None].expand(*which.shape, 4, 3), -3)
        carried = shift[..., 0, :] + share * (shift[..., 1, :] - shift[..., 0, :])
        freely = torch.linalg.vector_norm(carried[..., None, :] - shift[..., 2:, :], dim=-1).amax(-1)
        thickness = 2 * self.radii[which][..., 1]
        surface = Tangent.before(solid, seen, freely, moves.squeeze(-1).gather(-1, which), thickness)
        return Slots(
            filled=filled,
            pair=self.pair[which],
            first=self.first[which],
            position=axis[..., 0, :] + share * (axis[..., 1, :] - axis[..., 0, :]),
            radius=self.radii[which][..., 0],
            second=self.second[which],
            surface=surface,
            dropped=dropped,
        )

    def _ends(self, bodies: Tensor) -> Tensor:
        """Of the axes, `[*batch, m, 4, 3]`."""
        poses = torch.stack((bodies[..., self.first, :, :], bodies[..., self.second, :, :]), -3).repeat_interleave(2, -3)
        return applied(poses[..., :3, :3], self.axes) + poses[..., :3, 3]


# its numbers are replaced at once: parameters were checked when the shapes were made
_TEMPLATE = SegmentSurface(torch.zeros(1, 3), torch.zeros(1, 3), torch.ones(1))


def _places(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Where on the segment ab, as shares of it `[*, 3]`: the point nearest to the segment cd, and the two ends of what lies beside
    cd."""
    u, v, w = b - a, d - c, a - c
    uu, uv, vv, uw, vw = (dot(x, y) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    s = share_of(uv * vw - vv * uw, uu * vv - uv * uv)
    t = share_of(vw + s * uv, vv)
    s = share_of(t * uv - uw, uu)
    beside = [share_of(dot(point - a, u), uu) for point in (c, d)]
    return torch.stack((s, *beside), -1)


def _distance(points: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Distances of points from segments, `[*]`."""
    along = end - start
    share = share_of(dot(points - start, along), dot(along, along))
    return torch.linalg.vector_norm(points - start - share[..., None] * along, dim=-1)
