"""Collision shapes of links, and the candidate contact points each gives against a flat obstacle.

A candidate is a centre fixed in the link and a radius: the point of the body that can touch. Spheres and capsules are exact
against a plane; boxes and convex hulls are exact through their vertices. Cylinders and ellipsoids are `Curved`: their candidates
move over them.
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
HOLDING = 8  # points that hold a rim which lies flat
PRISM = 16  # corners of the prism that stands for a cylinder where bodies are looked for
LATTICE = 58  # points of the polytope that stands for an ellipsoid, besides its poles


@runtime_checkable
class Shape(Protocol):
    """A shape in its own frame, centred at the origin; lengths in metres."""

    def candidates(self) -> tuple[Points, Points]:
        """Centres `[n, 3]` and radii `[n]` of the points that can touch a plane."""
        ...


@dataclass(frozen=True, eq=False)
class Supports:
    """Ellipsoids whose hull is a curved shape, all in its frame.

    Attributes:
        centers: `[n, 3]` [m]. forms: `[n, 3, 3]` M [m²], see `terms.supported`.
        axes: `[n, 3]` of the rims that they belong to.
        lying: `[n]` 1: points that hold a rim which lies flat; −1: the rim itself; 0: neither.
    """

    centers: Points
    forms: Points
    axes: Points
    lying: NDArray[np.int64]


@dataclass(frozen=True)
class Rim:
    """A curved shape as the hull of ellipsoids of one form, centred on its z axis from −`half` to `half` [m]. `form`: M's diagonal
    [m²]."""

    form: tuple[float, float, float]
    half: float


@runtime_checkable
class Curved(Protocol):
    """A shape that rolls, and is no ball."""

    @property
    def rim(self) -> Rim:
        """Its ellipsoids."""
        ...

    def supports(self) -> Supports:
        """What touches a plane."""
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
    """Along z."""

    radius: float
    half_length: float

    def __post_init__(self) -> None:
        _require_positive("cylinder radius, half length", self.radius, self.half_length)

    def candidates(self) -> tuple[Points, Points]:
        """Of the prism that stands for it where bodies are looked for."""
        points = self._around(PRISM)
        return points, np.zeros(len(points))

    def _around(self, count: int) -> Points:
        """So many points on each rim."""
        angle = 2 * np.pi * np.arange(count) / count
        ring = np.stack((self.radius * np.cos(angle), self.radius * np.sin(angle)), -1)
        return np.concatenate([np.concatenate((ring, np.full((count, 1), z)), 1) for z in (-self.half_length, self.half_length)])

    @property
    def rim(self) -> Rim:
        """Its rims. They are a little thick along the axis, so that their lowest point moves smoothly across the cap as they pass
        through the level."""
        thick = 1e-3 * min(self.radius, self.half_length)
        return Rim((self.radius**2, self.radius**2, thick**2), self.half_length - thick)

    def supports(self) -> Supports:
        """Both rims, and points on them that hold them where they lie flat."""
        form = np.diag(self.rim.form)
        rims = np.array([[0, 0, z] for z in (-self.rim.half, self.rim.half)])
        centers = np.concatenate((rims, self._around(HOLDING)))
        forms = np.concatenate((np.stack([form] * 2), np.zeros((2 * HOLDING, 3, 3))))
        lying = np.array([-1] * 2 + [1] * 2 * HOLDING)
        return Supports(centers, forms, np.tile([0.0, 0.0, 1.0], (len(centers), 1)), lying)

    def surface(self, dtype: torch.dtype, device: torch.device) -> Surface:
        radius, half_length = torch.tensor([[self.radius], [self.half_length]], dtype=dtype, device=device)
        return CylinderSurface(radius, half_length)


@dataclass(frozen=True)
class Ellipsoid:
    """Semi-axes along x, y, z."""

    semi_axes: tuple[float, float, float]

    def __post_init__(self) -> None:
        _require_positive("ellipsoid semi-axes", *self.semi_axes)

    def candidates(self) -> tuple[Points, Points]:
        """Of the polytope that stands for it where bodies are looked for: a Fibonacci lattice and the six poles."""
        k = np.arange(LATTICE) + 0.5
        z = 1 - 2 * k / LATTICE
        angle = np.pi * (1 + 5**0.5) * k
        ring = np.sqrt(1 - z * z)
        directions = np.concatenate((np.stack((ring * np.cos(angle), ring * np.sin(angle), z), -1), np.eye(3), -np.eye(3)))
        return directions * np.array(self.semi_axes), np.zeros(len(directions))

    @property
    def rim(self) -> Rim:
        """Itself."""
        x, y, z = self.semi_axes
        return Rim((x * x, y * y, z * z), 0.0)

    def supports(self) -> Supports:
        """Itself."""
        return Supports(np.zeros((1, 3)), np.diag(self.rim.form)[None], np.array([[0.0, 0.0, 1.0]]), np.zeros(1, dtype=np.int64))


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
