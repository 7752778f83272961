"""Shapes as triangles, to be drawn; each in its own frame."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np

from pbfd_torch.contact import shapes
from pbfd_torch.contact.height_field import HeightField
from pbfd_torch.contact.mesh_distance import Mesh

if TYPE_CHECKING:
    from trimesh import Trimesh


@functools.singledispatch
def tessellated(shape: Any) -> Trimesh:
    """Triangles, counterclockwise seen from outside: those of a `Trimesh` as they are, and none for a shape without a surface,
    like a point."""
    import trimesh

    return shape if isinstance(shape, trimesh.Trimesh) else trimesh.Trimesh()


@tessellated.register(shapes.Sphere)
def _(shape: shapes.Sphere) -> Trimesh:
    import trimesh

    return trimesh.creation.icosphere(subdivisions=3, radius=shape.radius)


@tessellated.register(shapes.Capsule)
def _(shape: shapes.Capsule) -> Trimesh:
    import trimesh

    mesh = trimesh.creation.capsule(2 * shape.half_length, shape.radius, count=[16, 24])
    return mesh.apply_translation(-mesh.bounds.mean(0))


@tessellated.register(shapes.Box)
def _(shape: shapes.Box) -> Trimesh:
    import trimesh

    return trimesh.creation.box(2 * np.array(shape.half_extents))


@tessellated.register(shapes.Cylinder)
def _(shape: shapes.Cylinder) -> Trimesh:
    import trimesh

    return trimesh.creation.cylinder(shape.radius, 2 * shape.half_length, sections=32)


@tessellated.register(shapes.Ellipsoid)
def _(shape: shapes.Ellipsoid) -> Trimesh:
    import trimesh

    return trimesh.creation.icosphere(subdivisions=3).apply_scale(shape.semi_axes)


@tessellated.register(shapes.ConvexHull)
def _(shape: shapes.ConvexHull) -> Trimesh:
    import trimesh

    return trimesh.convex.convex_hull(shape.vertices)


@tessellated.register(Mesh)
def _(shape: Mesh) -> Trimesh:
    import trimesh

    return trimesh.Trimesh(shape.vertices, shape.faces, process=False)


@tessellated.register(HeightField)
def _(shape: HeightField) -> Trimesh:
    """Its samples, two triangles a cell; what lies beyond the border is left out."""
    import trimesh

    nx, ny = shape.heights.shape
    x, y = (step * (np.arange(n) - 0.5 * (n - 1)) for n, step in zip((nx, ny), shape.spacing, strict=True))
    vertices = np.stack(np.broadcast_arrays(x[:, None], y, shape.heights), -1).reshape(-1, 3)
    index = np.arange(nx * ny).reshape(nx, ny)
    near, right, left, far = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    faces = np.stack((near, right, far, near, far, left), -1).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, process=False)
