"""Contact points of pairs of convex shapes as the compiled core finds them, against those that PyTorch and FCL find."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.polytope import PolytopeTable, polytope_of
from pbfd_torch.contact.polytope_pairs import POINTS
from pbfd_torch.contact.shapes import Capsule, ConvexHull, Shape, Sphere
from pbfd_torch.native.library import library
from pbfd_torch.native.not_compiled import NotCompiledError
from pbfd_torch.native.plan_hulls import CORNERS, VERTICES, hulls
from pbfd_torch.tensors.vectors import dot, rotated
from pbfd_torch.tree.rotations import quaternion_exp, quaternion_matrix
from tests.meetings import (
    BOXES,
    CUBE,
    F32,
    F64,
    FAR,
    PRISM,
    RANDOM,
    SLAB,
    SOLIDS,
    Found,
    Pairs,
    agree,
    expected,
    just_reached,
    meet,
    random_pairs,
    set_apart,
)

pytestmark = pytest.mark.skipif(library() is None, reason="there is no native library")


def check_distances(pairs: Pairs, ours: Found, theirs: Found, tolerance: float = 1e-9) -> None:
    """The same where apart; no less where they overlap: all separations are lower bounds, and FCL's depth is not always exact."""
    difference = (ours.distance.double() - theirs.distance) / pairs.size
    assert (difference > -tolerance).all()
    assert (difference[theirs.distance > 0].abs() < tolerance).all()


def check_valid(pairs: Pairs, found: Found, tolerance: float) -> None:
    """Every plane holds its body, every point lies on the core of the other, and gaps are what they are said to be."""
    table = PolytopeTable.stack(pairs.polytopes).to(found.gap.dtype)
    reference, incident = torch.where(found.swapped, pairs.a, pairs.b), torch.where(found.swapped, pairs.b, pairs.a)
    swap = found.swapped[:, None, None]
    base, other = torch.where(swap, pairs.pose_a, pairs.pose_b), torch.where(swap, pairs.pose_b, pairs.pose_a)
    assert (found.count >= 1).all()
    assert ((torch.linalg.vector_norm(found.normal, dim=-1) - 1).abs() < tolerance).all()
    support = dot(table.vertices[reference], found.normal[:, None]).amax(-1) + table.radius[reference]
    # the rims of a cylinder are rounded, and the corners of the prism are not
    assert (support <= found.offset + torch.where(table.curved[reference], 1e-3, tolerance)).all()
    beyond = dot(found.point[:, :, None], table.normals[incident][:, None]) - table.offsets[incident][:, None]
    assert (torch.where(table.is_face[incident][:, None] & found.there[..., None], beyond, -1.0) < tolerance).all()
    lean = table.vertices[incident]  # points and segments have no faces
    low, high = (lean.amin(1, keepdim=True) - tolerance, lean.amax(1, keepdim=True) + tolerance)
    assert (((found.point >= low) & (found.point <= high)).all(-1) | ~found.there).all()
    place = rotated(other[:, None, :3, :3], found.point.double()) + other[:, None, :3, 3]
    seen = rotated(base[:, None, :3, :3].mT, place - base[:, None, :3, 3])
    gap = dot(seen, found.normal.double()[:, None]) - (found.offset + table.radius[incident])[:, None]
    assert ((gap - found.gap).abs()[found.there] < tolerance).all()
    assert (found.gap[:, :1] <= found.gap + tolerance)[found.there].all()


def chosen(pairs: Pairs, distance: Tensor) -> Tensor:
    """Pairs of which rounding may choose what meets: where all corners count, those of boxes are equally far from one another; and
    where a face that only stands for a curved surface is nearest, all its edges are equally near."""
    thickness = torch.tensor([x.thickness for x in pairs.polytopes], dtype=F64)
    middle = 0.5 * torch.minimum(thickness[pairs.a], thickness[pairs.b])
    curved = torch.tensor([x.rim is not None for x in pairs.polytopes])
    return curved[pairs.a] | curved[pairs.b] | ((distance > middle) & (pairs.moves > distance + middle))


def check(pairs: Pairs, differing: float = 0.02) -> None:
    """All of it; so many pairs may meet in another way, at most, and more of those that rounding chooses of."""
    ours, theirs = meet(pairs), expected(pairs)
    check_distances(pairs, ours, theirs)
    check_valid(pairs, ours, 1e-9)
    differ, loose = ~agree(ours, theirs, 1e-7), chosen(pairs, theirs.distance)
    for some, most in ((~loose, differing), (loose, 0.25)):
        assert int((differ & some).sum()) <= most * int(some.sum()), f"{int((differ & some).sum())} of {int(some.sum())} differ"


