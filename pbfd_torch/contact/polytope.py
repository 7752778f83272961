"""Convex shapes as rounded polytopes: the convex hull of a few vertices, and all points within a radius of it.

A box, a convex hull, a cylinder (as a prism) and an ellipsoid (as the hull of its samples) have radius 0; a capsule is a rounded
segment and a sphere a rounded point. Flat hulls are polygons with two opposite faces.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.contact.shapes import ConvexHull, Curved, Point, Points, Rim, Shape
from pbfd_torch.errors import InputError

Indices = NDArray[np.int64]

_CAP = 1 - 1e-9  # of the normal of a cylinder's cap, along its axis
_FLAT = 1e-9  # of the size: extents and distances to a plane below it count as zero


@dataclass(frozen=True, eq=False)
class Polytope:
    """A rounded convex polytope in its own frame.

    Attributes:
        vertices: `[V, 3]` of the core [m], none inside the hull of the others.
        planes: `[F, 4]` unit outward normal n and offset h [m] of each face, n·x ≤ h in the core; none for a segment or a point.
        polygons: `[max(F, 1), M]` each face's vertices, counter-clockwise seen from outside, filled up with its first vertex.
            Without faces one row: the segment or the point.
        edges: `[E, 2]` vertices of each edge; the point is an edge of length zero.
        radius: ρ ≥ 0 [m].
        flat: `[F]` which faces are the shape's own, not of the polytope that stands for a curved one.
        rim: of a curved shape.
    """

    vertices: Points
    planes: Points
    polygons: Indices
    edges: Indices
    radius: float
    flat: NDArray[np.bool_]
    rim: Rim | None = None

    @property
    def round(self) -> Rim | None:
        """Of a shape that is the hull of balls or ellipsoids."""
        if self.rim is not None or len(self.vertices) > 2:
            return self.rim
        return Rim((self.radius**2,) * 3, float(self.vertices[:, 2].max()))

    @property
    def thickness(self) -> float:
        """The least distance [m] between two parallel planes that hold the rounded polytope between them."""
        along = self.vertices @ self.planes[:, :3].T
        return float(np.ptp(along, axis=0).min(initial=np.inf if len(self.vertices) > 2 else 0.0)) + 2 * self.radius


def polytope_of(shape: Shape) -> Polytope:
    """The hull of the candidate points of a shape, rounded by their radius. Raises `InputError` where there is no candidate, one
    is not finite or the radii differ."""
    return _kept(shape) if isinstance(shape, ConvexHull) else _made(shape)


@functools.lru_cache(maxsize=256)
def _kept(shape: ConvexHull) -> Polytope:
    """Of a hull, which takes long and is asked for by all that it may touch."""
    return _made(shape)


def _made(shape: Shape) -> Polytope:
    centers, radii = shape.candidates()
    if len(centers) == 0 or not (np.isfinite(centers).all() and np.isfinite(radii).all()):
        raise InputError(f"{type(shape).__name__} has {len(centers)} candidate points: must be ≥ 1, all finite")
    radius = float(radii[0])
    if radius < 0 or (radii != radius).any():
        raise InputError(f"radii of {type(shape).__name__} are from {radii.min()} to {radii.max()}: must be one number ≥ 0")
    vertices, faces = _hull(np.asarray(centers, dtype=np.float64))
    rows = faces or [np.arange(len(vertices))]
    polygons = np.stack([np.pad(row, (0, max(map(len, rows)) - len(row)), constant_values=row[0]) for row in rows])
    pairs = np.sort(np.stack((polygons, np.roll(polygons, -1, 1)), -1).reshape(-1, 2), 1)
    proper = pairs[pairs[:, 0] < pairs[:, 1]]
    edges = np.unique(proper if len(proper) else pairs, axis=0)
    planes = np.array([_plane(vertices[face]) for face in faces]).reshape(-1, 4)
    if not isinstance(shape, Curved):
        return Polytope(vertices, planes, polygons, edges, radius, np.ones(len(planes), dtype=np.bool_))
    caps = np.abs(planes[:, 2]) > _CAP if shape.rim.half > 0 else np.zeros(len(planes), dtype=np.bool_)
    return Polytope(vertices, planes, polygons, edges, radius, caps, shape.rim)


def thickness_of(shape: Shape) -> float:
    """The least distance [m] between two parallel planes that hold a convex shape between them."""
    return polytope_of(shape).thickness


def half_thickness(shape: Shape) -> float:
    """Half of it [m]; infinite for a single point, which has none that counts."""
    return math.inf if isinstance(shape, Point) else 0.5 * thickness_of(shape)


def _hull(points: Points) -> tuple[Points, list[Indices]]:
    """Vertices of the convex hull of points, and the ordered vertices of each face."""
    from scipy.spatial import ConvexHull as Quickhull

    center = points.mean(0)
    _, spread, axes = np.linalg.svd(points - center, full_matrices=False)
    size = float(np.abs(points - center).max())
    along = (points - center) @ axes.T
    if size == 0:
        return points[:1], []
    rank = int((spread > _FLAT * spread[0]).sum())
    if rank == 1:
        return points[[along[:, 0].argmin(), along[:, 0].argmax()]], []
    if rank == 2:
        ring = Quickhull(along[:, :2]).vertices
        front = np.arange(len(ring))
        return points[ring], [front, front[::-1]]
    hull = Quickhull(points)
    vertices = points[hull.vertices]
    on_plane = np.abs(vertices @ hull.equations[:, :3].T + hull.equations[:, 3]) <= _FLAT * size
    sets, first = np.unique(on_plane, axis=1, return_index=True)
    whole = sets.sum(0) > 2
    return vertices, [_ring(vertices, np.flatnonzero(sets[:, k]), hull.equations[first[k], :3]) for k in np.flatnonzero(whole)]


def _ring(vertices: Points, face: Indices, normal: Points) -> Indices:
    """The vertices of a face in counter-clockwise order about its normal."""
    arms = vertices[face] - vertices[face].mean(0)
    x = arms[0]
    return face[np.argsort(np.arctan2(arms @ np.cross(normal, x), arms @ x))]


def _plane(polygon: Points) -> Points:
    """Unit normal and offset of a polygon (Newell's method)."""
    arms = polygon - polygon[0]
    normal = np.cross(arms, np.roll(arms, -1, 0)).sum(0)
    normal /= np.linalg.norm(normal)
    return np.append(normal, (polygon @ normal).max())


@dataclass(frozen=True, eq=False)
class PolytopeTable:
    """Several polytopes as tensors, so that rows of pairs gather theirs by index. Padding repeats a shape's first vertex, a
    polygon's first corner and a shape's last edge, which changes no extreme; padded faces have normal zero.

    Attributes: `vertices` `[S, V, 3]`, `normals` `[S, F, 3]`, `offsets` `[S, F]`, `polygons` `[S, F, M]`, `edges` `[S, E, 2]`,
    `radius` `[S]` as in `Polytope`; `is_face` `[S, F]`: False for padding and for the one polygon of a segment or a point;
    `is_flat` `[S, F]`: of these the shape's own, see `Polytope.flat`; `curved` `[S]`; `form` `[S, 3]`, `half` `[S]`: see `Rim`,
    zero for others; `size` `[S]` [m]: half the diagonal of the box around the core, plus the radius."""

    vertices: Tensor
    normals: Tensor
    offsets: Tensor
    is_face: Tensor
    is_flat: Tensor
    polygons: Tensor
    edges: Tensor
    radius: Tensor
    size: Tensor
    curved: Tensor
    form: Tensor
    half: Tensor

    @staticmethod
    def stack(polytopes: Sequence[Polytope]) -> PolytopeTable:
        """The table of the polytopes, in their order, float64 on the CPU. Raises `InputError` where there is none."""
        if not polytopes:
            raise InputError("a table of 0 polytopes: must be ≥ 1")
        points = max(len(p.vertices) for p in polytopes)
        faces, corners = (max(p.polygons.shape[k] for p in polytopes) for k in (0, 1))
        edges = max(len(p.edges) for p in polytopes)

        def tensor(arrays: Sequence[NDArray[np.float64] | NDArray[np.int64] | NDArray[np.bool_]]) -> Tensor:
            return torch.from_numpy(np.stack(arrays))

        planes = tensor([np.pad(p.planes, ((0, faces - len(p.planes)), (0, 0))) for p in polytopes])
        rings = [np.concatenate((p.polygons, p.polygons[:, :1].repeat(corners - p.polygons.shape[1], 1)), 1) for p in polytopes]
        return PolytopeTable(
            vertices=tensor([np.concatenate((p.vertices, p.vertices[:1].repeat(points - len(p.vertices), 0))) for p in polytopes]),
            normals=planes[..., :3],
            offsets=planes[..., 3],
            is_face=tensor([np.arange(faces) < len(p.planes) for p in polytopes]),
            is_flat=tensor([np.pad(p.flat, (0, faces - len(p.flat))) for p in polytopes]),
            polygons=tensor([np.pad(ring, ((0, faces - len(ring)), (0, 0))) for ring in rings]),
            edges=tensor([np.pad(p.edges, ((0, edges - len(p.edges)), (0, 0)), mode="edge") for p in polytopes]),
            radius=torch.tensor([p.radius for p in polytopes], dtype=torch.float64),
            size=torch.tensor(
                [0.5 * np.linalg.norm(np.ptp(p.vertices, axis=0)) + p.radius for p in polytopes], dtype=torch.float64
            ),
            curved=torch.tensor([p.rim is not None for p in polytopes]),
            form=torch.tensor([p.rim.form if p.rim else (0.0, 0.0, 0.0) for p in polytopes], dtype=torch.float64),
            half=torch.tensor([p.rim.half if p.rim else 0.0 for p in polytopes], dtype=torch.float64),
        )

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Self:
        """The same table with floating-point values of a type, on a device."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        moved = {name: x.to(device=device, dtype=dtype if x.is_floating_point() else x.dtype) for name, x in fields.items()}
        return dataclasses.replace(self, **moved)
