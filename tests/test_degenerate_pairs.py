"""Pairs in degenerate positions: spikes, wedges, corners and edges on one another, coincident bodies, flat hulls, contact at zero
depth (after Erleben, "Methodology for Assessing Mesh-Based Contact Point Methods", 2018); and tilted
bodies thrown at a thin plate."""

from __future__ import annotations

import math

import fcl
import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.polytope import polytope_of
from pbfd_torch.contact.separation import fcl_geometries
from pbfd_torch.contact.shapes import Box, Capsule, ConvexHull, Sphere
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.tree.rotations import quaternion_matrix
from tests.bodies import at, rolled_out
from tests.random_trees import generator
from tests.touching_bodies import free_bodies, posed

WEIGHTLESS = torch.zeros(3, dtype=torch.float64)
DEEPEST = 2e-3  # [m] how deep bodies of 1 kg at C⊥ = 1e8 N/m² may get at 2 m/s: √(m v/(Δt C⊥)) = 1.4 mm at Δt .01
Turn = tuple[float, float, float]
Shape = Box | Capsule | ConvexHull | Sphere


def hull(*points: tuple[float, float, float]) -> ConvexHull:
    return ConvexHull(np.array(points, dtype=np.float64))


def square(half: float, z: float) -> list[tuple[float, float, float]]:
    return [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]


CUBE, SLAB, ROD = Box((0.1, 0.1, 0.1)), Box((0.15, 0.15, 0.1)), Capsule(0.05, 0.1)
SPIKE = hull(*square(0.1, 0.1), (0.0, 0.0, -0.15))  # its tip below
WEDGE = hull(*square(0.1, 0.1), (-0.1, 0.0, -0.1), (0.1, 0.0, -0.1))  # its edge below, along x
SHEET = hull(*square(0.1, 0.0))
FLIP: Turn = (math.pi, 0.0, 0.0)
SIDE: Turn = (math.pi / 2, 0.0, 0.0)
EDGE: Turn = (math.pi / 4, 0.0, 0.0)  # stands a cube on its edge along x
ACROSS: Turn = (0.0, math.pi / 4, 0.0)  # … along y
LEAN = (math.pi - math.acos(1 / math.sqrt(3))) / math.sqrt(2)
CORNER: Turn = (LEAN, -LEAN, 0.0)  # stands a cube on its corner (1, 1, 1)
STILL: Turn = (0.0, 0.0, 0.0)
# upper body, how far its centre is above its lowest point, turn; lower body, how far its highest point is above its centre, turn
Pair = tuple[Shape, float, Turn, Shape, float, Turn]
PAIRS: dict[str, Pair] = {
    "spike on face": (SPIKE, 0.15, STILL, SLAB, 0.1, STILL),
    "spike on spike": (SPIKE, 0.15, STILL, SPIKE, 0.15, FLIP),
    "wedge along wedge": (WEDGE, 0.1, STILL, WEDGE, 0.1, FLIP),
    "wedge across wedge": (WEDGE, 0.1, (0.0, 0.0, math.pi / 2), WEDGE, 0.1, FLIP),
    "corner on edge": (CUBE, 0.1 * math.sqrt(3), CORNER, CUBE, 0.1 * math.sqrt(2), EDGE),
    "corner on corner": (CUBE, 0.1 * math.sqrt(3), CORNER, CUBE, 0.1 * math.sqrt(3), CORNER),
    "edge along edge": (CUBE, 0.1 * math.sqrt(2), EDGE, CUBE, 0.1 * math.sqrt(2), EDGE),
    "edge across edge": (CUBE, 0.1 * math.sqrt(2), ACROSS, CUBE, 0.1 * math.sqrt(2), EDGE),
    "sheet on face": (SHEET, 0.0, STILL, SLAB, 0.1, STILL),
    "sheet on sheet": (SHEET, 0.0, STILL, SHEET, 0.0, STILL),
    "edge of a sheet on face": (SHEET, 0.1, SIDE, SLAB, 0.1, STILL),
    "capsule along capsule": (ROD, 0.05, SIDE, ROD, 0.05, SIDE),
    "capsule across capsule": (ROD, 0.05, SIDE, ROD, 0.05, (0.0, math.pi / 2, 0.0)),
    "capsule on end on capsule": (ROD, 0.15, STILL, ROD, 0.15, STILL),
    "capsule along edge": (ROD, 0.05, (0.0, math.pi / 2, 0.0), CUBE, 0.1 * math.sqrt(2), EDGE),
}


def honest(rollout: Rollout) -> None:
    """All finite; a step that claims to be solved is, and all of them are."""
    assert bool(torch.isfinite(rollout.q).all())
    assert bool(torch.isfinite(rollout.contact_force).all())
    assert bool(rollout.solved.all())
    assert float(rollout.residual_norm.max()) <= 1e-8


