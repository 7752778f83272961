"""Contact manifolds of convex pairs: points of one body against a plane of the other, at the corners of where both overlap.

Contact is found once, at the start of a time step. One body, the reference, gives the plane; the other, the incident body, gives
the points: gap = n·p − h, n and h constant in the reference's frame. The plane alone is endless, so the points end where the
footprints do, and a box that overhangs can tip.

Face contact, where a face of either body is perpendicular to the direction of separation: the plane is the face's. The incident
polygon, one of the faces at the lowest vertex and of them the most anti-parallel one (or a capsule's axis, or a sphere's centre),
is cut to the reference polygon: its edges by Cyrus and Beck's line clipping, and the reference's corners are projected on it.

Edge contact, where there is no such face: the nearest points of the two support edges, or the ends of their overlap where these
are parallel. Vertices are the ends of edges here.

Of the points at most `most` stay: first the deepest, then always the one farthest from all that stay. Points that are almost one
become one: each adds its stiffness.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.contact.polytope import PolytopeTable
from pbfd_torch.contact.segments import share_of
from pbfd_torch.contact.separation import relative_pose
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.vectors import dot, rotated

_ALIGNED = 1e-5  # 1 − cosine of the largest angle between a face's normal and the separation's direction in face contact
_EDGEWISE = 1e-3  # |cosine| between incident and reference normals under which nothing is projected on the incident polygon
_PARALLEL = 1e-2  # sine under which edges are parallel
_MERGED = 1e-3  # points nearer to one another than this share of the smaller body's size are one


@dataclass(frozen=True, eq=False)
class Manifold:
    """Contact points of K pairs a, b.

    Attributes:
        point: `[K, most, 3]` on the core of the incident body, in its frame [m].
        radius: `[K]` of the incident body [m]: the gap of the rounded body is n·p − h − radius.
        normal: `[K, 3]` unit normal of the plane out of the reference body, in its frame.
        offset: `[K]` h [m], with the radius of the reference body.
        swapped: `[K]` False where b is the reference and a gives the points, True the other way round.
        mask: `[K, most]` which points there are; the first is the deepest and always there. The others repeat it.
    """

    point: Tensor
    radius: Tensor
    normal: Tensor
    offset: Tensor
    swapped: Tensor
    mask: Tensor


def manifold(
    table: PolytopeTable, a: Tensor, b: Tensor, pose_a: Tensor, pose_b: Tensor, normal: Tensor, whole: Tensor, most: int = 8
) -> Manifold:
    """Contact points of pairs. Its cost goes with the table's largest polytope: keep large hulls in a table of their own.

    table: the shapes; a, b: `[K]` rows of it; pose_a, pose_b: `[K, 3 or 4, 4]` of the shapes in the world; normal: `[K, 3]` unit,
    world, direction of separation from b to a (see `Separation`); whole: `[K]` bool, pairs of which all corners of the incident
    body count, not those of the overlap alone; most: points per pair, ≥ 1. Raises `InputError` where it is not."""
    if most < 1:
        raise InputError(f"most is {most}: must be ≥ 1 point per pair")
    aligned_a, face_a = _aligned(table, a, pose_a, -normal)
    aligned_b, face_b = _aligned(table, b, pose_b, normal)
    by_face = torch.maximum(aligned_a, aligned_b) > 1 - _ALIGNED
    # a curved body gives the points wherever it can: they move over it
    flat_a, flat_b = (aligned - 2 * _ALIGNED * table.curved[x] for aligned, x in ((aligned_a, a), (aligned_b, b)))
    swapped = torch.where(by_face, flat_a > flat_b + _ALIGNED, aligned_a > aligned_b + _ALIGNED)
    swapped = torch.where(~by_face & (table.curved[a] != table.curved[b]), table.curved[b], swapped)
    reference, incident = torch.where(swapped, a, b), torch.where(swapped, b, a)
    swap = swapped[:, None, None]
    top_a, top_b = pose_a[:, :3], pose_b[:, :3]
    base, other = torch.where(swap, top_a, top_b), torch.where(swap, top_b, top_a)
    face = torch.where(swapped, face_a, face_b)

    # from here on in the frame of the reference
    rotation, translation = relative_pose(base, other)
    vertices = rotated(rotation[:, None], table.vertices[incident]) + translation[:, None]
    toward = rotated(base[:, :3, :3].mT, torch.where(swapped[:, None], -normal, normal))
    support = dot(table.vertices[reference], toward[:, None]).amax(-1)
    curved = table.curved[reference]
    spread = torch.where(curved, dot(table.form[reference], toward.square()), 1.0)
    support = torch.where(curved, table.half[reference] * toward[:, 2].abs() + spread.sqrt(), support)
    n = torch.where(by_face[:, None], table.normals[reference, face], toward)
    offset = torch.where(by_face, table.offsets[reference, face], support)

    room = 64 * torch.finfo(n.dtype).eps * (table.size[reference] + table.size[incident] + _length(translation))
    merged = torch.maximum(_MERGED * torch.minimum(table.size[reference], table.size[incident]), room)
    corners = _take(table.vertices[reference], table.polygons[reference, face])
    footprint = _Footprint(corners, n, room)
    polygon, polygon_normal = _incident_polygon(table, incident, rotation, vertices, n, room)
    on_face, inside = footprint.cut(polygon, polygon_normal, merged)
    on_edge, met = _edge_points(
        _support_edge(table.vertices[reference], table.edges[reference], -n),
        _support_edge(vertices, table.edges[incident], n),
    )
    points = torch.cat((on_face, on_edge, vertices), 1)
    all_corners = whole[:, None].expand(vertices.shape[:2])
    valid = torch.cat((inside & by_face[:, None], met & ~by_face[:, None], all_corners), 1)
    points, mask = _spread(points, valid, dot(points, n[:, None]), most, merged)
    turn = rotation.mT[:, None]
    return Manifold(
        point=rotated(turn, points - translation[:, None]),
        radius=table.radius[incident],
        normal=n,
        offset=offset + table.radius[reference],
        swapped=swapped,
        mask=mask,
    )


def _aligned(table: PolytopeTable, shape: Tensor, pose: Tensor, outward: Tensor) -> tuple[Tensor, Tensor]:
    """Largest cosine `[K]` between a face's normal and a direction in the world `[K, 3]`, and which face; −1 where there are
    none."""
    local = rotated(pose[:, :3, :3].mT, outward)
    cosine = torch.where(table.is_flat[shape], dot(table.normals[shape], local[:, None]), -1.0)
    return cosine.max(-1)


def _incident_polygon(
    table: PolytopeTable, shape: Tensor, rotation: Tensor, vertices: Tensor, n: Tensor, room: Tensor
) -> tuple[Tensor, Tensor]:
    """Corners `[K, M, 3]` and normal `[K, 3]` of the polygon that meets a plane with normal n: of the faces at the lowest vertex,
    the most anti-parallel one. The normal is zero for a segment and a point."""
    heights = dot(vertices, n[:, None])
    polygons = table.polygons[shape]
    lowest = heights.gather(1, polygons.flatten(1)).unflatten(1, polygons.shape[1:]).amin(-1)
    facing = dot(rotated(rotation[:, None], table.normals[shape]), n[:, None])
    at_lowest = table.is_face[shape] & (lowest <= (heights.amin(-1) + room)[:, None])
    face = torch.where(at_lowest, facing, torch.inf).argmin(-1)
    row = torch.arange(len(face), device=face.device)
    return _take(vertices, polygons[row, face]), rotated(rotation, table.normals[shape, face])


@dataclass(frozen=True, eq=False)
class _Footprint:
    """The prism over a reference polygon: `corners` `[K, M, 3]`, axis n `[K, 3]`; grown by `room` `[K]` so that rounding does not
    lose what lies on its sides."""

    corners: Tensor
    n: Tensor
    room: Tensor

    def outside(self, points: Tensor) -> Tensor:
        """Distances from each side plane, > 0 outside, `[K, P, 3] → [K, P, M]`; −room for sides of length zero."""
        along = self.corners.roll(-1, 1) - self.corners
        side = torch.linalg.cross(along, self.n[:, None].expand_as(along))
        square = dot(side, side)[..., None]
        side = torch.where(square > 0, side / torch.where(square > 0, square, 1.0).sqrt(), 0.0)
        return dot(points[:, :, None] - self.corners[:, None], side[:, None]) - self.room[:, None, None]

    def cut(self, polygon: Tensor, normal: Tensor, coarse: Tensor) -> tuple[Tensor, Tensor]:
        """Where an incident polygon `[K, M, 3]` with its normal `[K, 3]` lies over the footprint: points `[K, 3 M + 1, 3]`, and
        which of them do. The last one is a corner, the deepest and least outside; it counts where the others, if any, are higher by
        more than `coarse` `[K]`: where bodies meet at the rim of a face, or do not overlap yet."""
        beyond = self.outside(polygon)
        end, far = polygon.roll(-1, 1), beyond.roll(-1, 1)
        slope = far - beyond
        steep = slope.abs() > self.room[:, None, None]
        share = torch.where(steep, -beyond / torch.where(steep, slope, 1.0), 0.0)
        enter = torch.where(steep & (slope < 0), share, 0.0).amax(-1).clamp(0, 1)
        leave = torch.where(steep & (slope > 0), share, 1.0).amin(-1).clamp(0, 1)
        over = (enter <= leave) & ~((beyond > 0) & (far > 0)).any(-1)
        ends = torch.cat([polygon + t[..., None] * (end - polygon) for t in (enter, leave)], 1)

        facing = -dot(normal, self.n)
        flat = facing > _EDGEWISE
        height = dot(polygon[:, :1] - self.corners, normal[:, None]) / torch.where(flat, -facing, 1.0)[:, None]
        projected = self.corners + height[..., None] * self.n[:, None]
        incident = _Footprint(polygon, -self.n, self.room)
        within = flat[:, None] & (incident.outside(projected) <= 0).all(-1)

        points, found = torch.cat((ends, projected), 1), torch.cat((over, over, within), 1)
        corner_height = dot(polygon, self.n[:, None])
        nearest = (corner_height + beyond.amax(-1).clamp_min(0)).argmin(-1, keepdim=True)
        deepest = torch.where(found, dot(points, self.n[:, None]), torch.inf).amin(-1, keepdim=True)
        missed = deepest > corner_height.gather(1, nearest) + coarse[:, None]
        return torch.cat((points, _take(polygon, nearest)), 1), torch.cat((found, missed), 1)


def _support_edge(vertices: Tensor, edges: Tensor, n: Tensor) -> Tensor:
    """Ends `[K, 2, 3]` of the flattest edge at the lowest vertex along n."""
    heights = dot(vertices, n[:, None])
    ends = heights.gather(1, edges.flatten(1)).unflatten(1, edges.shape[1:])
    span = heights.amax(-1) - heights.amin(-1)
    lowest = heights.amin(-1) + torch.finfo(heights.dtype).eps ** 0.5 * span
    edge = torch.where(ends.amin(-1) <= lowest[:, None], ends.amax(-1), torch.inf).argmin(-1)
    row = torch.arange(len(edge), device=edge.device)
    return _take(vertices, edges[row, edge])


def _edge_points(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Points of the second segment `[K, 2, 3]` nearest to the first, in two slots, and which slots count: one, or both ends of the
    overlap of parallel segments."""
    p, q = first[:, 0], second[:, 0]
    d, e = first[:, 1] - p, second[:, 1] - q
    gap = q - p
    dd, ee, de = dot(d, d), dot(e, e), dot(d, e)
    gd, ge = dot(gap, d), dot(gap, e)
    sine = dd * ee - de * de
    parallel = sine <= _PARALLEL**2 * dd * ee
    # nearest points of the lines, then each pulled into its segment and matched by the other's
    crossing = torch.where(parallel, 0.5, (de * gd - dd * ge) / torch.where(parallel, 1.0, sine))
    on_first = share_of(gd + crossing.clamp(0, 1) * de, dd)
    on_second = share_of(on_first * de - ge, ee)
    # the first segment's ends on the second
    ends = torch.stack((share_of(-ge, ee), share_of(de - ge, ee)), -1)
    shares = torch.where(parallel[:, None], ends, on_second[:, None])
    two = parallel & (ends[:, 0] != ends[:, 1])
    return q[:, None] + shares[..., None] * e[:, None], torch.stack((torch.ones_like(two), two), -1)


