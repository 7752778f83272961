"""Pairs of convex shapes, and how they meet by the compiled core and by PyTorch and FCL, for tests."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.contact.manifold import Manifold
from pbfd_torch.contact.polytope import Polytope, PolytopeTable, polytope_of
from pbfd_torch.contact.polytope_pairs import POINTS, PolytopePairs
from pbfd_torch.contact.separation import box_separation, fcl_separation
from pbfd_torch.contact.shapes import Box, Capsule, ConvexHull, Cylinder, Ellipsoid, Point, Shape, Sphere
from pbfd_torch.native.library import library
from pbfd_torch.native.plan_hulls import hulls
from pbfd_torch.tree.rotations import quaternion_matrix

F32, F64 = torch.float32, torch.float64
RANDOM = np.random.default_rng(0)
CUBE, SLAB = Box((0.5, 0.5, 0.5)), Box((0.5, 0.3, 0.2))
BOXES: tuple[Shape, ...] = (SLAB, Box((0.1, 0.4, 0.3)), CUBE)
PRISM, TURNED = (ConvexHull(Cylinder(0.3, 0.2).candidates()[0] @ turn) for turn in (np.eye(3), np.roll(np.eye(3), 1, 0)))
BALL = RANDOM.normal(size=(60, 3))
SOLIDS: tuple[Shape, ...] = (
    *BOXES,
    ConvexHull(SLAB.candidates()[0]),
    ConvexHull(0.3 * RANDOM.normal(size=(20, 3))),
    ConvexHull(0.3 * RANDOM.normal(size=(4, 3))),  # a tetrahedron
    ConvexHull(np.array([[x, y, z] for x, y, z in product((-0.3, 0.3), (-0.2, 0.2), (-0.1, 0.1)) if x < 0 or z < 0])),  # a wedge
    Capsule(0.1, 0.3),
    Sphere(0.2),
    Point(),
    PRISM,
    TURNED,
    ConvexHull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.7, 0.7, 0]])),  # flat
    Cylinder(0.3, 0.2),
    Ellipsoid((0.3, 0.2, 0.4)),
    ConvexHull(0.4 * BALL / np.linalg.norm(BALL, axis=1, keepdims=True)),
)
FAR = 1e3  # [m]


@dataclass(frozen=True)
class Pairs:
    """Pairs a, b `[n]` of shapes, their poses `[n, 4, 4]`, and by how much they come nearer `[n]` [m]."""

    shapes: Sequence[Shape]
    a: Tensor
    b: Tensor
    pose_a: Tensor
    pose_b: Tensor
    moves: Tensor

    def __len__(self) -> int:
        return len(self.a)

    @property
    def polytopes(self) -> list[Polytope]:
        return [polytope_of(shape) for shape in self.shapes]

    @property
    def boxes(self) -> Tensor:
        box = torch.tensor([isinstance(shape, Box) for shape in self.shapes])
        return box[self.a] & box[self.b]

    @property
    def poses(self) -> Tensor:
        """Of both, `[n, 2, 12]`."""
        both = torch.stack((self.pose_a, self.pose_b), 1)
        return torch.cat((both[..., :3, :3].flatten(-2), both[..., :3, 3]), -1)

    @property
    def size(self) -> Tensor:
        """Of the larger one of each, or of a small body, `[n]` [m]."""
        size = PolytopeTable.stack(self.polytopes).size
        return torch.maximum(size[self.a], size[self.b]).clamp_min(0.1)

    def some(self, which: Tensor) -> Pairs:
        return Pairs(self.shapes, *(x[which] for x in (self.a, self.b, self.pose_a, self.pose_b, self.moves)))

    def moving(self, moves: Tensor) -> Pairs:
        return Pairs(self.shapes, self.a, self.b, self.pose_a, self.pose_b, moves)


@dataclass(frozen=True)
class Found:
    """Of each pair: direction `[n, 3]` and distance `[n]`, contact points and their gaps."""

    direction: Tensor
    distance: Tensor
    count: Tensor
    swapped: Tensor
    normal: Tensor
    offset: Tensor
    point: Tensor
    gap: Tensor

    @property
    def there(self) -> Tensor:
        return torch.arange(POINTS) < self.count[:, None]


def meet(pairs: Pairs, dtype: torch.dtype = F64) -> Found:
    """By the core."""
    core = library()
    assert core is not None
    n = len(pairs)
    indices, numbers = hulls(pairs.polytopes)
    whole = torch.tensor(indices, dtype=torch.int32)
    which = torch.stack((pairs.a, pairs.b, pairs.boxes.long()), 1).to(torch.int32)
    real, poses, moves = (x.to(dtype).contiguous() for x in (numbers, pairs.poses, pairs.moves))
    counts, found, apart = (torch.full((n, k), -7).to(kind) for k, kind in ((2, torch.int32), (4 + 4 * POINTS, dtype), (5, dtype)))

    def place(x: Tensor) -> ctypes.c_void_p:
        return ctypes.c_void_p(x.data_ptr())

    given = place(whole), place(real), n, place(which), place(poses), place(moves)
    core.functions.pbfd_meet(dtype.itemsize, *given, place(counts), place(found), place(apart))
    points = found[:, 4:].unflatten(1, (POINTS, 4))
    return Found(
        apart[:, :3], apart[:, 4], counts[:, 0], counts[:, 1] != 0, found[:, :3], found[:, 3], points[..., :3], points[..., 3]
    )


def expected(pairs: Pairs) -> Found:
    """By PyTorch and FCL: every shape is a collider twice, as a and as b, and each pair is in a world of its own."""
    count, n = len(pairs.shapes), len(pairs)
    polytopes = pairs.polytopes
    all_pairs = [(i * count + j, i, count + j) for i, j in product(range(count), range(count))]
    are_boxes = [isinstance(shape, Box) for shape in pairs.shapes]
    frames = torch.eye(4, dtype=F64).repeat(2 * count, 1, 1)
    finder = PolytopePairs.of(all_pairs, range(2 * count), frames, 2 * polytopes, 2 * are_boxes, POINTS)
    poses = frames.repeat(n, 1, 1, 1)
    world = torch.arange(n)
    poses[world, pairs.a], poses[world, count + pairs.b] = pairs.pose_a, pairs.pose_b
    manifold, gap = finder._manifolds(poses, world, pairs.a * count + pairs.b, pairs.moves)
    direction, distance = torch.zeros(n, 3, dtype=F64), torch.zeros(n, dtype=F64)
    for which in (pairs.boxes, ~pairs.boxes):
        some = pairs.some(which)
        if len(some):
            place = finder.table, some.a, some.b, some.pose_a, some.pose_b
            boxes = bool(some.boxes[0])
            apart = box_separation(*place) if boxes else fcl_separation(place[0], finder._geometries, *place[1:])
            direction[which], distance[which] = apart.normal, apart.distance
    return _found(direction, distance, manifold, gap)


def _found(direction: Tensor, distance: Tensor, met: Manifold, gap: Tensor) -> Found:
    """The points that there are first."""
    order = (~met.mask).int().argsort(dim=1, stable=True)
    point = met.point.gather(1, order[..., None].expand(-1, -1, 3))
    return Found(direction, distance, met.mask.sum(1), met.swapped, met.normal, met.offset, point, gap.gather(1, order))


def random_poses(count: int, spread: float, seed: int) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    result = torch.eye(4, dtype=F64).repeat(count, 1, 1)
    quaternion = torch.randn(count, 4, generator=random, dtype=F64)
    result[:, :3, :3] = quaternion_matrix(quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True))
    result[:, :3, 3] = spread * torch.randn(count, 3, generator=random, dtype=F64)
    return result


def random_pairs(shapes: Sequence[Shape], count: int, spread: float, seed: int) -> Pairs:
    a, b = torch.randint(0, len(shapes), (2, count), generator=torch.Generator().manual_seed(seed))
    poses = random_poses(2 * count, spread, seed)
    return Pairs(shapes, a, b, poses[:count], poses[count:], torch.full((count,), FAR, dtype=F64))


def just_reached(pairs: Pairs, seed: int) -> Pairs:
    """Moves with which no pair is left out, and all corners count or do not."""
    random = torch.Generator().manual_seed(seed)
    return pairs.moving(meet(pairs).distance.clamp_min(0) + torch.rand(len(pairs), generator=random, dtype=F64) * pairs.size)


def set_apart(pairs: Pairs, distance: Tensor) -> Pairs:
    """The same with a moved along the direction of separation, so that they are about so far apart."""
    met = meet(pairs)
    pose = pairs.pose_a.clone()
    pose[:, :3, 3] += (distance - met.distance)[:, None] * met.direction
    return Pairs(pairs.shapes, pairs.a, pairs.b, pose, pairs.pose_b, pairs.moves)


def agree(ours: Found, theirs: Found, tolerance: float) -> Tensor:
    """Which pairs have the same plane and the same points, `[n]`."""
    plane = (ours.swapped == theirs.swapped) & ((ours.normal - theirs.normal).abs().amax(-1) < tolerance)
    plane &= ((ours.offset - theirs.offset).abs() < tolerance) & (ours.count == theirs.count)
    step = (ours.point.double()[:, :, None] - theirs.point[:, None]).abs().amax(-1)
    step = torch.maximum(step, (ours.gap.double()[:, :, None] - theirs.gap[:, None]).abs())
    known = step.masked_fill(~theirs.there[:, None], torch.inf).amin(2)
    missed = step.masked_fill(~ours.there[:, :, None], torch.inf).amin(1)
    near = (known < tolerance) | ~ours.there
    return plane & near.all(1) & ((missed < tolerance) | ~theirs.there).all(1)
