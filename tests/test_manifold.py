"""Separation and contact manifolds of convex pairs, against closed forms and FCL."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import dataclass

import fcl
import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull as Hull
from scipy.spatial import HalfspaceIntersection
from torch import Tensor

from pbfd_torch.contact.manifold import Manifold, manifold
from pbfd_torch.contact.polytope import PolytopeTable, polytope_of
from pbfd_torch.contact.separation import Separation, box_separation, fcl_geometries, fcl_separation
from pbfd_torch.contact.shapes import Box, Capsule, ConvexHull, Cylinder, Ellipsoid, Point, Shape, Sphere
from pbfd_torch.errors import InputError
from pbfd_torch.tree.rotations import quaternion_exp, quaternion_matrix

F64 = torch.float64
RANDOM = np.random.default_rng(0)
CUBE = Box((0.5, 0.5, 0.5))
BOXES = (Box((0.5, 0.3, 0.2)), Box((0.1, 0.4, 0.3)), CUBE)
SOLIDS: tuple[Shape, ...] = (
    Box((0.5, 0.3, 0.2)),
    Capsule(0.1, 0.3),
    Sphere(0.2),
    Point(),
    ConvexHull(Cylinder(0.3, 0.2).candidates()[0]),
    ConvexHull(0.3 * RANDOM.normal(size=(20, 3))),
    ConvexHull(Ellipsoid((0.3, 0.2, 0.4)).candidates()[0]),
    ConvexHull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.7, 0.7, 0]])),  # flat
)
REQUEST = fcl.DistanceRequest(enable_nearest_points=True, enable_signed_distance=True)
Vector = tuple[float, float, float]


def pose(position: Vector, turn: Vector = (0.0, 0.0, 0.0)) -> Tensor:
    """`[4, 4]` from a position and a rotation vector."""
    result = torch.eye(4, dtype=F64)
    result[:3, :3] = quaternion_matrix(quaternion_exp(torch.tensor(turn, dtype=F64)))
    result[:3, 3] = torch.tensor(position, dtype=F64)
    return result


def random_poses(count: int, spread: float, seed: int) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    result = torch.eye(4, dtype=F64).repeat(count, 1, 1)
    result[:, :3, :3] = quaternion_matrix(torch.randn(count, 4, generator=random, dtype=F64))
    result[:, :3, 3] = spread * torch.randn(count, 3, generator=random, dtype=F64)
    return result


def random_pairs(shapes: int, count: int, spread: float, seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    a, b = torch.randint(0, shapes, (2, count), generator=torch.Generator().manual_seed(seed))
    return a, b, random_poses(count, spread, seed), random_poses(count, spread, seed + 1)


def fcl_distance(geometries: list[object], a: Tensor, b: Tensor, pose_a: Tensor, pose_b: Tensor) -> Tensor:
    def placed(shape: int, at: Tensor) -> fcl.CollisionObject:
        return fcl.CollisionObject(geometries[shape], fcl.Transform(at[:3, :3].numpy(), at[:3, 3].numpy()))

    rows = zip(a.tolist(), b.tolist(), pose_a, pose_b, strict=True)
    values = [fcl.distance(placed(i, x), placed(j, y), REQUEST, fcl.DistanceResult()) for i, j, x, y in rows]
    return torch.tensor(values, dtype=F64)


@dataclass(frozen=True, eq=False)
class Found:
    """Pairs with their separation and manifold, seen in the world."""

    separation: Separation
    manifold: Manifold
    base: Tensor
    points: Tensor  # [K, most, 3]
    normal: Tensor  # [K, 3] from b to a
    gaps: Tensor  # [K, most]

    def row(self, k: int = 0) -> np.ndarray:
        """The distinct points of one pair."""
        return self.points[k, self.manifold.mask[k]].numpy()


def find(shapes: tuple[Shape, ...], a: Tensor, b: Tensor, pose_a: Tensor, pose_b: Tensor, most: int = 8) -> Found:
    polytopes = [polytope_of(shape) for shape in shapes]
    table = PolytopeTable.stack(polytopes).to(pose_a.dtype)
    separation = fcl_separation(table, fcl_geometries(polytopes), a, b, pose_a, pose_b)
    found = manifold(table, a, b, pose_a, pose_b, separation.normal, torch.zeros_like(a) > 0, most)
    swap = found.swapped[:, None, None]
    carrier, base = torch.where(swap, pose_b, pose_a), torch.where(swap, pose_a, pose_b)
    points = found.point @ carrier[:, :3, :3].mT + carrier[:, None, :3, 3]
    local = (points - base[:, None, :3, 3]) @ base[:, :3, :3]
    gaps = (local * found.normal[:, None]).sum(-1) - found.offset[:, None] - found.radius[:, None]
    outward = (base[:, :3, :3] @ found.normal[..., None]).squeeze(-1)
    return Found(separation, found, base, points, torch.where(found.swapped[:, None], -outward, outward), gaps)


def pair(a: Shape, b: Shape, pose_a: Tensor, pose_b: Tensor | None = None, most: int = 8) -> Found:
    at_b = pose((0, 0, 0)) if pose_b is None else pose_b
    return find((a, b), torch.tensor([0]), torch.tensor([1]), pose_a[None], at_b[None], most)


def touching(count: int, gap: float, seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Random pairs of all solids, moved along the direction of separation to about this gap."""
    polytopes = [polytope_of(shape) for shape in SOLIDS]
    table, geometries = PolytopeTable.stack(polytopes), fcl_geometries(polytopes)
    a, b, pose_a, pose_b = random_pairs(len(SOLIDS), count, 0.4, seed)
    for _ in range(4):
        separation = fcl_separation(table, geometries, a, b, pose_a, pose_b)
        pose_a = pose_a.clone()
        pose_a[:, :3, 3] += (gap - separation.along)[:, None] * separation.normal
    return a, b, pose_a, pose_b