@pytest.mark.parametrize("spread", [0.05, 0.25, 0.6])
@pytest.mark.parametrize(("shapes", "count"), [(BOXES, 1000), (SOLIDS, 800)])
def test_pairs_anywhere(shapes: Sequence[Shape], count: int, spread: float) -> None:
    """Apart and overlapping, as they come."""
    check(just_reached(random_pairs(shapes, count, spread, seed=1), seed=2))


@pytest.mark.parametrize("distance", [1e-6, -1e-6, 1e-3, -1e-3, 0.02, -0.02])
@pytest.mark.parametrize("shapes", [BOXES, SOLIDS])
def test_pairs_that_touch(shapes: Sequence[Shape], distance: float) -> None:
    """Just apart, and overlapping a little."""
    pairs = random_pairs(shapes, 300, 0.6, seed=3)
    check(just_reached(set_apart(pairs, torch.full((300,), distance, dtype=F64)), seed=4))


@pytest.mark.parametrize("shapes", [BOXES, SOLIDS])
def test_pairs_at_one_point(shapes: Sequence[Shape]) -> None:
    """Where two corners touch many directions separate equally well."""
    pairs = set_apart(random_pairs(shapes, 300, 0.6, seed=3), torch.zeros(300, dtype=F64))
    ours, theirs = meet(pairs), expected(pairs)
    check_distances(pairs, ours, theirs)
    check_valid(pairs, ours, 1e-9)
    at_one = (ours.distance.abs() < 1e-9) & ~chosen(pairs, theirs.distance)
    assert int(at_one.sum()) > 100
    assert (ours.gap[at_one, 0].abs() < 1e-3 * pairs.size[at_one]).all()


def placed(shapes: Sequence[Shape], *poses: Tensor) -> Pairs:
    """The first two shapes, the second of which is at rest."""
    n = len(poses)
    still = torch.eye(4, dtype=F64).repeat(n, 1, 1)
    zero = torch.zeros(n, dtype=torch.long)
    return Pairs(shapes, zero, zero + 1, torch.stack(poses), still, torch.full((n,), 0.05, dtype=F64))


def pose(position: Sequence[float], turn: Sequence[float] = (0.0, 0.0, 0.0)) -> Tensor:
    """`[4, 4]` from a position and a rotation vector."""
    result = torch.eye(4, dtype=F64)
    result[:3, :3] = quaternion_matrix(quaternion_exp(torch.tensor(turn, dtype=F64)))
    result[:3, 3] = torch.tensor(position, dtype=F64)
    return result


@pytest.mark.parametrize("height", [0.7, 0.7001, 0.6999, 0.69])
@pytest.mark.parametrize("hull", [False, True])
def test_boxes_face_to_face(height: float, hull: bool) -> None:
    """Stacked, aligned, shifted and turned about the normal, and a little tilted."""
    top: Shape = ConvexHull(SLAB.candidates()[0]) if hull else SLAB
    turns = ((0, 0, 0), (0, 0, 0.3), (0, 0, np.pi / 4), (1e-4, 0, 0), (1e-7, 1e-7, 0.2), (1e-2, 0, 0))
    shifts = ((0.0, 0.0), (0.3, 0.1), (0.9, 0.0), (0.0, 0.75))
    check(placed((top, CUBE), *(pose((x, y, height), turn) for (x, y), turn in product(shifts, turns))), differing=0)


@pytest.mark.parametrize("depth", [-1e-3, 1e-3])
def test_edge_on_edge_and_corner_on_face(depth: float) -> None:
    """Of two cubes, one that stands on an edge or on a corner."""
    half = 0.5**0.5
    crossed = pose((0.1, 0.2, half + half + depth), (np.pi / 4, 0, 0)), pose((0, 0, 0), (0, np.pi / 4, 0))
    lean, still = (x[None] for x in crossed)
    edges = Pairs((CUBE, CUBE), torch.tensor([0]), torch.tensor([1]), lean, still, torch.tensor([0.05], dtype=F64))
    check(edges, differing=0)
    found = meet(edges)
    assert int(found.count) == 1
    assert abs(float(found.gap[0, 0]) - depth) < 1e-12
    standing = pose((0.1, 0.2, 0.5 + 0.75**0.5 + depth), (np.arctan(2**0.5) * half, -np.arctan(2**0.5) * half, 0))
    check(placed((CUBE, CUBE), standing, pose((0.1, 0.2, 0.5 + half + depth), (np.pi / 4, 0, 0))), differing=0)


def test_prisms_face_to_face() -> None:
    """Of many corners that are equally deep at most eight stay; which ones, rounding may choose."""
    pairs = placed((PRISM, PRISM), *(pose((x, 0, 0.4 + depth), (0, 0, x)) for x, depth in product((0.0, 0.1, 0.3), (0.0, -0.01))))
    ours, theirs = meet(pairs), expected(pairs)
    check_distances(pairs, ours, theirs)
    check_valid(pairs, ours, 1e-9)
    assert ours.count.tolist() == theirs.count.tolist()
    assert (ours.gap - theirs.gap).abs()[ours.there].max() < 1e-12


