"""Convex polytopes as the C++ core sees them: index tables and numbers in the order in which src/hulls.h reads them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.contact.polytope import Polytope
from pbfd_torch.native.not_compiled import unknown

HEADER = 6  # whole numbers of each shape, ahead of its own
CORNERS = 128  # of one polygon at most
VERTICES = 1024  # of one polytope at most


def hulls(polytopes: Sequence[Polytope]) -> tuple[list[int], Tensor]:
    """The index tables, and the numbers `[n]`, float64. Raises `NotCompiledError` where a shape has too many corners."""
    whole = [len(polytopes)] + [0] * (HEADER * len(polytopes))
    real: list[NDArray[np.float64]] = []
    taken = 0
    for k, polytope in enumerate(polytopes):
        rings = polygons(polytope)
        if len(polytope.vertices) > VERTICES or max(map(len, rings)) > CORNERS:
            raise unknown(f"a convex hull of {len(polytope.vertices)} vertices and faces of up to {max(map(len, rings))} corners")
        sizes = len(polytope.vertices), len(polytope.planes), len(polytope.edges)
        whole[1 + HEADER * k : 1 + HEADER * (k + 1)] = [*sizes, int(polytope.rim is not None), len(whole), taken]
        whole += [0, *accumulate(map(len, rings)), *polytope.flat.tolist(), *polytope.edges.flatten().tolist()]
        whole += [corner for ring in rings for corner in ring]
        numbers = _numbers(polytope, rings)
        real.append(numbers)
        taken += len(numbers)
    return [int(x) for x in whole], torch.from_numpy(np.concatenate(real or [np.zeros(0)]))


def polygons(polytope: Polytope) -> list[list[int]]:
    """The corners of each polygon, without what fills it up: the first one again."""
    rings: list[list[int]] = polytope.polygons.tolist()
    if len(polytope.planes) == 0:
        return [list(range(len(polytope.vertices)))]
    return [ring[:1] + [corner for corner in ring[1:] if corner != ring[0]] for ring in rings]


def _numbers(polytope: Polytope, rings: list[list[int]]) -> NDArray[np.float64]:
    vertices, rim = polytope.vertices, polytope.rim
    size = 0.5 * float(np.linalg.norm(np.ptp(vertices, axis=0))) + polytope.radius
    form, half = ((*rim.form,), rim.half) if rim else ((0.0, 0.0, 0.0), 0.0)
    sizes = polytope.radius, size, polytope.thickness
    alone = np.array([*sizes, *form, half, *vertices.max(0), *vertices.mean(0), _bulge(polytope)])
    start, end = (vertices[polytope.edges[:, k]] for k in (0, 1))
    along = end - start
    length = np.linalg.norm(along, axis=1, keepdims=True)
    unit = np.divide(along, length, out=np.zeros_like(along), where=length > 0)
    edges = np.concatenate((unit, *_beside(polytope, rings)), 1)
    return np.concatenate([x.reshape(-1) for x in (alone, vertices, polytope.planes, edges)]).astype(np.float64)


def _bulge(polytope: Polytope) -> float:
    """How far a curved shape goes beyond the polytope that stands for it, at most [m]."""
    if polytope.rim is None:
        return 0.0
    normals, offsets = polytope.planes[:, :3], polytope.planes[:, 3]
    reach = np.sqrt(normals**2 @ np.array(polytope.rim.form)) + polytope.rim.half * np.abs(normals[:, 2])
    return float((reach - offsets).max())


def _beside(polytope: Polytope, rings: list[list[int]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Normals `[E, 3]` of the face that has an edge from its first vertex to its second, and of the one that has it the other way
    round; zero where there is none."""
    face = {}
    if len(polytope.planes):
        for k, ring in enumerate(rings):
            face.update(dict.fromkeys(zip(ring, ring[1:] + ring[:1], strict=True), k))
    normals = np.concatenate((polytope.planes[:, :3], np.zeros((1, 3))))  # the last one for none
    left = [face.get((int(p), int(q)), -1) for p, q in polytope.edges]
    right = [face.get((int(q), int(p)), -1) for p, q in polytope.edges]
    return normals[left], normals[right]
