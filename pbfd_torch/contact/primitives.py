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

from pbfd_torch.contact.surface import Field
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.worlds import Worlds, replaced

_NEGLIGIBLE = 1e-15  # shorter vectors [m] have no direction; its square and that of its inverse fit into float32


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


def unit(vector: Tensor, fallback: Tensor) -> tuple[Tensor, Tensor]:
    """Direction `[*, k]` of a vector and the inverse `[*]` of its length. A negligible vector takes the direction of the
    fallback, and zero for the inverse. With this direction (vector · direction) is the length, differentiable at zero too."""
    negligible = (vector * vector).sum(-1, keepdim=True) <= _NEGLIGIBLE**2
    safe = torch.where(negligible, fallback, vector)
    length = torch.linalg.vector_norm(safe, dim=-1, keepdim=True)
    return safe / length, torch.where(negligible, 0.0, 1 / length).squeeze(-1)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """a · b, `[*, 3] → [*]`. Term by term: several times faster than the sum of products over so short a dimension."""
    (ax, ay, az), (bx, by, bz) = a.unbind(-1), b.unbind(-1)
    return ax * bx + ay * by + az * bz


def outer(a: Tensor) -> Tensor:
    """a aᵀ, `[*, k] → [*, k, k]`."""
    return a[..., :, None] * a[..., None, :]


def _identity(like: Tensor) -> Tensor:
    return torch.eye(3, dtype=like.dtype, device=like.device)


def _axis(index: int, like: Tensor) -> Tensor:
    """A unit vector `[3]`, or `[2]` in a plane."""
    return (torch.arange(like.shape[-1], device=like.device) == index).to(like.dtype)


def _one_hot(index: Tensor, like: Tensor) -> Tensor:
    """Unit vectors `[*, k]` along the axes `[*]`."""
    return (torch.arange(like.shape[-1], device=like.device) == index[..., None]).to(like.dtype)


def _from_orthant(q: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Signed distance φ `[*]` of points `[*, k]` from the negative orthant q ≤ 0, its gradient g `[*, k]`, and the diagonal D
    `[*, k]` and the scale c `[*]` of its Hessian c (D − g gᵀ). Within the orthant the first of the nearest faces counts."""
    beyond = q.clamp_min(0)
    gradient, inverse = unit(beyond, _one_hot(q.argmax(-1), q))
    return (q * gradient).sum(-1), gradient, (beyond > 0).to(q.dtype), inverse


def from_segment(points: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets `[*, 3]` of points from the nearest point of a segment, the segment's direction `[*, 3]` (z where it has no
    length), and `[*]` which points lie beside the segment, not beyond its ends."""
    along = end - start
    axis, _ = unit(along, _axis(2, along))
    length = dot(along, axis)
    ahead = dot(points - start, axis)
    nearest = start + torch.minimum(ahead.clamp_min(0), length)[..., None] * axis
    return points - nearest, axis, (ahead > 0) & (ahead < length)


def around_segment(normal: Tensor, axis: Tensor, beside: Tensor, inverse: Tensor) -> Tensor:
    """Hessian `[*, 3, 3]` of the distance from a segment: that of a line for points beside it, that of a point beyond its ends."""
    return inverse[..., None, None] * (_identity(normal) - outer(normal) - beside[..., None, None] * outer(axis))


@dataclass(frozen=True, eq=False)
class SphereSurface:
    """All points within `radius` `[*batch, n or 1]` of the origin. Normal at the centre: +z."""

    radius: Tensor

    def __post_init__(self) -> None:
        require_tensors(radius=(self.radius, 1))
        _require_positive(radius=self.radius)

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        normal, inverse = unit(points, _axis(2, points))
        distance = dot(points, normal) - self.radius
        return Field(distance, normal, lambda: inverse[..., None, None] * (_identity(normal) - outer(normal)))

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
        offset, axis, beside = from_segment(points, self.start, self.end)
        across = torch.linalg.cross(axis, _one_hot(axis.abs().argmin(-1), axis))
        normal, inverse = unit(offset, across)
        distance = dot(offset, normal) - self.radius
        return Field(distance, normal, lambda: around_segment(normal, axis, beside, inverse))

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
        return Field(distance, normal, lambda: inverse[..., None, None] * (across.diag_embed() - outer(normal)))

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
        radial, turn = unit(plane, _axis(0, plane))
        side = torch.where(z < 0, -1.0, 1.0).to(points.dtype)
        q = torch.stack(((plane * radial).sum(-1) - self.radius, side * z - self.half_length), -1)
        distance, gradient, across, inverse = _from_orthant(q)
        normal = torch.cat((gradient[..., :1] * radial, (side * gradient[..., 1])[..., None]), -1)

        def curvature() -> Tensor:
            none = torch.zeros_like(z)
            outward = torch.stack((radial[..., 0], radial[..., 1], none), -1)
            tangent = torch.stack((-radial[..., 1], radial[..., 0], none), -1)
            kept = across[..., :1, None] * outer(outward) + across[..., 1:, None] * outer(_axis(2, points)) - outer(normal)
            return inverse[..., None, None] * kept + (turn * gradient[..., 0])[..., None, None] * outer(tangent)

        return Field(distance, normal, curvature)

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`."""
        return replaced(self, radius=worlds.pick(self.radius, 1), half_length=worlds.pick(self.half_length, 1))
