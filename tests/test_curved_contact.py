"""Cylinders and ellipsoids: they touch where they are lowest, roll without loss and rest without creeping."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Rollout, Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Collider, ConvexHull, Cylinder, Ellipsoid, Shape, Sphere
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.kinematics import place
from pbfd_torch.tree.rotations import quaternion_exp, quaternion_matrix
from tests.bodies import GRAVITY

R, HALF = 0.1, 0.04  # radius and half length [m]
WHEEL, BALL = Cylinder(R, HALF), Ellipsoid((R, R, R))
UPRIGHT = (math.pi / 2, 0.0, 0.0)  # turns a wheel's axis from z to y
FLOORS: dict[str, HalfSpace | Obstacle] = {
    "plane": HalfSpace(),
    "box": Obstacle("floor", Box((20.0, 1.0, 0.1)), (0.0, 0.0, -0.1)),
    "hull": Obstacle("floor", ConvexHull(Box((20.0, 1.0, 0.1)).candidates()[0]), (0.0, 0.0, -0.1)),
}


def inertia_of(shape: Shape, mass: float) -> tuple[float, float, float]:
    """About the centre [kg m²], of a solid."""
    if isinstance(shape, Cylinder):
        across = mass * (3 * shape.radius**2 + 4 * shape.half_length**2) / 12
        return across, across, 0.5 * mass * shape.radius**2
    if isinstance(shape, Sphere):
        return (0.4 * mass * shape.radius**2,) * 3
    assert isinstance(shape, Ellipsoid)
    x, y, z = (a * a for a in shape.semi_axes)
    return mass * (y + z) / 5, mass * (x + z) / 5, mass * (x + y) / 5


def body_on(shape: Shape, floor: HalfSpace | Obstacle, slope: float = 0.0, mass: float = 1.0) -> Scene:
    """A free body above a floor, with gravity tilted by `slope` [rad] towards +x."""
    x, y, z = inertia_of(shape, mass)
    links = [Link("body", joints=(Joint("free", JointKind.FREE),), mass=mass, inertia=((x, 0, 0), (0, y, 0), (0, 0, z)))]
    articulation = Articulation.from_links(links)
    rules = ContactRules(NormalForce.for_weight(mass * GRAVITY, 1e-4), CoulombFriction(0.8, 1e-3))
    terms = contact_terms(articulation, [Collider("body", "body", shape)], [floor], rules)
    gravity = torch.tensor([GRAVITY * math.sin(slope), 0.0, -GRAVITY * math.cos(slope)], dtype=torch.float64)
    return Scene(articulation, (Inertia(), *terms), gravity)


def rolled(
    scene: Scene,
    dt: float,
    duration: float,
    height: float,
    turn: tuple[float, ...] = UPRIGHT,
    speed: float = 0.0,
    integrator: Integrator[Any] | None = None,
) -> Rollout:
    """From a place at a height, at `speed` along x and rolling."""
    q = torch.zeros(1, 7, dtype=torch.float64)
    q[0, 2] = height
    q[0, 3:] = quaternion_exp(torch.tensor(turn, dtype=torch.float64))
    v = torch.zeros(1, 6, dtype=torch.float64)
    v[0, 0] = speed
    v[0, 3:] = quaternion_matrix(q[0, 3:]).T @ torch.tensor([0.0, speed / R, 0.0], dtype=torch.float64)
    simulator = Simulator(scene, dt, integrator)
    return simulator.rollout(simulator.initial_state(q, v), steps=round(duration / dt))


def surface_of(shape: Cylinder | Ellipsoid) -> np.ndarray:
    """Many points on a shape, `[n, 3]`."""
    u, w = np.meshgrid(np.linspace(0, 2 * np.pi, 721), np.linspace(0, np.pi, 361))
    if isinstance(shape, Ellipsoid):
        ball = np.stack((np.cos(u) * np.sin(w), np.sin(u) * np.sin(w), np.cos(w)), -1)
        return (ball * np.array(shape.semi_axes)).reshape(-1, 3)
    ring = shape.radius * np.stack((np.cos(u[0]), np.sin(u[0])), -1)
    return np.concatenate([np.concatenate((ring, np.full((721, 1), z)), 1) for z in (-shape.half_length, shape.half_length)])


@pytest.mark.parametrize("shape", [WHEEL, Ellipsoid((0.1, 0.2, 0.05))], ids=["cylinder", "ellipsoid"])
def test_depth_is_that_of_the_lowest_point(shape: Cylinder | Ellipsoid) -> None:
    """The deepest candidate is as deep as the deepest of many points of the surface, in any orientation: but for a rim's
    thickness, a thousandth of the smaller of radius and half length."""
    scene = body_on(shape, HalfSpace())
    (contact,) = (term for term in scene.terms if isinstance(term, CurvedContact))
    q = torch.randn(64, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    q[:, 3:] /= torch.linalg.vector_norm(q[:, 3:], dim=-1, keepdim=True)
    deepest = contact.depth(place(scene.articulation, q)).amax(-1)
    points = torch.from_numpy(surface_of(shape)) @ quaternion_matrix(q[:, 3:]).mT + q[:, None, :3]
    assert float((deepest + points[..., 2].amin(-1)).abs().max()) < 1.01e-3 * HALF


def test_curved_contact_takes_curved_shapes() -> None:
    scene = body_on(BALL, HalfSpace())
    with pytest.raises(InputError, match="'box' is a Box: must be a curved shape"):
        CurvedContact.between(scene.articulation, [Collider("box", "body", Box((1, 1, 1)))], HalfSpace())
    with pytest.raises(InputError, match="no collider can touch"):
        CurvedContact.between(scene.articulation, [], HalfSpace())


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.05])
@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("shape", [WHEEL, BALL], ids=["wheel", "ball"])
def test_rolling_keeps_its_energy(shape: Shape, floor: str, dt: float) -> None:
    """1 m/s: up to half a radian a step. Nothing slips, so nothing is lost or gained: 1 % in a second, and the whole energy is
    never above its start by more than .1 % of the motion's; it goes straight, no deeper than two tenths of a millimetre."""
    rollout = rolled(body_on(shape, FLOORS[floor]), dt, 1.0, R, speed=1.0)
    kinetic, energy = rollout.kinetic_energy[:, 0], rollout.energy[:, 0]
    assert bool(rollout.solved.all())
    assert float((kinetic[-1] / kinetic[0] - 1).abs()) < 1e-2
    assert float((energy - energy[0]).max() / kinetic[0]) < 1e-3
    assert float(rollout.q[:, 0, 1].abs().max()) < 1e-6
    assert float(rollout.penetration.max()) < 2e-4


