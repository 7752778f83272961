"""Exact signed distances of a sphere, a segment with a radius, a box and a cylinder.

Parameters are tensors of one floating dtype on one device: scalars `[*batch, n or 1]`, vectors `[*batch, n or 1, 3]`, lengths in
metres; they broadcast against points `[*batch, n, 3]`. The distance is smooth but for the solid's medial axis. The normal is of
unit length everywhere: where ∇φ does not exist each class says which one it takes. The curvature jumps between the regions of
points nearest to a face, an edge and a corner; closer than 1e-15 m to a place at which it is infinite it counts as zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.contact.segments import around_segment, from_segment
from pbfd_torch.contact.surface import Field
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.vectors import axis, dot, outer, unit
from pbfd_torch.tensors.worlds import Worlds, replaced


def require_tensors(**values: tuple[Tensor, int]) -> None:
    """Check parameters, given as (value, rank): floating, finite, of one dtype and device, with at least `rank` dimensions, of
    which the second, where there is one, is 3. Raises InputError."""
    first, _ = next(iter(values.values()))
    for name, (value, rank) in values.items():
        if value.dtype not in (torch.float32, torch.float64) or (value.dtype, value.device) != (first.dtype, first.device):
            raise InputError(f"{name} is {value.dtype} on {value.device}: must be float32 or float64, all of one dtype and device")
        if value.ndim < rank or (rank == 2 and value.shape[-1] != 3):
            choice = "[*batch, n or 1, 3]" if rank == 2 else "[*batch, n or 1]"
            raise InputError(f"{name} has shape {tuple(value.shape)}: must be {choice}")
        if not bool(torch.isfinite(value).all()):
            raise InputError(f"{name} is not finite: must be finite everywhere")


def _require_positive(**values: Tensor) -> None:
    for name, value in values.items():
        if not bool((value > 0).all()):
            raise InputError(f"{name} is {float(value.min())} m: must be > 0 everywhere")


def _one_hot(index: Tensor, like: Tensor) -> Tensor:
    """Unit vectors `[*, k]` along the axes `[*]`."""
    return (torch.arange(like.shape[-1], device=like.device) == index[..., None]).to(like.dtype)


def _from_orthant(q: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Signed distance φ `[*]` of points `[*, k]` from the negative orthant q ≤ 0, its gradient g `[*, k]`, and the diagonal D
    `[*, k]` and the scale c `[*]` of its Hessian c (D − g gᵀ). Within the orthant the first of the nearest faces counts."""
    beyond = q.clamp_min(0)
    gradient, inverse = unit(beyond, _one_hot(q.argmax(-1), q))
    return dot(q, gradient), gradient, (beyond > 0).to(q.dtype), inverse


@dataclass(frozen=True, eq=False)
class SphereSurface:
    """All points within `radius` `[*batch, n or 1]` of the origin. Normal at the centre: +z."""

    radius: Tensor

    def __post_init__(self) -> None:
        require_tensors(radius=(self.radius, 1))
        _require_positive(radius=self.radius)

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        normal, inverse = unit(points, axis(2, points))

        def curvature() -> Tensor:
            eye = torch.eye(3, dtype=normal.dtype, device=normal.device)
            return inverse[..., None, None] * (eye - outer(normal, normal))

        return Field(dot(points, normal) - self.radius, normal, curvature)

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`."""
        return replaced(self, radius=worlds.pick(self.radius, 1))


@dataclass(frozen=True, eq=False)
class SegmentSurface:
    """A capsule: all points within `radius` `[*batch, n or 1]` of the segment from `start` to `end`, both `[*batch, n or 1, 3]`. A
    sphere where the two coincide. Normal on the segment: its direction × the first of the coordinate axes most across it."""

    start: Tensor
    end: Tensor
    radius: Tensor

    def __post_init__(self) -> None:
        require_tensors(start=(self.start, 2), end=(self.end, 2), radius=(self.radius, 1))
        _require_positive(radius=self.radius)

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        offset, direction, beside = from_segment(points, self.start, self.end)
        across = torch.linalg.cross(direction, _one_hot(direction.abs().argmin(-1), direction))
        normal, inverse = unit(offset, across)
        distance = dot(offset, normal) - self.radius
        return Field(distance, normal, lambda: around_segment(normal, direction, beside, inverse))

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`."""
        start, end, radius = worlds.pick(self.start, 2), worlds.pick(self.end, 2), worlds.pick(self.radius, 1)
        return replaced(self, start=start, end=end, radius=radius)


@dataclass(frozen=True, eq=False)
class BoxSurface:
    """All points with |x|, |y|, |z| ≤ half extents `[*batch, n or 1, 3]`. Inside, and on edges and corners, the normal is that of
    the nearest face; of several nearest the first in the order x, y, z, of two opposite ones the positive."""

    half_extents: Tensor

    def __post_init__(self) -> None:
        require_tensors(half_extents=(self.half_extents, 2))
        _require_positive(half_extents=self.half_extents)

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        side = torch.where(points < 0, -1.0, 1.0).to(points.dtype)
        distance, gradient, across, inverse = _from_orthant(side * points - self.half_extents)
        normal = side * gradient
        return Field(distance, normal, lambda: inverse[..., None, None] * (across.diag_embed() - outer(normal, normal)))

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`."""
        return replaced(self, half_extents=worlds.pick(self.half_extents, 2))


@dataclass(frozen=True, eq=False)
class CylinderSurface:
    """All points within `radius` of the z axis and `half_length` of the plane z = 0, both `[*batch, n or 1]`. On the axis the
    side's normal is +x. Inside, and on the rims, of several nearest the first counts in the order side, upper cap, lower cap."""

    radius: Tensor
    half_length: Tensor

    def __post_init__(self) -> None:
        require_tensors(radius=(self.radius, 1), half_length=(self.half_length, 1))
        _require_positive(radius=self.radius, half_length=self.half_length)

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        plane, z = points[..., :2], points[..., 2]
        radial, turn = unit(plane, axis(0, plane))
        side = torch.where(z < 0, -1.0, 1.0).to(points.dtype)
        q = torch.stack((dot(plane, radial) - self.radius, side * z - self.half_length), -1)
        distance, gradient, across, inverse = _from_orthant(q)
        normal = torch.cat((gradient[..., :1] * radial, (side * gradient[..., 1])[..., None]), -1)

        def curvature() -> Tensor:
            none = torch.zeros_like(z)
            outward = torch.stack((radial[..., 0], radial[..., 1], none), -1)
            tangent = torch.stack((-radial[..., 1], radial[..., 0], none), -1)
            upward = axis(2, points)
            kept = across[..., :1, None] * outer(outward, outward) + across[..., 1:, None] * outer(upward, upward)
            across_axis = (turn * gradient[..., 0])[..., None, None] * outer(tangent, tangent)
            return inverse[..., None, None] * (kept - outer(normal, normal)) + across_axis

        return Field(distance, normal, curvature)

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`."""
        return replaced(self, radius=worlds.pick(self.radius, 1), half_length=worlds.pick(self.half_length, 1))
