"""What contact asks of a solid: its signed distance at points, smooth, with first and second derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self

import torch
from torch import Tensor

from pbfd_torch.tensors.vectors import applied, dot, in_frames, outer, rows
from pbfd_torch.tensors.worlds import Worlds, replaced


class Field:
    """The signed distance φ around a solid at points `[*batch, n, 3]` in the solid's frame.

    distance: φ `[*batch, n]` [m], > 0 outside. normal: ∇φ `[*batch, n, 3]`, out of the solid; `exact`: φ is the distance itself, so
    this has unit length. The curvature is computed when first asked for; `flat`: it is zero everywhere."""

    def __init__(self, distance: Tensor, normal: Tensor, curvature: Callable[[], Tensor] | None, exact: bool = True) -> None:
        self.distance = distance
        self.normal = normal
        self._curvature = curvature
        self._exact = exact

    @property
    def flat(self) -> bool:
        return self._curvature is None

    @cached_property
    def curvature(self) -> Tensor:
        """∇∇φ `[*batch, n, 3, 3]` [1/m], symmetric."""
        if self._curvature is None:
            return torch.zeros_like(self.normal)[..., None].expand(*self.normal.shape, 3)
        return self._curvature()

    @cached_property
    def steepness(self) -> Tensor | None:
        """‖∇φ‖ `[*batch, n]`; None where it is 1."""
        return None if self._exact else torch.linalg.vector_norm(self.normal, dim=-1)

    @property
    def direction(self) -> Tensor:
        """∇φ at unit length, `[*batch, n, 3]`."""
        return self.normal if self.steepness is None else self.normal / self.steepness[..., None]

    @property
    def bend(self) -> Tensor:
        """How the direction turns, `[*batch, n, 3, 3]` [1/m]."""
        if self.steepness is None:
            return self.curvature
        across = self.curvature / self.steepness[..., None, None]
        n = self.direction
        return across - outer(n, rows(n, across))


class Surface(Protocol):
    """A solid as a signed distance. Immutable; its tensors may have one value for all points, one per point, and leading batch
    dimensions for worlds that differ: scalars `[*batch, n or 1]`, vectors `[*batch, n or 1, 3]`."""

    def field(self, points: Tensor) -> Field:
        """The signed distance at points `[*batch, n, 3]` in the solid's frame; a pure function of tensors, differentiable."""
        ...

    def take(self, worlds: Worlds) -> Self:
        """The same solid with the parameters of some worlds."""
        ...


@dataclass(frozen=True, eq=False)
class Plane:
    """The half-space normal · p < offset. `normal`: `[*batch, n or 1, 3]`, unit; `offset`: `[*batch, n or 1]` [m]."""

    normal: Tensor
    offset: Tensor

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        distance = dot(points, self.normal) - self.offset
        return Field(distance, self.normal.expand_as(points), None)

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`."""
        return replaced(self, normal=worlds.pick(self.normal, 2), offset=worlds.pick(self.offset, 1))


@dataclass(frozen=True, eq=False)
class Placed:
    """A solid put elsewhere: `frame` `[*batch, n or 1, 3, 4]` is its own frame in the one that points are given in."""

    solid: Surface
    frame: Tensor

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        turn = self.frame[..., :3]
        inside = self.solid.field(in_frames(self.frame, points))
        curvature = None if inside.flat else lambda: turn @ inside.curvature @ turn.mT
        return Field(inside.distance, applied(turn, inside.normal), curvature, inside.steepness is None)

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`."""
        return replaced(self, solid=self.solid.take(worlds), frame=worlds.pick(self.frame, 3))


@dataclass(frozen=True, eq=False)
class Tangent:
    """A convex solid that nothing jumps. A point that moves far in one step ends beyond the solid, where its own distance φ knows
    nothing of what lies between; a plane that touches the solid, at the signed distance π, does. It stands for the solid where the
    free motion leads deeper than a quarter of the thickness. Where other forces might lead past the middle, φ goes over into π,
    smoothly, between these depths below the plane: nearer to it, where contacts hold, the solid keeps its shape. (A plane alone
    would turn with a ball, and push past its centre.)

    passed, near: bool `[*batch, n]`, for which points the plane is there at all, and for which of them φ counts near it.
    normal, offset: of the planes, `[*batch, n, 3]` and `[*batch, n]` [m]. thickness: `[*, n]` [m]."""

    solid: Surface
    passed: Tensor
    near: Tensor
    normal: Tensor
    offset: Tensor
    thickness: Tensor

    @staticmethod
    def before(solid: Surface, points: Tensor, freely: Tensor, reach: Tensor, thickness: float | Tensor) -> Tangent:
        """The planes nearest to points `[*batch, n, 3]` outside the solid; these move by `freely` in their free motion and by
        `reach` at most, `[*batch, n]` [m]. thickness: the solid's [m]."""
        start = solid.field(points)
        normal = start.direction
        across = torch.as_tensor(thickness, dtype=points.dtype, device=points.device)
        outside = start.distance > 0
        led = outside & (freely > start.distance + 0.25 * across)
        passed = led | (outside & (reach > start.distance + 0.5 * across))
        return Tangent(solid, passed, ~led, normal, dot(points, normal) - start.distance, across)

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        own, height = self.solid.field(points), dot(points, self.normal) - self.offset
        layer = (0.25 * self.thickness).clamp_min(torch.finfo(height.dtype).eps)
        x = torch.where(self.passed, torch.where(self.near, (height / layer + 2).clamp(0, 1), 0.0), 1.0)
        share, slope = x * x * x * (10 - x * (15 - 6 * x)), 30 * (x * (1 - x)).square() / layer  # twice differentiable
        above = own.distance - height
        along = 1 - share + slope * above
        normal = share[..., None] * own.normal + along[..., None] * self.normal

        def curvature() -> Tensor:
            bend = 60 * x * (1 - x) * (1 - 2 * x) / layer.square() * above
            turning = slope[..., None] * (own.normal - self.normal) + 0.5 * bend[..., None] * self.normal
            turned = outer(self.normal, turning)
            return turned + turned.mT + share[..., None, None] * own.curvature

        return Field(own.distance - (1 - share) * above, normal, curvature, exact=False)

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`."""
        return replaced(
            self,
            solid=self.solid.take(worlds),
            passed=worlds.pick(self.passed, 1),
            near=worlds.pick(self.near, 1),
            normal=worlds.pick(self.normal, 2),
            offset=worlds.pick(self.offset, 1),
            thickness=worlds.pick(self.thickness, 1),
        )