def distances(upper: Shape, lower: Shape, above: Tensor, below: Tensor) -> list[float]:
    """FCL's signed distance at poses `[T, 3, 4]` of the two [m]."""
    polytopes = [polytope_of(upper), polytope_of(lower)]
    one, other = fcl_geometries(polytopes)
    request = fcl.DistanceRequest(enable_signed_distance=True)
    found = []
    for a, b in zip(above.numpy(), below.numpy(), strict=True):
        bodies = [fcl.CollisionObject(x, fcl.Transform(p[:, :3], p[:, 3])) for x, p in ((one, a), (other, b))]
        found.append(float(fcl.distance(*bodies, request, fcl.DistanceResult())) - polytopes[0].radius - polytopes[1].radius)
    return found


def turned(rollout: Rollout) -> float:
    """How far the farthest point of any body here, .2 m out at most, moves in a step by turning [m]."""
    spins = rollout.v.unflatten(-1, (-1, 6))[..., 3:]
    return 0.2 * rollout.dt * float(torch.linalg.vector_norm(spins, dim=-1).amax())


@pytest.mark.parametrize(("dt", "duration", "height"), [(0.01, 0.28, 0.2), (0.05, 0.2, 0.05)])
@pytest.mark.parametrize("name", [name for name in PAIRS if name != "sheet on sheet"])
def test_dropped_onto_a_fixed_one(name: str, dt: float, duration: float, height: float) -> None:
    """Dropped by 20 and 5 cm, the upper body balances, leans or slides off: every step is solved; by FCL the two overlap by no more
    than an impact presses them, and bodies turn in a step: its contact points and planes are those of its start. Energy is never
    above that of the start."""
    upper, up, turn, lower, low, other = PAIRS[name]
    scene = free_bodies([upper], [1.0], [Obstacle("lower", lower, quaternion=at(0.0, other)[3:])])
    rollout = rolled_out(scene, dt, duration, posed((0.0, 0.0, up + low + height, *turn)))
    honest(rollout)
    above = rollout.link_poses[:, 0, 0]
    below = torch.cat((quaternion_matrix(at(0.0, other)[3:]), torch.zeros(3, 1, dtype=torch.float64)), -1)
    assert min(distances(upper, lower, above, below.expand_as(above))) >= -DEEPEST - turned(rollout)
    assert float((rollout.energy - rollout.energy[:1]).max()) <= 1e-9


@pytest.mark.parametrize("dt", [0.01, 0.05])
@pytest.mark.parametrize("name", PAIRS)
def test_two_links_that_meet(name: str, dt: float) -> None:
    """Without weight, at 1 m/s from each side: as above; the upper body stays above the lower one, and momentum is kept to 1e-8.
    Two bodies that both have no thickness are on either side of one another at once: they may pass."""
    upper, up, turn, lower, low, other = PAIRS[name]
    scene = free_bodies([lower, upper], [1.0, 1.0], [], gravity=WEIGHTLESS)
    v = torch.zeros(1, 12, dtype=torch.float64)
    v[0, 2], v[0, 8] = 1.0, -1.0
    rollout = rolled_out(scene, dt, 0.15, posed((0.0, 0.0, 0.0, *other), (0.0, 0.0, up + low + 0.1, *turn)), v)
    honest(rollout)
    below, above = rollout.link_poses[:, 0, 0], rollout.link_poses[:, 0, 1]
    assert min(distances(upper, lower, above, below)) >= -DEEPEST - turned(rollout)
    assert name == "sheet on sheet" or float((above - below)[:, 2, 3].min()) > 0
    assert float(rollout.linear_momentum.abs().max()) <= 1e-8
    assert float((rollout.kinetic_energy - rollout.kinetic_energy[:1]).max()) <= 1e-9


@pytest.mark.parametrize("name", PAIRS)
def test_contact_at_zero_depth(name: str) -> None:
    """At rest without weight, exactly at d = 0 and zero slip: no force, and nothing moves, to 1e-12."""
    upper, up, turn, lower, low, other = PAIRS[name]
    scene = free_bodies([lower, upper], [1.0, 1.0], [], gravity=WEIGHTLESS)
    rollout = rolled_out(scene, 0.05, 0.15, posed((0.0, 0.0, 0.0, *other), (0.0, 0.0, up + low, *turn)))
    honest(rollout)
    assert float((rollout.link_poses - rollout.link_poses[:1]).abs().max()) <= 1e-12
    assert float(rollout.contact_force.abs().max()) <= 1e-12