@pytest.mark.parametrize(("shape", "share"), [(WHEEL, 2 / 3), (BALL, 5 / 7)], ids=["wheel", "ball"])
@pytest.mark.parametrize("degrees", [2.0, 5.0, 15.0])
def test_rolling_down_a_slope(shape: Shape, share: float, degrees: float) -> None:
    """a = g sin θ / (1 + I/(m r²)): ⅔ of g sin θ for a solid cylinder, 5/7 for a ball; the way after .8 s from rest at Δt = .02."""
    slope = math.radians(degrees)
    rollout = rolled(body_on(shape, FLOORS["plane"], slope), 0.02, 0.8, R)
    way = 0.5 * share * GRAVITY * math.sin(slope) * 0.8**2
    assert float(rollout.q[-1, 0, 0]) == pytest.approx(way, rel=1e-2)


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_a_round_ellipsoid_is_a_sphere(dt: float) -> None:
    """The same numbers, up to rounding, thrown askew onto a plane."""
    turn = (0.3, -0.2, 0.5)
    round_, ball = (rolled(body_on(x, HalfSpace()), dt, 1.0, 0.15, turn, 2.0) for x in (BALL, Sphere(R)))
    assert float((round_.q - ball.q).abs().max()) < 1e-6


@pytest.mark.parametrize("floor", ["plane", "box"])
@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_a_battery_lies_still(floor: str, dt: float) -> None:
    """A thin cylinder dropped flat onto its side from 2 cm: after a second it does not move, for 2 s."""
    battery = Cylinder(0.007, 0.025)
    rollout = rolled(body_on(battery, FLOORS[floor], mass=0.02), dt, 3.0, 0.027, (math.pi / 2, 0.0, 0.3))
    later = rollout.q[round(1 / dt) :, 0, :3]
    assert float((later - later[-1]).abs().max()) < 1e-6
    assert float(rollout.contact_depth[-1].max()) < 2e-4
    assert float(later[-1, 2]) == pytest.approx(0.007, abs=2e-4)


@pytest.mark.parametrize("floor", ["plane", "box"])
@pytest.mark.parametrize("tilt", [0.0, 0.3, 1.4])
def test_a_coin_comes_to_lie_flat(floor: str, tilt: float) -> None:
    """Dropped at any tilt it ends flat, and stays."""
    coin = Cylinder(0.012, 0.001)
    height = 0.012 * math.sin(tilt) + 0.001 * math.cos(tilt) + 0.003
    rollout = rolled(body_on(coin, FLOORS[floor], mass=0.008), 0.01, 2.0, height, (tilt, 0.0, 0.0))
    assert bool(rollout.solved.all())
    axis: Tensor = rollout.link_poses[-1, 0, 0, :3, 2]
    assert abs(float(axis[2])) > 1 - 1e-8
    later = rollout.q[100:, 0, :3]
    assert float((later - later[-1]).abs().max()) < 1e-6
    assert float(later[-1, 2]) == pytest.approx(0.001, abs=2e-4)
