"""Collision shapes of links, and the candidate contact points each gives against a flat obstacle.

A candidate is a centre fixed in the link and a radius: the point of the body that can touch. Spheres and capsules are exact
against a plane; boxes and convex hulls are exact through their vertices; the rim of a cylinder and an ellipsoid are sampled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from pbfd_torch.contact.convex import ConvexSurface
from pbfd_torch.contact.pairing import Touchable
from pbfd_torch.contact.primitives import BoxSurface, CylinderSurface, SegmentSurface, SphereSurface
from pbfd_torch.contact.surface import Surface
from pbfd_torch.errors import InputError

Points = NDArray[np.float64]


@runtime_checkable
class Shape(Protocol):
    """A shape in its own frame, centred at the origin; lengths in metres."""

    def candidates(self) -> tuple[Points, Points]:
        """Centres `[n, 3]` and radii `[n]` of the points that can touch a plane."""
        ...


@runtime_checkable
class Solid(Protocol):
    """A shape with an exact signed distance: every one but `Point` and `Ellipsoid`."""

    def surface(self, dtype: torch.dtype, device: torch.device) -> Surface:
        """The signed distance in the shape's own frame."""
        ...


@runtime_checkable
class Nearby(Solid, Protocol):
    """A solid whose signed distance is known only up to some distance from it."""

    def reaching(self, distance: float) -> Solid:
        """The same solid with a signed distance that is right up to `distance` [m] at least."""
        ...


def _require_positive(what: str, *values: float) -> None:
    if not all(math.isfinite(x) and x > 0 for x in values):
        raise InputError(f"{what} is {values if len(values) > 1 else values[0]}: must be > 0 and finite")


@dataclass(frozen=True)
class Point:
    """A single point; with a `Collider.margin` a point with a skin, which slips but does not roll."""

    def candidates(self) -> tuple[Points, Points]:
        return np.zeros((1, 3)), np.zeros(1)


@dataclass(frozen=True)
class Sphere:
    radius: float

    def __post_init__(self) -> None:
        _require_positive("sphere radius", self.radius)

    def candidates(self) -> tuple[Points, Points]:
        return np.zeros((1, 3)), np.array([self.radius])

    def surface(self, dtype: torch.dtype, device: torch.device) -> Surface:
        return SphereSurface(torch.tensor([self.radius], dtype=dtype, device=device))


@dataclass(frozen=True)
class Capsule:
    """Along z: two half spheres of `radius` at ±`half_length`."""

    radius: float
    half_length: float

    def __post_init__(self) -> None:
        _require_positive("capsule radius, half length", self.radius, self.half_length)

    def candidates(self) -> tuple[Points, Points]:
        return np.array([[0, 0, -self.half_length], [0, 0, self.half_length]]), np.full(2, self.radius)

    def surface(self, dtype: torch.dtype, device: torch.device) -> Surface:
        start, end = torch.tensor([[[0, 0, -self.half_length]], [[0, 0, self.half_length]]], dtype=dtype, device=device)
        return SegmentSurface(start, end, torch.tensor([self.radius], dtype=dtype, device=device))


@dataclass(frozen=True)
class Box:
    half_extents: tuple[float, float, float]

    def __post_init__(self) -> None:
        _require_positive("box half extents", *self.half_extents)

    def candidates(self) -> tuple[Points, Points]:
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
        return signs * np.array(self.half_extents), np.zeros(8)

    def surface(self, dtype: torch.dtype, device: torch.device) -> Surface:
        return BoxSurface(torch.tensor([self.half_extents], dtype=dtype, device=device))


@dataclass(frozen=True)
class Cylinder:
    """Along z. `rim_points` on each rim: a cylinder that rolls does so as a prism, its axis dipping by r(1 − cos(π/rim_points))."""

    radius: float
    half_length: float
    rim_points: int = 16

    def __post_init__(self) -> None:
        _require_positive("cylinder radius, half length", self.radius, self.half_length)
        if self.rim_points < 3:
            raise InputError(f"rim_points is {self.rim_points}: must be ≥ 3")

    def candidates(self) -> tuple[Points, Points]:
        angle = 2 * np.pi * np.arange(self.rim_points) / self.rim_points
        ring = np.stack((self.radius * np.cos(angle), self.radius * np.sin(angle)), -1)
        ends = [np.concatenate((ring, np.full((self.rim_points, 1), z)), 1) for z in (-self.half_length, self.half_length)]
        return np.concatenate(ends), np.zeros(2 * self.rim_points)

    def surface(self, dtype: torch.dtype, device: torch.device) -> Surface:
        radius, half_length = torch.tensor([[self.radius], [self.half_length]], dtype=dtype, device=device)
        return CylinderSurface(radius, half_length)


@dataclass(frozen=True)
class Ellipsoid:
    """Semi-axes along x, y, z; its surface is sampled at `points` directions (Fibonacci lattice) plus the six poles."""

    semi_axes: tuple[float, float, float]
    points: int = 58

    def __post_init__(self) -> None:
        _require_positive("ellipsoid semi-axes", *self.semi_axes)

    def candidates(self) -> tuple[Points, Points]:
        k = np.arange(self.points) + 0.5
        z = 1 - 2 * k / self.points
        angle = np.pi * (1 + 5**0.5) * k
        ring = np.sqrt(1 - z * z)
        directions = np.concatenate((np.stack((ring * np.cos(angle), ring * np.sin(angle), z), -1), np.eye(3), -np.eye(3)))
        return directions * np.array(self.semi_axes), np.zeros(len(directions))


@dataclass(frozen=True, eq=False)
class ConvexHull:
    """The vertices `[n, 3]` of a mesh's convex hull. `Mesh` files become this: see `convex_hull`."""

    vertices: Points

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or len(self.vertices) < 4:
            raise InputError(f"hull vertices have shape {self.vertices.shape}: must be [n ≥ 4, 3]")

    def candidates(self) -> tuple[Points, Points]:
        return self.vertices, np.zeros(len(self.vertices))

    def surface(self, dtype: torch.dtype, device: torch.device) -> Surface:
        return ConvexSurface.from_vertices(self.vertices, dtype, device)


@dataclass(frozen=True)
class Collider(Touchable):
    """A shape on a link, at a place in the link's frame. `margin` [m]: skin around the shape in which the force of its candidate
    points sets in already."""

    name: str
    link: str
    shape: Shape
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    margin: float = 0.0

    def __post_init__(self) -> None:
        self.require_friction(f"collider '{self.name}'")
        if not (math.isfinite(self.margin) and self.margin >= 0):
            raise InputError(f"margin of collider '{self.name}' is {self.margin} m: must be ≥ 0 and finite")
