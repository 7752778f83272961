"""Solids, and points at known distances from their surfaces in all regions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.spatial
import torch
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.contact.convex import ConvexSurface
from pbfd_torch.contact.primitives import BoxSurface, CylinderSurface, SegmentSurface, SphereSurface
from pbfd_torch.contact.surface import Surface

Array = NDArray[np.float64]
CPU = torch.device("cpu")
RADIUS, HALF_LENGTH = 0.25, 0.375  # like the half extents without rounding in float32
HALF_EXTENTS = np.array([0.375, 0.25, 0.125])
START, END = np.array([0.1, -0.2, 0.05]), np.array([-0.15, 0.1, 0.3])
AXIS = (END - START) / np.linalg.norm(END - START)
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF_EXTENTS
CLOUD = np.random.default_rng(1).normal(size=(20, 3)) * HALF_EXTENTS + [0.05, 0.1, -0.1]
BALL_CLOUD = np.random.default_rng(2).normal(size=(40, 3))
BALL_CLOUD *= 0.3 / np.linalg.norm(BALL_CLOUD, axis=1, keepdims=True)


def tensor(value: Any, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(np.asarray(value, dtype=np.float64), dtype=dtype)


def direction(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


# Points at a known distance t from a known place of the surface, along a known normal: in all regions, off their borders.

Samples = tuple[Array, Array, Array]  # points, distances, normals


def sphere_samples(random: np.random.Generator) -> Samples:
    normal, distance = direction(random.normal(size=(2000, 3))), random.uniform(0.05 - RADIUS, 0.5, 2000)
    return (RADIUS + distance)[:, None] * normal, distance, normal


def segment_samples(random: np.random.Generator) -> Samples:
    count = 1000
    across = direction(np.cross(AXIS, random.normal(size=(3 * count, 3))))
    lean = np.repeat([0.0, -1.0, 1.0], count) * random.uniform(0.1, 5, 3 * count)  # beside; beyond the start; beyond the end
    along = np.where(lean == 0, random.uniform(0.05, 0.95, 3 * count), lean > 0)
    normal = direction(across + lean[:, None] * AXIS)
    height = random.uniform(0.03, 0.6, 3 * count)
    return START + along[:, None] * (END - START) + height[:, None] * normal, height - RADIUS, normal


def cylinder_samples(random: np.random.Generator) -> Samples:
    slant, near_side, near_cap, t = random.uniform(0.1, [[1.4], [RADIUS - 0.02], [HALF_LENGTH - 0.02], [0.5]], (4, 1000))
    depth = random.uniform(0.01, 0.15, 1000)
    regions = (  # radial part of the normal, nearest point of the surface, distance
        (1, RADIUS, near_cap, t),
        (0, near_side, HALF_LENGTH, t),
        (np.cos(slant), RADIUS, HALF_LENGTH, t),
        (1, RADIUS, random.uniform(0, HALF_LENGTH - 0.005 - depth), -depth),
        (0, random.uniform(0.02, RADIUS - 0.005 - depth), HALF_LENGTH, -depth),
    )
    outward, rho, z, distance = np.concatenate([np.broadcast_arrays(*region) for region in regions], -1)
    turn, up = random.uniform(0, 2 * np.pi, 5000), random.choice([-1.0, 1.0], 5000)
    along_r = np.stack((np.cos(turn), np.sin(turn), 0 * turn), -1)
    along_z = up[:, None] * [0.0, 0.0, 1.0]
    normal = outward[:, None] * along_r + np.sqrt(1 - outward**2)[:, None] * along_z
    return rho[:, None] * along_r + z[:, None] * along_z + distance[:, None] * normal, distance, normal


def polytope_samples(vertices: Array, repeats: int, random: np.random.Generator) -> Samples:
    """From which vertex lies on which face: outside corners, edges and faces, and inside."""
    hull = scipy.spatial.ConvexHull(vertices)
    vertices = vertices[hull.vertices]
    planes = np.unique(hull.equations, axis=0)
    normals, offsets = planes[:, :3], -planes[:, 3]
    on = np.abs(vertices @ normals.T - offsets) < 1e-9
    pairs = [(a, b) for a in range(len(planes)) for b in range(a) if (on[:, a] & on[:, b]).sum() == 2]
    features = [(on[v], np.arange(len(vertices)) == v) for v in range(len(vertices))]
    features += [(np.isin(np.arange(len(planes)), pair), on[:, pair[0]] & on[:, pair[1]]) for pair in pairs]
    features += [(np.arange(len(planes)) == k, on[:, k]) for k in range(len(planes))]
    assert len(vertices) - len(pairs) + len(planes) == 2
    parts = []
    for faces, corners in features:
        foot = random.dirichlet(np.full(corners.sum(), 8.0), repeats) @ vertices[corners]
        normal = direction(random.uniform(0.3, 1, (repeats, faces.sum())) @ normals[faces])
        parts.append((foot, random.uniform(0.03, 0.5, repeats), normal))
        if faces.sum() == 1:  # inside, down to where another face is as near
            deepest = ((offsets - foot @ normals.T) / (1 - normals @ normals[faces][0] + faces))[:, ~faces].min(1)
            parts.append((foot, -random.uniform(0.1, 0.8, repeats) * deepest, normal))
    foot, distance, normal = map(np.concatenate, zip(*parts, strict=True))
    return foot + distance[:, None] * normal, distance, normal


def hull_of(vertices: Array, dtype: torch.dtype = torch.float64) -> ConvexSurface:
    return ConvexSurface.from_vertices(vertices, dtype, CPU)


SURFACES: dict[str, Callable[[torch.dtype], Surface]] = {
    "sphere": lambda dtype: SphereSurface(tensor([RADIUS], dtype)),
    "segment": lambda dtype: SegmentSurface(tensor([START], dtype), tensor([END], dtype), tensor([RADIUS], dtype)),
    "box": lambda dtype: BoxSurface(tensor([HALF_EXTENTS], dtype)),
    "cylinder": lambda dtype: CylinderSurface(tensor([RADIUS], dtype), tensor([HALF_LENGTH], dtype)),
    "convex box": lambda dtype: hull_of(CORNERS, dtype),
    "convex": lambda dtype: hull_of(CLOUD, dtype),
    "convex ball": lambda dtype: hull_of(BALL_CLOUD, dtype),
}
VERTICES = {"box": (CORNERS, 60), "convex box": (CORNERS, 60), "convex": (CLOUD, 20), "convex ball": (BALL_CLOUD, 5)}
SMOOTH = {"sphere": sphere_samples, "segment": segment_samples, "cylinder": cylinder_samples}


def samples(name: str) -> tuple[Tensor, Tensor, Tensor]:
    random = np.random.default_rng(3)
    points, distances, normals = SMOOTH[name](random) if name in SMOOTH else polytope_samples(*VERTICES[name], random)
    assert len(points) > 1000
    return tensor(points), tensor(distances), tensor(normals)
