"""How far two convex bodies are apart, and in which direction.

The separation of bodies a and b along a unit direction n (from b to a) is s(n) = min over a of n·x − max over b of n·y. Its
largest value over all n is the signed distance: > 0 apart, < 0 minus the penetration depth. Every s(n) is a lower bound of it, so
a few directions among which the best one must be are enough, and a wrong one among them does no harm:

- the face normals of both (face against vertex; exact in penetration too),
- cross products of their edges (edge against edge),
- the directions between nearest points (all that involves a vertex, where apart).

Radii shrink s alike in all directions. Poses may be differentiated; which direction wins is piecewise constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.contact.polytope import Polytope, PolytopeTable
from pbfd_torch.contact.segments import share_of
from pbfd_torch.tensors.plain import plain
from pbfd_torch.tensors.vectors import axis, dot, rotated

_DEEPER = 0.05  # a face is taken where its depth is at most this share larger than the smallest …
_SLACK = 1e-4  # … or its separation at most this share of the smaller body's size less than the largest
_FARTHEST = 1e12  # [m] between bodies: beyond what worlds within their bounds hold
_NEAR_EDGES = 4  # edges of each body next to its witness point


@dataclass(frozen=True, eq=False)
class Separation:
    """Attributes: `normal` `[K, 3]`, unit, world, from b to a: a face's normal unless another direction separates clearly more;
    `along` `[K]` [m] the separation in this direction; `distance` `[K]` [m] the signed distance."""

    normal: Tensor
    along: Tensor
    distance: Tensor


def relative_pose(base: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation `[K, 3, 3]` and translation `[K, 3]` that take the frame of `pose` to the frame of `base` (both `[K, 3 or 4,
    4]`)."""
    turn = base[..., :3, :3].mT
    rotation = (turn[..., :, :, None] * pose[..., None, :3, :3]).sum(-2)
    return rotation, rotated(turn, pose[..., :3, 3] - base[..., :3, 3])


def _direction(vector: Tensor) -> Tensor:
    """Vectors `[*, 3]` scaled to unit length; (0, 0, 1), a direction like any other, for those that are too short for it."""
    square = dot(vector, vector)[..., None]
    short = ~(square > torch.finfo(vector.dtype).tiny * 1e6)  # NaN counts as short
    return torch.where(short, axis(2, vector), vector / torch.where(short, 1.0, square).sqrt())


def box_separation(table: PolytopeTable, a: Tensor, b: Tensor, pose_a: Tensor, pose_b: Tensor) -> Separation:
    """Separation of boxes, in closed form: the 15 axes of the separating-axis test (exact in penetration) and the directions from
    each vertex to the nearest point of the other box (with them exact apart).

    table: its rows a, b `[K]` are boxes centred in their frames; pose_a, pose_b: `[K, 3 or 4, 4]` of the boxes in the world."""
    pair = _Pair(table, a, b, pose_a, pose_b)
    half_a, half_b = (table.vertices[shape].amax(-2) for shape in (a, b))
    turn = pair.rotation[:, None]
    eye = torch.eye(3, dtype=half_a.dtype, device=half_a.device)
    crosses = _crosses(pair.rotation.mT, eye.expand_as(pair.rotation))
    from_b = pair.vertices_a - _clamped(pair.vertices_a, half_b)
    from_a = rotated(turn, pair.vertices_b - _clamped(pair.vertices_b, half_a))
    return pair.separation(torch.cat((crosses, from_b, from_a), 1))


def fcl_geometries(polytopes: Sequence[Polytope]) -> list[Any]:
    """FCL's shape of each polytope's core, to be made once and shared by all its pairs. A segment and a point are convex hulls with
    collapsed faces: FCL's own capsules and spheres are only good to 1e-6."""
    import fcl

    def geometry(polytope: Polytope) -> Any:
        polygons = polytope.polygons
        if len(polytope.vertices) < 3:
            polygons = np.array([[0, len(polytope.vertices) - 1, 0]])
        faces = [np.concatenate(([len(corners)], corners)) for corners in map(_distinct, polygons)]
        return fcl.Convex(polytope.vertices, len(faces), np.concatenate(faces))

    return [geometry(polytope) for polytope in polytopes]


def fcl_separation(
    table: PolytopeTable, geometries: Sequence[Any], a: Tensor, b: Tensor, pose_a: Tensor, pose_b: Tensor
) -> Separation:
    """Separation of any convex pairs: the face normals of both, FCL's direction between nearest points, and the cross products of
    the edges next to those, which give the direction where the bodies just touch. FCL runs row by row on the CPU in float64.

    table: of the polytopes of `geometries` (see `fcl_geometries`); a, b: `[K]` rows; pose_a, pose_b: `[K, 3 or 4, 4]` in the
        world."""
    pair = _Pair(table, a, b, pose_a, pose_b)
    witnesses = _witnesses(geometries, a, b, pair.rotation, pair.translation)
    on_a, on_b = witnesses.to(dtype=table.vertices.dtype, device=table.vertices.device).unbind(1)
    edges_a = _edges_near(on_a, pair.vertices_a, table.edges[a])
    edges_b = _edges_near(on_b, pair.vertices_b_own, table.edges[b])
    middle = pair.vertices_a.mean(-2) - pair.vertices_b_own.mean(-2)
    others = torch.cat((_crosses(edges_a, edges_b), torch.stack((on_a - on_b, middle), 1)), 1)
    return pair.separation(others)


