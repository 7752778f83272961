"""Round bodies that touch at one point: they meet where they come closest, as exact as closed forms say, and follow each other."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Rollout, Scene, Simulator
from pbfd_torch.contact.closest import Meeting, RoundShape, RoundTable
from pbfd_torch.contact.polytope import polytope_of
from pbfd_torch.contact.shapes import Capsule, Collider, Cylinder, Ellipsoid, Shape, Sphere
from pbfd_torch.tensors.vectors import rotated
from pbfd_torch.terms.approaching import closest_approach
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.rotations import quaternion_matrix
from tests.bodies import GRAVITY
from tests.random_trees import generator
from tests.touching_bodies import posed

BALL, LARGE = 0.1, 0.3  # radii [m]
ACROSS = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)  # turns an axis from z to −y
EGG, LENS = Ellipsoid((0.1, 0.2, 0.15)), Ellipsoid((0.25, 0.2, 0.08))


@dataclass(frozen=True)
class Nearest:
    """The gap `[*]` of two shapes in the frames of two bodies, the normal `[*, 3]` out of the second, and whether they touch at one
    point `[*]`."""

    gap: Tensor
    normal: Tensor
    alone: Tensor


def nearest(one: Shape, other: Shape, bodies: Tensor) -> Nearest:
    """Of bodies `[*, 2, 4, 4]`, the less wide one first."""
    polytopes = [polytope_of(x) for x in (one, other)]
    first, second = (RoundShape(rim, bool(x.flat.any()), torch.eye(4)) for x in polytopes if (rim := x.round) is not None)
    assert first.wide <= second.wide
    table, frames = RoundTable.of([(first, second)], bodies.new_zeros(())), bodies[..., None, :, :3, :]
    sought = table.sought(frames)
    both, plane = table.met(frames, sought)
    out = rotated(frames[..., 1, :, :3], plane.normal)
    seen, _ = closest_approach(Meeting(both, torch.ones_like(sought.alone)), frames, out)
    return Nearest(seen.gap[..., 0], seen.normal[..., 0, :], sought.alone[..., 0])


def placed(turns: Tensor, place: Tensor) -> Tensor:
    """Two bodies with these quaternions `[*, 2, 4]`, the first at a place `[*, 3]`, the second at the origin: `[*, 2, 4, 4]`."""
    bodies = torch.eye(4, dtype=place.dtype).repeat(*place.shape[:-1], 2, 1, 1)
    bodies[..., :3, :3] = quaternion_matrix(turns / torch.linalg.vector_norm(turns, dim=-1, keepdim=True))
    bodies[..., 0, :3, 3] = place
    return bodies


def random_places(worlds: int, seed: int, apart: float = 0.38, dtype: torch.dtype = torch.float64) -> Tensor:
    """Two bodies turned at random, so far apart [m] in a random direction."""
    random = generator(seed)
    turns = torch.randn(worlds, 2, 4, dtype=torch.float64, generator=random)
    out = torch.nn.functional.normalize(torch.randn(worlds, 3, dtype=torch.float64, generator=random), dim=-1)
    return placed(turns, apart * out).to(dtype)


def test_round_ellipsoids_are_balls() -> None:
    """Depth and normal to rounding."""
    bodies = random_places(32, 1)
    seen = nearest(Ellipsoid((BALL,) * 3), Ellipsoid((LARGE,) * 3), bodies)
    torch.testing.assert_close(seen.gap, torch.full_like(seen.gap, 0.38 - BALL - LARGE), rtol=0, atol=1e-12)
    torch.testing.assert_close(seen.normal, bodies[:, 0, :3, 3] / 0.38, rtol=0, atol=1e-12)


def by_brute_force(one: Ellipsoid, other: Ellipsoid, bodies: NDArray[np.float64]) -> float:
    """The largest gap over all directions, from the best of many."""
    between = bodies[0, :3, 3] - bodies[1, :3, 3]

    def gap(angles: NDArray[np.float64]) -> NDArray[np.float64]:
        u, w = angles
        n = np.stack((np.cos(u) * np.sin(w), np.sin(u) * np.sin(w), np.cos(w)))
        reach = [
            np.linalg.norm((np.array(x.semi_axes)[:, None] * (b[:3, :3].T @ n.reshape(3, -1))), axis=0)
            for x, b in zip((one, other), bodies, strict=True)
        ]
        return np.asarray(between @ n.reshape(3, -1) - sum(reach))

    grid = np.stack(np.meshgrid(np.linspace(0, 2 * np.pi, 73), np.linspace(0, np.pi, 37))).reshape(2, -1)
    start = grid[:, gap(grid).argmax()]
    best = minimize(lambda x: -gap(x)[0], start, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-14, "maxiter": 1000})
    return -float(best.fun)


@pytest.mark.parametrize(("one", "other"), [(EGG, EGG), (EGG, LENS), (LENS, LENS)], ids=["eggs", "egg, lens", "lenses"])
def test_distance_of_ellipsoids(one: Ellipsoid, other: Ellipsoid) -> None:
    """The signed distance, in and out of each other, is the largest gap of all directions; to 1e-12."""
    bodies = random_places(24, 2, apart=0.27)
    gap = nearest(one, other, bodies).gap
    expected = [by_brute_force(one, other, x) for x in bodies.numpy()]
    assert min(expected) < -0.01 < 0.01 < max(expected)  # in and out
    torch.testing.assert_close(gap, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("one", "other"), [(Cylinder(BALL, 0.5), Cylinder(LARGE, 0.6)), (Capsule(BALL, 0.5), Cylinder(LARGE, 0.6))]
)
def test_distance_of_crossed_cylinders(one: Shape, other: Shape) -> None:
    """The distance of the axes less both radii, along the common perpendicular, at any angle; to 1e-12."""
    angle = torch.linspace(0.15, math.pi - 0.15, 40, dtype=torch.float64)
    zero = torch.zeros_like(angle)
    turns = torch.stack(
        (torch.stack(((0.5 * angle).cos(), zero, (0.5 * angle).sin(), zero), -1), zero[:, None] + torch.eye(4)[0]), 1
    )
    shift = torch.stack((0.05 * angle.cos(), 0.38 + zero, 0.03 * angle.sin()), -1)  # along y they are apart
    bodies = placed(turns, shift)
    seen = nearest(one, other, bodies)
    assert bool(seen.alone.all())
    torch.testing.assert_close(seen.gap, torch.full_like(seen.gap, 0.38 - BALL - LARGE), rtol=0, atol=1e-12)
    out = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(seen.normal, out.expand_as(seen.normal), rtol=0, atol=1e-12)


def test_flat_contact_is_left_to_others() -> None:
    """Cylinders side by side, cap on cap, and cap on side, but not a rim on a side."""
    upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    places = {(0.0, 0.0, 0.99): upright, (0.38, 0.0, 0.0): upright, (0.0, 0.69, 0.0): torch.tensor(ACROSS, dtype=torch.float64)}
    tilted = torch.tensor([math.cos(0.4), math.sin(0.4), 0.0, 0.0], dtype=torch.float64)
    for place, turn in (*places.items(), ((0.0, 0.6, 0.0), tilted)):
        bodies = placed(torch.stack((turn, upright)), torch.tensor(place, dtype=torch.float64))
        assert bool(nearest(Cylinder(BALL, 0.4), Cylinder(LARGE, 0.6), bodies).alone) is (turn is tilted)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_worlds_do_not_depend_on_each_other(dtype: torch.dtype) -> None:
    """To the bit; and float32 is right to its precision."""
    bodies = random_places(9, 3, dtype=dtype)
    pairs: list[tuple[Shape, Shape]] = [(EGG, LENS), (Cylinder(0.1, 0.2), Capsule(0.1, 0.2)), (Cylinder(0.1, 0.2), EGG)]
    for shapes in pairs:
        together, exact = nearest(*shapes, bodies), nearest(*shapes, bodies.double())
        for k in range(len(bodies)):
            one = nearest(*shapes, bodies[k])
            assert torch.equal(one.gap, together.gap[k])
            assert torch.equal(one.normal, together.normal[k])
        assert float((together.gap - exact.gap).abs().max()) < (1e-14 if dtype is torch.float64 else 1e-6)


def bodies_of(shapes: tuple[Shape, ...], gravity: float, mu: float = 0.8, fixed: bool = True) -> Scene:
    """Bodies of 1 kg with the inertia of a ball; where one is `fixed`, it is the last, with its axis across."""
    inertia = 0.4 * BALL**2
    solid = ((inertia, 0.0, 0.0), (0.0, inertia, 0.0), (0.0, 0.0, inertia))
    free = [(Joint(f"free{k}", JointKind.FREE),) for k in range(len(shapes) - fixed)]
    links = [Link(f"body{k}", joints=j, mass=1.0, inertia=solid) for k, j in enumerate([*free, *[()] * fixed])]
    articulation = Articulation.from_links(links)
    turns = [ACROSS if fixed and k == len(shapes) - 1 else (1.0, 0.0, 0.0, 0.0) for k in range(len(shapes))]
    colliders = [Collider(x.name, x.name, shape, quaternion=q) for x, shape, q in zip(links, shapes, turns, strict=True)]
    rules = ContactRules(NormalForce.for_weight(GRAVITY, 1e-4), CoulombFriction(mu, 1e-3))
    terms = contact_terms(articulation, colliders, (), rules)
    return Scene(articulation, (Inertia(), *terms), torch.tensor([0.0, 0.0, -gravity], dtype=torch.float64))


def ran(scene: Scene, q: Tensor, v: Tensor, dt: float, duration: float) -> Rollout:
    simulator = Simulator(scene, dt)
    rollout = simulator.rollout(simulator.initial_state(q, v), steps=round(duration / dt))
    assert bool(rollout.solved.all())
    return rollout


@pytest.mark.parametrize("dt", [0.01, 0.02])
@pytest.mark.parametrize(
    ("shapes", "likeness"),
    [
        ((Ellipsoid((BALL,) * 3), Ellipsoid((LARGE,) * 3)), (Sphere(BALL), Sphere(LARGE))),
        ((Ellipsoid((BALL,) * 3), Cylinder(LARGE, 0.5)), (Sphere(BALL), Capsule(LARGE, 0.5))),
        ((Sphere(BALL), Cylinder(LARGE, 0.5)), (Sphere(BALL), Capsule(LARGE, 0.5))),
    ],
    ids=["ellipsoids", "ellipsoid on cylinder", "sphere on cylinder"],
)
def test_rolling_over_a_round_body(shapes: tuple[Shape, Shape], likeness: tuple[Shape, Shape], dt: float) -> None:
    """What is a ball rolls down the side of what is round as balls and capsules do: the same numbers to 1e-9, until it has left."""
    q = posed((0.03, 0.0, math.sqrt((BALL + LARGE) ** 2 - 0.03**2)))
    v = torch.tensor([[0.3, 0.1, 0.0, 0.0, 3.0, 0.0]], dtype=torch.float64)
    rolled, like = (ran(bodies_of(x, GRAVITY), q, v, dt, 0.3) for x in (shapes, likeness))
    assert float((rolled.contact_depth > 0).double().amax()) > 0
    assert float((rolled.q - like.q).abs().max()) < 1e-9


def test_collision_of_ellipsoids() -> None:
    """Round ones in space go apart as spheres do, spinning and off centre: to 1e-9. Others keep their momentum to rounding and its
    moment as well as spheres do, and gain no energy."""
    q = posed((0.25, 0.05, 0.02), (0.0, 0.0, 0.0))
    v = torch.zeros(1, 12, dtype=torch.float64)
    v[0, 0], v[0, 5], v[0, 10] = -1.0, 5.0, 2.0
    shapes = Ellipsoid((BALL,) * 3), Sphere(BALL), Ellipsoid((0.1, 0.12, 0.08))
    balls, spheres, eggs = (ran(bodies_of((x, x), 0.0, fixed=False), q, v, 0.005, 0.15) for x in shapes)
    assert float((balls.q - spheres.q).abs().max()) < 1e-9
    assert float(eggs.penetration.max()) > 0
    assert float((eggs.linear_momentum - eggs.linear_momentum[0]).abs().max()) < 1e-12
    turned = [float((x.angular_momentum - x.angular_momentum[0]).abs().max()) for x in (eggs, spheres)]
    assert turned[0] < 1.1 * turned[1]
    assert float((eggs.kinetic_energy - eggs.kinetic_energy[0]).max()) < 1e-9


@pytest.mark.parametrize("angle", [0.3, 1.0, 0.5 * math.pi])
@pytest.mark.parametrize("top", [Cylinder(BALL, 0.4), Capsule(BALL, 0.4)], ids=["cylinder", "capsule"])
def test_crossed_cylinders_rest(top: Shape, angle: float) -> None:
    """One lies across the other at one point: dropped from half a millimetre, it neither creeps nor turns from half a second on."""
    turn = np.array([-math.cos(angle), math.sin(angle), 0.0]) * math.pi / 2  # takes z to (sin, cos, 0)
    scene = bodies_of((top, Cylinder(LARGE, 0.5)), GRAVITY)
    rollout = ran(scene, posed((0, 0, 0.4005, *turn)), torch.zeros(1, 6, dtype=torch.float64), 0.01, 1.0)
    later = rollout.q[50:]
    assert float((later - later[-1]).abs().max()) < 1e-9
    assert float(rollout.contact_depth[-1].max()) == pytest.approx(1e-4, rel=1e-6)


def test_what_is_fast_is_stopped() -> None:
    """An ellipsoid at 50 m/s, half a metre a step, against another one: it does not come through."""
    scene = bodies_of((Ellipsoid((0.05, 0.06, 0.07)), Ellipsoid((0.2, 0.1, 0.15))), 0.0)
    rollout = ran(scene, posed((0.6, 0.01, 0.02)), torch.tensor([[-50.0, 0, 0, 0, 0, 0]]).double(), 0.01, 0.05)
    assert float(rollout.q[..., 0].min()) > 0.2