def same_points(x: np.ndarray, y: object) -> None:
    """Two sets of points are one."""
    y = np.asarray(y, dtype=np.float64)
    assert len(x) == len(y)
    distance = np.linalg.norm(x[:, None] - y, axis=-1)
    assert max(distance.min(0).max(), distance.min(1).max()) < 1e-9


@pytest.mark.parametrize("shape", SOLIDS, ids=lambda s: type(s).__name__)
def test_polytope(shape: Shape) -> None:
    """Euler's formula; planes hold their corners and nothing lies outside; normals point away from the middle."""
    p = polytope_of(shape)
    if len(p.planes) == 0:
        assert len(p.vertices) <= 2
        return
    assert len(p.vertices) - len(p.edges) + len(p.planes) == 2
    height = p.vertices @ p.planes[:, :3].T - p.planes[:, 3]
    assert height.max() < 1e-12
    assert np.abs(np.take_along_axis(height, p.polygons.T, 0)).max() < 1e-12
    np.testing.assert_allclose(np.linalg.norm(p.planes[:, :3], axis=1), 1, atol=1e-14)
    corners = p.vertices[p.polygons]
    area = np.cross(corners - corners[:, :1], np.roll(corners, -1, 1) - corners[:, :1]).sum(1)
    assert ((area * p.planes[:, :3]).sum(1) > 0).all()


def test_bad_input() -> None:
    with pytest.raises(InputError, match="0 polytopes"):
        PolytopeTable.stack([])
    with pytest.raises(InputError, match="finite"):
        polytope_of(ConvexHull(np.full((4, 3), np.nan)))
    with pytest.raises(InputError, match="most is 0"):
        pair(CUBE, CUBE, pose((0, 0, 1)), most=0)


def test_fcl_is_imported_only_when_used() -> None:
    program = "import sys, pbfd_torch.contact.manifold, pbfd_torch.contact.separation; assert 'fcl' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize("spread", [0.1, 0.4, 1.0])