class _Pair:
    """Rows of pairs, in the frame of b."""

    def __init__(self, table: PolytopeTable, a: Tensor, b: Tensor, pose_a: Tensor, pose_b: Tensor) -> None:
        self.table, self.a, self.b = table, a, b
        self.pose_b = pose_b
        self.rotation, self.translation = relative_pose(pose_b, pose_a)
        self.vertices_b_own = table.vertices[b]
        self.vertices_a = rotated(self.rotation[:, None], table.vertices[a]) + self.translation[:, None]
        self.vertices_b = rotated(self.rotation.mT[:, None], self.vertices_b_own - self.translation[:, None])  # in the frame of a

    def separation(self, others: Tensor) -> Separation:
        """The largest separation over the faces of both and other directions `[K, C, 3]` in the frame of b, of any sign and
        length."""
        table, a, b = self.table, self.a, self.b
        others = _direction(others)
        radii = table.radius[a] + table.radius[b]
        normals_a, normals_b = table.normals[a], table.normals[b]
        faces = torch.cat(
            (
                _along(normals_b, self.vertices_a).amin(-1) - table.offsets[b],
                _along(normals_a, self.vertices_b).amin(-1) - table.offsets[a],
            ),
            1,
        )
        faces = torch.where(torch.cat((table.is_flat[b], table.is_flat[a]), 1), faces, -torch.inf) - radii[:, None]
        (low_a, high_a), (low_b, high_b) = (_extent(others, x) for x in (self.vertices_a, self.vertices_b_own))
        free = torch.cat((low_a - high_b, low_b - high_a), 1) - radii[:, None]
        directions = torch.cat((normals_b, -rotated(self.rotation[:, None], normals_a), others, -others), 1)
        best_face, face = faces.max(1)
        best_free, other = free.max(1)
        distance = torch.maximum(best_face, best_free)
        slack = _SLACK * torch.minimum(table.size[a], table.size[b]) + _DEEPER * (-distance).clamp_min(0)
        by_face = best_face >= best_free - slack
        chosen = torch.where(by_face, face, faces.shape[1] + other)
        normal = directions.gather(1, chosen[:, None, None].expand(-1, 1, 3)).squeeze(1)
        return Separation(rotated(self.pose_b[..., :3, :3], normal), torch.where(by_face, best_face, best_free), distance)


def _along(directions: Tensor, vertices: Tensor) -> Tensor:
    """d·x of every direction and vertex, `[K, C, 3], [K, V, 3] → [K, C, V]`."""
    x, y, z = (directions[..., k, None] * vertices[:, None, :, k] for k in range(3))
    return x + y + z


def _extent(directions: Tensor, vertices: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest and largest d·x over the vertices, each `[K, C]`."""
    along = _along(directions, vertices)
    return along.amin(-1), along.amax(-1)


def _clamped(points: Tensor, half: Tensor) -> Tensor:
    """Nearest points of a box `[K, V, 3]`."""
    return torch.maximum(torch.minimum(points, half[:, None]), -half[:, None])


def _crosses(edges_a: Tensor, edges_b: Tensor) -> Tensor:
    """Unit vectors perpendicular to each pair of edges, `[K, m, 3], [K, n, 3] → [K, m n, 3]`; zero where they are almost
    parallel."""
    cross = torch.linalg.cross(_direction(edges_a)[:, :, None], _direction(edges_b)[:, None]).flatten(1, 2)
    square = dot(cross, cross)[..., None]
    return torch.where(square > torch.finfo(cross.dtype).eps ** 0.5, cross, 0.0)


def _edges_near(point: Tensor, vertices: Tensor, edges: Tensor) -> Tensor:
    """Vectors along the edges nearest to a point, `[K, 3], [K, V, 3], [K, E, 2] → [K, ≤ 4, 3]`."""
    start, end = (vertices.gather(1, edges[..., k, None].expand(-1, -1, 3)) for k in (0, 1))
    along = end - start
    to_point = point[:, None] - start
    beside = to_point - share_of(dot(to_point, along), dot(along, along))[..., None] * along
    nearest = dot(beside, beside).topk(min(_NEAR_EDGES, edges.shape[1]), largest=False).indices
    return along.gather(1, nearest[..., None].expand(-1, -1, 3))


def _distinct(corners: np.ndarray[Any, np.dtype[np.int64]]) -> np.ndarray[Any, np.dtype[np.int64]]:
    """A face's corners without its padding, which repeats the first one."""
    last = np.flatnonzero(corners != corners[0])[-1] if len(corners) > 3 else 2
    return corners[: last + 1]


def _witnesses(geometries: Sequence[Any], a: Tensor, b: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """FCL's nearest or deepest points of the cores `[K, 2, 3]` in the frame of b, float64 on the CPU."""
    import fcl

    request = fcl.DistanceRequest(enable_nearest_points=True, enable_signed_distance=True)
    turns, shifts = (plain(x).cpu().double().numpy() for x in (rotation, translation))
    points = np.zeros((len(turns), 2, 3))
    # FCL crashes where there is no place; elsewhere it copes with what a world within its bounds may hold
    placed = np.isfinite(turns).all((-2, -1)) & (np.abs(shifts) <= _FARTHEST).all(-1)
    for k, (i, j) in enumerate(zip(a.tolist(), b.tolist(), strict=True)):
        if not placed[k]:
            continue
        result = fcl.DistanceResult()
        moved = fcl.CollisionObject(geometries[i], fcl.Transform(turns[k], shifts[k]))
        fcl.distance(moved, fcl.CollisionObject(geometries[j]), request, result)
        points[k] = result.nearest_points
    return torch.from_numpy(points).nan_to_num()
