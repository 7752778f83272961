"""Exact signed distance of a convex polytope.

The plane that a point is highest above decides (s, its height). Its foot on that plane belongs to the polytope for every point
inside and for those nearest to a face: φ = s. All others are nearest to an edge, its ends included. Coplanar triangles of a hull
are one face: what lies between them is no edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.contact.primitives import require_tensors
from pbfd_torch.contact.segments import around_segment, from_segment
from pbfd_torch.contact.surface import Field
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.vectors import dot, unit
from pbfd_torch.tensors.worlds import Worlds


@dataclass(frozen=True, eq=False)
class ConvexSurface:
    """The bounded polytope of all points p with normals · p ≤ offsets, one for all points and worlds: see `from_vertices`.

    Where several faces are nearest (inside; on edges and corners of the surface) the normal is that of the first.
    Every point is compared with all F faces and E edges: time and memory grow as n (F + E). On a border between regions the choice
    of region is up to rounding: that leaves the distance to rounding, the normal to the root of it, the curvature to either side.

    Attributes:
        normals: outward unit normals of the faces `[F, 3]`, no two alike.
        offsets: `[F]` [m].
        starts, ends: the ends of the edges `[E, 3]` [m].
    """

    normals: Tensor
    offsets: Tensor
    starts: Tensor
    ends: Tensor

    def __post_init__(self) -> None:
        require_tensors(normals=(self.normals, 2), offsets=(self.offsets, 1), starts=(self.starts, 2), ends=(self.ends, 2))
        faces, edges = tuple(self.normals.shape), tuple(self.starts.shape)
        if len(faces) != 2 or tuple(self.offsets.shape) != faces[:1] or faces[0] < 4:
            raise InputError(f"normals, offsets have shapes {faces}, {tuple(self.offsets.shape)}: must be [F ≥ 4, 3], [F]")
        if len(edges) != 2 or tuple(self.ends.shape) != edges or edges[0] < 6:
            raise InputError(f"starts, ends have shapes {edges}, {tuple(self.ends.shape)}: must be [E ≥ 6, 3]")
        lengths = torch.linalg.vector_norm(self.normals, dim=-1)
        if not bool(((lengths - 1).abs() < 1e-5).all()):
            raise InputError(f"normals have lengths {float(lengths.min())} to {float(lengths.max())}: must be 1")

    @staticmethod
    def from_vertices(vertices: NDArray[np.float64], dtype: torch.dtype, device: torch.device) -> ConvexSurface:
        """The convex hull of points `[n ≥ 4, 3]` [m], which must not lie in one plane. Raises InputError."""
        from scipy.spatial import ConvexHull, QhullError  # takes .3 s, and few scenes need it

        if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) < 4:
            raise InputError(f"hull vertices have shape {vertices.shape}: must be [n ≥ 4, 3]")
        if not np.isfinite(vertices).all():
            raise InputError("hull vertices are not finite: must be finite everywhere")
        try:
            hull = ConvexHull(vertices)
        except QhullError as error:
            raise InputError(f"the {len(vertices)} hull vertices lie in one plane, line or point: must span a solid") from error
        # Qhull gives all triangles of one face the same numbers.
        planes, face = np.unique(hull.equations, axis=0, return_inverse=True)
        normals = planes[:, :3]
        offsets = (normals @ vertices[hull.vertices].T).max(1)
        triangle, opposite = np.nonzero(face.reshape(-1, 1) < face.reshape(-1)[hull.neighbors])
        starts = vertices[hull.simplices[triangle, (opposite + 1) % 3]]
        ends = vertices[hull.simplices[triangle, (opposite + 2) % 3]]
        return ConvexSurface(*(torch.tensor(x, dtype=dtype, device=device) for x in (normals, offsets, starts, ends)))

    @cached_property
    def size(self) -> Tensor:
        """The largest coordinate of a corner [m]."""
        return self.starts.abs().max()

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        place = points.detach()[..., None, :]
        heights = dot(place, self.normals) - self.offsets
        highest = heights.argmax(-1)
        face = self.normals[highest]
        height = dot(points, face) - self.offsets[highest]
        foot = (points - height[..., None] * face).detach()[..., None, :]
        overhang = (dot(foot, self.normals) - self.offsets).amax(-1)
        rounding = 8 * torch.finfo(points.dtype).eps * (self.size + height.detach().abs())

        offsets, _, _ = from_segment(place, self.starts, self.ends)
        nearest = dot(offsets, offsets).argmin(-1)
        offset, direction, beside = from_segment(points, self.starts[nearest], self.ends[nearest])
        outward, inverse = unit(offset, face)

        on_face = overhang <= rounding
        distance = torch.where(on_face, height, dot(offset, outward))
        normal = torch.where(on_face[..., None], face, outward)

        def curvature() -> Tensor:
            return around_segment(outward, direction, beside, torch.where(on_face, 0.0, inverse))

        return Field(distance, normal, curvature)

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`."""
        return self