def test_boxes_against_fcl(spread: float) -> None:
    """The signed distance is FCL's, apart and in penetration; the separation along the normal is the reported one."""
    a, b, pose_a, pose_b = random_pairs(len(BOXES), 400, spread, 3)
    table = PolytopeTable.stack([polytope_of(box) for box in BOXES])
    found = box_separation(table, a, b, pose_a, pose_b)
    exact = fcl_distance([fcl.Box(*(2 * x for x in box.half_extents)) for box in BOXES], a, b, pose_a, pose_b)
    torch.testing.assert_close(found.distance, exact, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.along, _separation(table, a, b, pose_a, pose_b, found.normal), atol=1e-12, rtol=0)
    slack = 1e-4 * table.size.max() + 0.05 * (-exact).clamp_min(0)
    assert (found.along <= found.distance + 1e-15).all()
    assert (found.along >= found.distance - slack).all()


@pytest.mark.parametrize("spread", [0.1, 0.4])
def test_convex_pairs_against_fcl(spread: float) -> None:
    polytopes = [polytope_of(shape) for shape in SOLIDS]
    table, geometries = PolytopeTable.stack(polytopes), fcl_geometries(polytopes)
    a, b, pose_a, pose_b = random_pairs(len(SOLIDS), 400, spread, 5)
    found = fcl_separation(table, geometries, a, b, pose_a, pose_b)
    exact = fcl_distance(geometries, a, b, pose_a, pose_b) - table.radius[a] - table.radius[b]
    torch.testing.assert_close(found.distance, exact, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.along, _separation(table, a, b, pose_a, pose_b, found.normal), atol=1e-12, rtol=0)


def _separation(table: PolytopeTable, a: Tensor, b: Tensor, pose_a: Tensor, pose_b: Tensor, n: Tensor) -> Tensor:
    """The separation along n by its definition."""
    x, y = (table.vertices[i] @ at[:, :3, :3].mT + at[:, None, :3, 3] for i, at in ((a, pose_a), (b, pose_b)))
    return (x @ n[..., None]).amin((1, 2)) - (y @ n[..., None]).amax((1, 2)) - table.radius[a] - table.radius[b]


@pytest.mark.parametrize("gap", [1e-3, 1e-9, 0.0, -1e-9, -1e-3])
def test_edges_that_just_touch(gap: float) -> None:
    """The direction and the crossing point hold through zero separation, by FCL and in closed form."""
    eighth = math.pi / 4
    at_a, at_b = pose((0.1, 0.05, math.sqrt(2) + gap), (0, eighth, 0)), pose((0, 0, 0), (eighth, 0, 0))
    found = pair(CUBE, CUBE, at_a, at_b)
    table = PolytopeTable.stack([polytope_of(CUBE)])
    zero = torch.tensor([0])
    boxes = box_separation(table, zero, zero, at_a[None], at_b[None])
    for separation in (found.separation, boxes):
        assert separation.along.item() == pytest.approx(gap, abs=1e-12)
        np.testing.assert_allclose(separation.normal[0], [0, 0, 1], atol=1e-12)
    same_points(found.row(), [[0.1, 0, math.sqrt(0.5) + gap]])
    np.testing.assert_allclose(found.normal[0], [0, 0, 1], atol=1e-12)