def test_what_is_left_out_is_too_far_apart() -> None:
    """Where no points are given none is within what the bodies move."""
    pairs = random_pairs(SOLIDS, 800, 0.6, seed=5)
    pairs = pairs.moving(0.1 * torch.rand(len(pairs), generator=torch.Generator().manual_seed(6), dtype=F64))
    ours, theirs = meet(pairs), expected(pairs)
    none = ours.count == 0
    assert 0.2 < none.double().mean() < 0.9
    assert (theirs.gap[none][theirs.there[none]] >= pairs.moves[none, None].expand(-1, POINTS)[theirs.there[none]]).all()
    differ = ~agree(ours, theirs, 1e-7) & ~none & ~chosen(pairs, theirs.distance)
    assert int(differ.sum()) <= 0.02 * int((~none).sum())


@pytest.mark.parametrize("shapes", [BOXES, SOLIDS])
def test_single_precision(shapes: Sequence[Shape]) -> None:
    """Distances as in double precision; points on their bodies, before planes that hold the others."""
    pairs = just_reached(random_pairs(shapes, 600, 0.3, seed=7), seed=8)
    ours, theirs = meet(pairs, F32), expected(pairs)
    check_distances(pairs, ours, theirs, tolerance=3e-5)
    check_valid(pairs, ours, 1e-5)
    loose = chosen(pairs, theirs.distance)
    assert int((~agree(ours, theirs, 1e-3) & ~loose).sum()) <= 0.05 * int((~loose).sum())


@pytest.mark.parametrize("dtype", [F64, F32])
def test_alone_as_among_others(dtype: torch.dtype) -> None:
    """Bit by bit."""
    pairs = just_reached(random_pairs(SOLIDS, 60, 0.3, seed=9), seed=10)
    together = vars(meet(pairs, dtype))
    for k in range(len(pairs)):
        alone = vars(meet(pairs.some(torch.tensor([k])), dtype))
        assert all(torch.equal(x[0], together[name][k]) for name, x in alone.items())


@pytest.mark.parametrize("dtype", [F64, F32])
@pytest.mark.parametrize("moves", [0.0, FAR, torch.inf, torch.nan])
def test_degenerate_places(moves: float, dtype: torch.dtype) -> None:
    """The same place for both; no place, and places as far as numbers go. Where there is one, what is said is finite."""
    count = len(SOLIDS)
    a, b = (x.flatten() for x in torch.meshgrid(torch.arange(count), torch.arange(count), indexing="ij"))
    here = torch.eye(4, dtype=F64).repeat(len(a), 1, 1)
    for value, where in product((0.0, 1e-30, 1e6, 1e30, torch.inf, -torch.inf, torch.nan), ((0, 3), (0, 0), (slice(0, 3), 3))):
        there = here.clone()
        there[:, where[0], where[1]] += value
        found = meet(Pairs(SOLIDS, a, b, there, here, torch.full((len(a),), moves, dtype=F64)), dtype)
        assert ((found.count >= 0) & (found.count <= POINTS)).all()
        if value == 0.0:
            assert found.distance.isfinite().all()
            assert found.point.isfinite().all()
            assert (found.count > 0)[found.distance <= 0].all()
        elif not abs(value) < torch.inf:
            assert (found.count == 0).all()


def test_coincident_points_and_segments() -> None:
    """Without faces any direction across both is one of separation."""
    ball, capsule = Sphere(0.2), Capsule(0.1, 0.3)
    for shapes, depth in (((ball, ball), 0.4), ((ball, capsule), 0.3), ((capsule, ball), 0.3), ((capsule, capsule), 0.2)):
        for place in (pose((0, 0, 0)), pose((0, 0, 0.1)), pose((0, 0, 0), (1.0, 0.5, 0))):
            if ball in shapes[1:] and shapes[0] is ball and float(place[2, 3]) > 0:
                continue  # these are apart
            found = meet(placed(shapes, place))
            assert abs(float(found.distance) + depth) < 1e-12


def test_hulls_that_are_too_large_are_refused() -> None:
    directions = RANDOM.normal(size=(VERTICES + 1, 3))
    ball = ConvexHull(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    angle = 2 * np.pi * np.arange(CORNERS + 1) / (CORNERS + 1)
    disc = ConvexHull(np.stack((np.cos(angle), np.sin(angle), 0 * angle), -1))
    for shape in (ball, disc):
        with pytest.raises(NotCompiledError, match="convex hull"):
            hulls([polytope_of(shape)])