def _spread(points: Tensor, valid: Tensor, heights: Tensor, most: int, merged: Tensor) -> tuple[Tensor, Tensor]:
    """The deepest of the valid points and then the farthest from those taken, `[K, most, 3]`, and the mask of those farther than
    `merged` `[K]` from the others; their places are filled with the first."""
    index = torch.where(valid, heights, torch.inf).argmin(-1)[:, None]
    taken, there = [_take(points, index)], [torch.ones_like(valid[:, :1])]
    far = torch.where(valid, torch.inf, -1.0).to(points.dtype)
    for _ in range(most - 1):
        step = points.detach() - taken[-1].detach()
        far = torch.minimum(far, dot(step, step))
        reach, index = far.max(-1, keepdim=True)
        distinct = reach > merged[:, None] ** 2
        there.append(distinct)
        taken.append(torch.where(distinct[..., None], _take(points, index), taken[0]))
    return torch.cat(taken, 1), torch.cat(there, 1)


def _length(x: Tensor) -> Tensor:
    return dot(x, x).detach().sqrt()


def _take(vertices: Tensor, index: Tensor) -> Tensor:
    """Vertices `[K, V, 3]` by index `[K, P]`: `[K, P, 3]`."""
    return vertices.gather(1, index[..., None].expand(-1, -1, 3))