COINCIDENT: dict[str, tuple[Shape, Turn, Shape, Turn]] = {
    "boxes": (CUBE, STILL, CUBE, STILL),
    "hulls": (hull(*square(0.1, -0.1), *square(0.1, 0.1)), STILL, hull(*square(0.1, -0.1), *square(0.1, 0.1)), STILL),
    "spheres": (Sphere(0.1), STILL, Sphere(0.1), STILL),
    "sphere in a larger one": (Sphere(0.05), STILL, Sphere(0.1), STILL),
    "sphere in a box": (Sphere(0.05), STILL, CUBE, STILL),
    "sphere on a capsule's axis": (Sphere(0.05), STILL, ROD, STILL),
    "capsule in a box": (Capsule(0.03, 0.03), STILL, CUBE, STILL),
    "crossing capsules": (ROD, SIDE, ROD, (0.0, math.pi / 2, 0.0)),
    "capsules": (ROD, STILL, ROD, STILL),
}


@pytest.mark.parametrize("fixed", [True, False], ids=["fixed", "free"])
@pytest.mark.parametrize("name", COINCIDENT)
def test_one_centre(name: str, fixed: bool) -> None:
    """With one and the same centre there is no direction to prefer: they take one and leave each other at the .1 m/s at which
    contacts let go, so that after 2 s they are apart but for 1e-5 m; momentum is kept."""
    one, turn, other, lower = COINCIDENT[name]
    if fixed:
        scene = free_bodies([one], [1.0], [Obstacle("other", other, quaternion=at(0.0, lower)[3:])], gravity=WEIGHTLESS)
        q = posed((0.0, 0.0, 0.0, *turn))
    else:
        scene = free_bodies([one, other], [1.0, 1.0], [], gravity=WEIGHTLESS)
        q = posed((0.0, 0.0, 0.0, *turn), (0.0, 0.0, 0.0, *lower))
    rollout = rolled_out(scene, 0.05, 2.0, q)
    honest(rollout)
    end = rollout.link_poses[-1, 0]
    below = torch.cat((quaternion_matrix(at(0.0, lower)[3:]), torch.zeros(3, 1, dtype=torch.float64)), -1) if fixed else end[1]
    assert distances(one, other, end[:1], below[None])[0] > -1e-5
    assert fixed or float(rollout.linear_momentum.abs().max()) <= 1e-8


# A plate of 1 cm ------------------------------------------------------------------------------------------------------

PLATE, THICK = Box((0.5, 0.5, 0.005)), 0.01
TILTED = [tuple(torch.randn(3, generator=generator(k), dtype=torch.float64).tolist()) for k in range(2)]


def thrown_at_a_plate(shape: Shape, turns: list[Turn], travel: float, fixed: bool) -> Tensor:
    """Where bodies end that go `travel` [m] down in each of three steps of .02 s: their heights over the plate's middle, and every
    start within one step of it, `[worlds]`."""
    points, radii = shape.candidates()
    starts = []
    for turn in turns:
        low = float((torch.from_numpy(points) @ quaternion_matrix(at(0.0, turn)[3:])[2] - torch.from_numpy(radii)).min())
        starts += [
            posed((0.0, 0.0, 0.0), (0.0, 0.0, THICK / 2 - low + share * travel, *turn))
            for share in torch.linspace(0.02, 1, 4).tolist()
        ]
    q = torch.cat(starts)
    if fixed:
        scene = free_bodies([shape], [1.0], [Obstacle("plate", PLATE)], gravity=WEIGHTLESS)
        q = q[:, 7:]
    else:
        scene = free_bodies([PLATE, shape], [1000.0, 1.0], [], gravity=WEIGHTLESS)
    v = torch.zeros(len(q), scene.articulation.nv, dtype=torch.float64)
    v[:, -4] = -travel / 0.02
    rollout = rolled_out(scene, 0.02, 0.06, q, v)
    honest(rollout)
    height = rollout.link_poses[-1, ..., 2, 3]
    return height[:, -1] if fixed else height[:, 1] - height[:, 0]


FAST: dict[str, tuple[Shape, list[Turn], float]] = {
    "capsule": (Capsule(0.05, 0.05), TILTED, 0.4),
    "box": (Box((0.05, 0.05, 0.05)), TILTED, 0.05),
    "plate": (Box((0.05, 0.05, 0.005)), TILTED, 0.05),
}


@pytest.mark.parametrize("fixed", [True, False], ids=["obstacle", "link"])
@pytest.mark.parametrize("name", FAST)
def test_tilted_bodies_do_not_jump_a_plate(name: str, fixed: bool) -> None:
    """A tilted capsule stops in front of a plate of 1 cm at 20 m/s and Δt .02, which is .4 m a step. A tilted box is safe at half
    its side in a step: faster, the impact may turn corners through that were no contact points."""
    shape, turns, travel = FAST[name]
    assert float(thrown_at_a_plate(shape, turns, travel, fixed).min()) > 0