HALF = math.pi / 2
TOP = [[x, y, 0.5] for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
SMALL = [[0.2 + x, 0.3 + y, 0.5] for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
TAN = math.tan(math.pi / 8) / 2
SPIKE = ConvexHull(np.array([[0.0, 0, -1], [1, 0, 0], [-1, 1, 0], [-1, -1, 0]]))
WEDGE = ConvexHull(np.array([[-1.0, 0, 0], [1, 0, 0], [-1, 1, -1], [1, 1, -1], [-1, -1, -1], [1, -1, -1]]))
LAYOUTS: dict[str, tuple[Shape, Shape, Tensor, list[list[float]]]] = {
    "equal boxes": (CUBE, CUBE, pose((0, 0, 1)), TOP),
    "small box on a large one": (Box((0.1, 0.1, 0.1)), CUBE, pose((0.2, 0.3, 0.6)), SMALL),
    "large box on a small one": (CUBE, Box((0.1, 0.1, 0.1)), pose((0, 0, 0.6)), [[x / 5, y / 5, 0.1] for x, y, _ in TOP]),
    "overhanging box": (CUBE, CUBE, pose((0.7, 0.2, 1)), [[x, y, 0.5] for x in (0.2, 0.5) for y in (-0.3, 0.5)]),
    "octagon": (
        CUBE,
        CUBE,
        pose((0, 0, 1), (0, 0, math.pi / 4)),
        [[x, y, 0.5] for s in (-TAN, TAN) for t in (-0.5, 0.5) for x, y in ((s, t), (t, s))],
    ),
    "capsule on a box": (Capsule(0.1, 0.3), CUBE, pose((0, 0, 0.6), (HALF, 0, 0)), [[0, -0.3, 0.6], [0, 0.3, 0.6]]),
    "box on a capsule": (CUBE, Capsule(0.1, 0.3), pose((0, 0.6, 0)), [[0, 0, -0.3], [0, 0, 0.3]]),
    "capsule across an edge": (Capsule(0.1, 0.3), CUBE, pose((0, 0.4, 0.6), (HALF, 0, 0)), [[0, 0.1, 0.6], [0, 0.5, 0.6]]),
    "parallel capsules": (Capsule(0.1, 0.3), Capsule(0.1, 0.3), pose((0.2, 0, 0.2)), [[0.2, 0, -0.1], [0.2, 0, 0.3]]),
    "crossing capsules": (Capsule(0.1, 0.3), Capsule(0.1, 0.3), pose((0.2, 0.1, 0.2), (HALF, 0, 0)), [[0.2, 0, 0.2]]),
    "sphere on a face": (Sphere(0.1), CUBE, pose((0.3, 0.2, 0.6)), [[0.3, 0.2, 0.6]]),
    "sphere at a corner": (Sphere(0.1), CUBE, pose((0.54, 0.54, 0.54)), [[0.54, 0.54, 0.54]]),
    "coincident spheres": (Sphere(0.1), Sphere(0.1), pose((0, 0, 0)), [[0, 0, 0]]),
    "spike on a box": (SPIKE, CUBE, pose((0.1, 0.2, 1.5)), [[0.1, 0.2, 0.5]]),
    "spike on a wedge": (SPIKE, WEDGE, pose((0.2, 0, 1.01)), [[0.2, 0, 0.01]]),
    "corner against corner": (CUBE, CUBE, pose((1.1, 1.1, 1.1)), [[0.6, 0.6, 0.6]]),
    "edge along edge": (CUBE, CUBE, pose((0.3, 1.1, 1.1)), [[-0.2, 0.6, 0.6], [0.5, 0.6, 0.6]]),
}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_known_points(layout: tuple[Shape, Shape, Tensor, list[list[float]]]) -> None:
    """The deepest points in the world, each as deep as the bodies."""
    a, b, at, expected = layout
    found = pair(a, b, at)
    deepest = found.gaps[0, found.manifold.mask[0]].numpy() < found.separation.along.item() + 1e-6
    same_points(found.row()[deepest], expected)
    np.testing.assert_allclose(found.gaps[0].min(), found.separation.along.item(), atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_overlap_area_is_exact(seed: int) -> None:
    """Boxes turned and shifted on one another: the points are the corners of the intersection of both rectangles."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(-0.45, 0.45, 2)
    angle = random.uniform(0, math.pi)
    found = pair(BOXES[0], CUBE, pose((x, y, 0.699), (0, 0, angle)))
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    sides = np.concatenate((np.eye(2), -np.eye(2), turn.T, -turn.T))
    center = np.array([x, y])
    upper = np.array([0.5, 0.3])
    limits = np.concatenate((np.full(4, 0.5), upper + turn.T @ center, upper - turn.T @ center))
    exact = HalfspaceIntersection(np.column_stack((sides, -limits)), 0.5 * center)
    points = found.row()[:, :2]
    assert (points @ sides.T - limits).max() < 1e-9
    assert Hull(points).volume == pytest.approx(Hull(exact.intersections).volume, abs=1e-9)


def test_faces_apart_have_exact_gaps() -> None:
    """A box tilted a little over a larger one: the gap of every point is its distance from the other body by FCL."""
    turns = 0.05 * np.random.default_rng(1).normal(size=(20, 3))
    poses = torch.stack([pose((0.1, 0.1, 0.73), (x, y, z + 0.5)) for x, y, z in turns.tolist()])
    shapes = (CUBE, Point(), Box((0.2, 0.2, 0.2)))
    zero = torch.zeros(20, dtype=torch.long)
    found = find(shapes, zero + 2, zero, poses, torch.eye(4, dtype=F64).expand(20, 4, 4))
    assert (found.manifold.mask.sum(-1) >= 3).all()
    point_pose = torch.eye(4, dtype=F64).repeat(160, 1, 1)
    point_pose[:, :3, 3] = found.points.flatten(0, 1)
    zeros = torch.zeros(160, dtype=torch.long)
    exact = find(shapes, zeros + 1, zeros, point_pose, found.base.repeat_interleave(8, 0)).separation.distance
    torch.testing.assert_close(found.gaps.flatten(), exact, atol=1e-12, rtol=0)


@pytest.mark.parametrize("gap", [-5e-3, 0.0, 5e-3])
def test_random_pairs(gap: float) -> None:
    """The deepest point is as deep as the bodies, to the manifold's resolution; all points are on the incident body."""
    a, b, pose_a, pose_b = touching(200, gap, 11)
    found = find(SOLIDS, a, b, pose_a, pose_b)
    m = found.manifold
    assert m.mask[:, 0].all()
    assert all(x.isfinite().all() for x in (m.point, m.normal, m.offset))
    table = PolytopeTable.stack([polytope_of(shape) for shape in SOLIDS])
    missed = found.gaps.amin(-1) - found.separation.along
    assert (missed > -1e-12).all()
    assert (missed <= 1e-3 * torch.minimum(table.size[a], table.size[b]) + 1e-12).all()
    assert torch.equal(found.gaps[:, 0], found.gaps.amin(-1))
    carrier = torch.where(m.swapped, b, a)
    outside = (m.point @ table.normals[carrier].mT - table.offsets[carrier][:, None])[table.is_face[carrier].any(-1)]
    assert outside.max() < 1e-9


@pytest.mark.parametrize("gap", [-5e-3, 5e-3])
def test_moving_both_bodies_moves_the_points(gap: float) -> None:
    a, b, pose_a, pose_b = touching(200, gap, 11)
    solid = (a != SOLIDS.index(Point())) & (b != SOLIDS.index(Point()))  # a point pushed in at an edge is as deep from both faces
    a, b, pose_a, pose_b = a[solid], b[solid], pose_a[solid], pose_b[solid]
    motion = random_poses(1, 1.0, 7)
    first, second = find(SOLIDS, a, b, pose_a, pose_b), find(SOLIDS, a, b, motion @ pose_a, motion @ pose_b)
    torch.testing.assert_close(second.separation.distance, first.separation.distance, atol=1e-12, rtol=0)
    torch.testing.assert_close(second.normal, first.normal @ motion[0, :3, :3].T, atol=1e-9, rtol=0)
    back = (second.points - motion[0, :3, 3]) @ motion[0, :3, :3]
    apart = torch.cdist(back, first.points)
    assert max(apart.amin(1).max(), apart.amin(2).max()) < 1e-8


def test_row_by_row_the_same_bits() -> None:
    a, b, pose_a, pose_b = touching(8, -1e-3, 17)
    whole = find(SOLIDS, a, b, pose_a, pose_b)
    for k in range(8):
        row = slice(k, k + 1)
        one = find(SOLIDS, a[row], b[row], pose_a[row], pose_b[row])
        assert torch.equal(one.separation.normal, whole.separation.normal[row])
        assert torch.equal(one.manifold.point, whole.manifold.point[row])
        assert torch.equal(one.manifold.offset, whole.manifold.offset[row])


@pytest.mark.parametrize(
    "name", ["equal boxes", "overhanging box", "octagon", "capsule on a box", "parallel capsules", "spike on a wedge"]
)
def test_swapped_bodies_mirror(name: str) -> None:
    """The normal turns round; the points are the same up to the gap between both surfaces."""
    a, b, at, _ = LAYOUTS[name]
    first, second = pair(a, b, at), pair(b, a, pose((0, 0, 0)), at)
    np.testing.assert_allclose(second.normal, -first.normal, atol=1e-12)
    np.testing.assert_allclose(second.gaps[0, 0], first.gaps[0, 0], atol=1e-12)
    n = first.normal[0].numpy()
    flat = [x - np.outer(x @ n, n) for x in (first.row(), second.row())]
    same_points(*flat)


@pytest.mark.parametrize("most", [1, 3, 4, 8])
def test_reduction(most: int) -> None:
    """Prisms of 24 corners on one another: `most` points, spread out over the rim, all of them corners."""
    angle = np.pi / 12 * np.arange(24)
    ring = np.stack((0.5 * np.cos(angle), 0.5 * np.sin(angle), np.full(24, 0.2)), -1)
    prism = ConvexHull(np.concatenate((ring, ring * (1, 1, -1))))
    found = pair(prism, prism, pose((0, 0, 0.4)), most=most)
    points = found.row()
    assert len(points) == most
    np.testing.assert_allclose(np.linalg.norm(points[:, :2], axis=1), 0.5, atol=1e-9)
    if most > 2:  # a right triangle, a square, an octagon in the circle
        exact = {3: 0.25, 4: 0.5, 8: math.sqrt(0.5)}[most]
        assert Hull(points[:, :2]).volume == pytest.approx(exact, abs=1e-9)


def test_float32_agrees() -> None:
    a, b, pose_a, pose_b = touching(200, -5e-3, 13)
    double, single = find(SOLIDS, a, b, pose_a, pose_b), find(SOLIDS, a, b, pose_a.float(), pose_b.float())
    assert single.manifold.point.dtype == torch.float32
    torch.testing.assert_close(single.separation.distance.double(), double.separation.distance, atol=3e-6, rtol=0)
    assert single.manifold.mask[:, 0].all()
    same = (single.normal.double() - double.normal).norm(dim=-1) < 1e-3  # where no tie went the other way
    assert same.double().mean() > 0.95
    torch.testing.assert_close(single.gaps[same, 0].double(), double.gaps[same, 0], atol=1e-5, rtol=0)


def test_gradients_are_finite_and_those_of_differences() -> None:
    """The gap of a box that rests turned on another, by the turn of the upper one; finite also at aligned corners."""
    table = PolytopeTable.stack([polytope_of(CUBE)])
    zero = torch.tensor([0])
    below = pose((0, 0, 0))[None]

    def gaps(turn: Tensor) -> Tensor:
        at = torch.cat((quaternion_matrix(quaternion_exp(turn)), turn.new_tensor([[0.1], [0.2], [0.999]])), 1)[None]
        separation = box_separation(table, zero, zero, at, below)
        found = manifold(table, zero, zero, at, below, separation.normal, zero > 0)
        return torch.cat((found.point.flatten(), found.offset, separation.along))

    generic = torch.tensor([0.02, 0.03, 0.4], dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(gaps, (generic,), eps=1e-7, atol=1e-5)
    aligned = torch.zeros(3, dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(gaps(aligned).sum(), aligned)
    assert slope.isfinite().all()


def test_no_pairs() -> None:
    none = torch.zeros(0, dtype=torch.long)
    found = find((CUBE,), none, none, torch.zeros(0, 4, 4, dtype=F64), torch.zeros(0, 4, 4, dtype=F64))
    assert found.points.shape == (0, 8, 3)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e160, 1e308])
def test_fcl_sees_no_absurd_places(bad: float) -> None:
    """FCL crashes where a body is nowhere, or too far for its numbers: such rows never reach it, and the others are as without."""
    polytopes = [polytope_of(shape) for shape in SOLIDS]
    table, geometries = PolytopeTable.stack(polytopes), fcl_geometries(polytopes)
    a, b, pose_a, pose_b = random_pairs(len(SOLIDS), 12, 0.4, 5)
    expected = fcl_separation(table, geometries, a, b, pose_a, pose_b)
    pose_a[3, 0, 3] = bad
    found = fcl_separation(table, geometries, a, b, pose_a, pose_b)
    for one, other in ((found.normal, expected.normal), (found.distance, expected.distance)):
        assert torch.equal(one[torch.arange(12) != 3], other[torch.arange(12) != 3])
