"""Shapes as triangles, to be drawn; each in its own frame."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbfd_torch.contact import shapes
from pbfd_torch.contact.height_field import HeightField
from pbfd_torch.contact.mesh_distance import Mesh

_AROUND, _UP = 32, 16  # sides of what is round about an axis; rings from pole to pole


class Triangles(NamedTuple):
    """`vertices` `[n, 3]` [m] and `faces` `[m, 3]`, counterclockwise seen from outside."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


@functools.singledispatch
def tessellated(shape: Any) -> Any:
    """`Triangles`: what has `vertices` and `faces`, like a `Trimesh`, as it is, and none for a shape without a surface, like a
    point."""
    return shape if hasattr(shape, "faces") else Triangles(np.zeros((0, 3)), np.zeros((0, 3), np.int64))


@tessellated.register(shapes.Sphere)
def _(shape: shapes.Sphere) -> Triangles:
    return _turned([(shape.radius * r, shape.radius * z) for r, z in _arc(-90, 90, _UP)])


@tessellated.register(shapes.Capsule)
def _(shape: shapes.Capsule) -> Triangles:
    half, radius = shape.half_length, shape.radius
    below = [(radius * r, radius * z - half) for r, z in _arc(-90, 0, _UP // 2)]
    return _turned([*below, *((r, -z) for r, z in reversed(below))])


@tessellated.register(shapes.Box)
def _(shape: shapes.Box) -> Triangles:
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(shape.half_extents)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Triangles(corners, np.array([face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))]))


@tessellated.register(shapes.Cylinder)
def _(shape: shapes.Cylinder) -> Triangles:
    half, radius = shape.half_length, shape.radius
    return _turned([(0.0, -half), (radius, -half), (radius, half), (0.0, half)])


@tessellated.register(shapes.Ellipsoid)
def _(shape: shapes.Ellipsoid) -> Triangles:
    ball = tessellated(shapes.Sphere(1.0))
    return Triangles(ball.vertices * np.array(shape.semi_axes), ball.faces)


@tessellated.register(shapes.ConvexHull)
def _(shape: shapes.ConvexHull) -> Any:
    import trimesh

    return trimesh.convex.convex_hull(shape.vertices)


@tessellated.register(Mesh)
def _(shape: Mesh) -> Triangles:
    return Triangles(np.asarray(shape.vertices, np.float64), np.asarray(shape.faces, np.int64))


@tessellated.register(HeightField)
def _(shape: HeightField) -> Triangles:
    """Its samples, two triangles a cell; what lies beyond the border is left out."""
    nx, ny = shape.heights.shape
    x, y = (step * (np.arange(n) - 0.5 * (n - 1)) for n, step in zip((nx, ny), shape.spacing, strict=True))
    vertices = np.stack(np.broadcast_arrays(x[:, None], y, shape.heights), -1).reshape(-1, 3)
    index = np.arange(nx * ny).reshape(nx, ny)
    near, right, left, far = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    faces = np.stack((near, right, far, near, far, left), -1).reshape(-1, 3)
    return Triangles(vertices, faces)


def _arc(first: float, last: float, parts: int) -> list[tuple[float, float]]:
    """(r, z) of points of the unit circle, evenly between two latitudes [°]."""
    angles = np.radians(np.linspace(first, last, parts + 1))
    return list(zip(np.cos(angles).tolist(), np.sin(angles).tolist(), strict=True))


def _turned(profile: Sequence[tuple[float, float]]) -> Triangles:
    """A closed surface of revolution about z through points (r, z); the first and the last one are poles, the lower one first."""
    angles = 2 * np.pi * np.arange(_AROUND) / _AROUND
    around = np.stack((np.cos(angles), np.sin(angles), np.zeros(_AROUND)), -1)
    rings = [r * around + (0.0, 0.0, z) for r, z in profile[1:-1]]
    vertices = np.concatenate(([(0.0, 0.0, profile[0][1])], *rings, [(0.0, 0.0, profile[-1][1])]))
    index = 1 + np.arange(len(rings) * _AROUND).reshape(len(rings), _AROUND)
    here, there = index, np.roll(index, -1, 1)
    low, high = np.zeros(_AROUND, np.int64), np.full(_AROUND, len(vertices) - 1)
    parts = [(low, there[0], here[0]), (here[-1], there[-1], high)]
    for below, above in zip(range(len(rings) - 1), range(1, len(rings)), strict=True):
        parts += [(here[below], there[below], there[above]), (here[below], there[above], here[above])]
    return Triangles(vertices, np.concatenate([np.stack(part, -1) for part in parts]))
