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
    """A convex solid, or for the points `where` `[*batch, n]` the half-space behind a plane that touches it. A point that moves far
    in one step ends beyond the solid, where its own distance knows nothing of what lies between; the plane does.

    normal, offset: of the planes, `[*batch, n, 3]` and `[*batch, n]` [m]."""

    solid: Surface
    where: Tensor
    normal: Tensor
    offset: Tensor

    @staticmethod
    def before(solid: Surface, points: Tensor, moves: Tensor, thickness: float | Tensor) -> Tangent:
        """The planes nearest to points `[*batch, n, 3]` outside the solid, which may move so far `[*batch, n]` [m] that they come
        past the middle of its `thickness` [m]."""
        start = solid.field(points)
        normal = start.direction
        past = (start.distance > 0) & (moves > start.distance + 0.5 * thickness)
        return Tangent(solid, past, normal, dot(points, normal) - start.distance)

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        own, where = self.solid.field(points), self.where[..., None]
        distance = torch.where(self.where, dot(points, self.normal) - self.offset, own.distance)
        normal = torch.where(where, self.normal, own.direction)
        return Field(distance, normal, lambda: torch.where(where[..., None], 0.0, own.bend))

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`."""
        return replaced(
            self,
            solid=self.solid.take(worlds),
            where=worlds.pick(self.where, 1),
            normal=worlds.pick(self.normal, 2),
            offset=worlds.pick(self.offset, 1),
        )
