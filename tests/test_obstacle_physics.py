"""Short simulations with obstacles, still and moving, and with restitution, against closed forms."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.motion import Conveyor, Lift, Turntable
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Capsule, Collider, ConvexHull, Curved, Cylinder, Point, Shape, Sphere
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.restitution import Restitution
from tests.bodies import GRAVITY, at, box_inertia, diagonal, down, free_body, rises, rolled_out

HALF = (0.1, 0.1, 0.05)
STIFF = NormalForce(1e8)
CUBE = ConvexHull(Box((0.5, 0.5, 0.5)).candidates()[0])
LYING = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # z of the shape along the world's x
# solids put so that their highest point is at z = 0, under the origin
TOPS: dict[str, Obstacle | HalfSpace] = {
    "sphere": Obstacle("sphere", Sphere(0.4), (0.0, 0.0, -0.4)),
    "capsule": Obstacle("capsule", Capsule(0.3, 0.5), (0.0, 0.0, -0.3), LYING),
    "box": Obstacle("box", Box((1.0, 1.0, 0.2)), (0.0, 0.0, -0.2)),
    "cylinder": Obstacle("cylinder", Cylinder(0.5, 0.3), (0.0, 0.0, -0.3)),
    "lying cylinder": Obstacle("cylinder", Cylinder(0.3, 0.5), (0.0, 0.0, -0.3), LYING),
    "hull": Obstacle("hull", CUBE, (0.0, 0.0, -0.5)),
    "half-space": HalfSpace(),
}


def on(
    obstacle: Obstacle | HalfSpace,
    shape: Shape,
    friction: FrictionLaw | None = None,
    law: NormalForce = STIFF,
    restitution: Restitution | None = None,
    inertia: tuple[tuple[float, float, float], ...] | None = None,
) -> Scene:
    """A free body of 1 kg, by default a uniform box, with one collider, and one obstacle."""
    articulation = free_body(1.0, box_inertia(1.0, HALF) if inertia is None else inertia)
    colliders = [Collider("shape", "body", shape)]
    kind = CurvedContact if isinstance(shape, Curved) else Contact
    contact = kind.between(articulation, colliders, obstacle, law, friction, restitution)
    return Scene(articulation, (Inertia(), contact), down(), colliders)


def moved_along(q: Tensor, x: float, y: float = 0.0) -> Tensor:
    """A configuration of a free body elsewhere."""
    return q + torch.tensor([x, y, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)


# Rest -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("top", TOPS)
@pytest.mark.parametrize(("shape", "exponent"), [(Sphere(0.05), 2.0), (Point(), 2.5)], ids=["sphere", "point"])
def test_rest_depth(top: str, exponent: float, shape: Shape) -> None:
    """Dropped by 1 mm onto the highest point of a solid, a sphere and a point rest at d = (N/C⊥)^{1/α}: to 1e-6 relative."""
    height = shape.radius if isinstance(shape, Sphere) else 0.0
    scene = on(TOPS[top], shape, CoulombFriction(0.5), NormalForce(1e6, exponent))
    rollout = rolled_out(scene, 0.05, 1.0, at(height + 1e-3))
    assert bool(rollout.solved.all())
    assert float(rollout.contact_depth[-1]) == pytest.approx((GRAVITY / 1e6) ** (1 / exponent), rel=1e-6)
    assert rises(rollout.energy) <= 1e-9


# Belts, turntables, lifts ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [Box(HALF), Point()], ids=["box", "point"])
def test_conveyor(shape: Shape) -> None:
    """Put at rest on a belt of speed v, a body gains μg, and ends at the belt's speed to 1e-9, v²/(2μg) behind it: 1 %."""
    mu, speed, dt = 0.4, 1.0, 0.02
    belt = Obstacle("belt", Box((3.0, 1.0, 0.5)), (0.0, 0.0, -0.5), motion=Conveyor((speed, 0.0, 0.0)))
    points, height = (4, 0.05) if isinstance(shape, Box) else (1, 0.0)
    rollout = rolled_out(on(belt, shape, CoulombFriction(mu)), dt, 1.0, at(height - math.sqrt(GRAVITY / points / 1e8)))
    assert bool(rollout.solved.all())
    along = rollout.v[:, 0]
    sliding = along[1:] < 0.9 * speed
    gained = (along.diff() / dt)[1:][sliding[1:] & sliding[:-1]]
    torch.testing.assert_close(gained, torch.full_like(gained, mu * GRAVITY), rtol=0.01 if points == 1 else 0.05, atol=0)
    assert float(along[-1]) == pytest.approx(speed, abs=1e-9)
    behind = speed - float(rollout.q[-1, 0] - rollout.q[0, 0])
    assert behind == pytest.approx(speed**2 / (2 * mu * GRAVITY), rel=0.01)


def _on_turntable(share: float, dt: float, duration: float) -> tuple[Rollout, float]:
    """A small box at half a metre from the axis, going round with the table; ω² r = `share` μg. Also ω."""
    mu, radius = 0.5, 0.5
    rate = math.sqrt(share * mu * GRAVITY / radius)
    table = Obstacle("table", Cylinder(3.0, 0.1), (0.0, 0.0, -0.1), motion=Turntable(rate))
    half = (0.05, 0.05, 0.01)
    scene = on(table, Box(half), AnchoredFriction(mu, 1e-5), inertia=box_inertia(1.0, half))
    q = moved_along(at(0.01 - math.sqrt(GRAVITY / 4 / 1e8)), radius)
    v = torch.tensor([0.0, rate * radius, 0.0, 0.0, 0.0, rate], dtype=torch.float64)
    return rolled_out(scene, dt, duration, q, v), rate


def test_turntable() -> None:
    """ω² r = .8 μg: a body turns with the table through one turn, and stays where it is on it to a millimetre. 1.25 μg: it slides
    outwards, relative to the table against its turn."""
    held, rate = _on_turntable(0.8, 0.02, 2.3)
    assert bool(held.solved.all())
    x, y = held.center_of_mass[:, 0], held.center_of_mass[:, 1]
    angle = rate * held.time
    there = torch.stack((torch.cos(angle) * x + torch.sin(angle) * y, torch.cos(angle) * y - torch.sin(angle) * x), -1)
    assert float((there - there[0]).abs().max()) <= 1e-3
    assert float((there[-1] - there[len(there) // 2]).abs().max()) <= 1e-6
    lost, rate = _on_turntable(1.25, 0.02, 1.0)
    assert bool(lost.solved.all())
    x, y = lost.center_of_mass[:, 0], lost.center_of_mass[:, 1]
    radius = torch.hypot(x, y)
    assert bool((radius.diff()[3:] > 0).all())
    assert float(radius[-1]) > 0.6
    assert float(torch.atan2(y, x)[-1]) % (2 * math.pi) < rate * 1.0


@pytest.mark.parametrize("dt", [0.02, 0.1])
def test_lift_at_constant_velocity(dt: float) -> None:
    """On a lift that goes steadily, obliquely, a box weighs m g and goes with it: to 1e-6."""
    velocity = (0.3, -0.2, 0.5)
    lift = Obstacle("lift", Box((1.0, 1.0, 0.1)), (0.0, 0.0, -0.1), motion=Lift.steady(velocity))
    q = at(0.05 - math.sqrt(GRAVITY / 4 / 1e8))
    rollout = rolled_out(on(lift, Box(HALF), CoulombFriction(0.5)), dt, 0.5, q, torch.tensor([*velocity, 0.0, 0.0, 0.0]).double())
    assert bool(rollout.solved.all())
    weight = rollout.contact_force.sum(-2)
    exact = torch.tensor([0.0, 0.0, GRAVITY], dtype=torch.float64)
    torch.testing.assert_close(weight, exact.expand_as(weight), rtol=0, atol=1e-6 * GRAVITY)
    carried = q[:3] + rollout.time[:, None] * torch.tensor(velocity, dtype=torch.float64)
    torch.testing.assert_close(rollout.center_of_mass, carried, rtol=0, atol=1e-6)


def test_lift_with_a_sinusoidal_path() -> None:
    """A lift at z(t) = A (1 − cos ωt), ω²A = .6 g: the floor bears m (g + z̈), z̈ the second difference of the path at the end of the
    step; to .5 % of the weight."""
    rate, dt = 2 * math.pi, 0.02
    size = 0.6 * GRAVITY / rate**2
    lift = Lift(lambda time: size * (1 - torch.cos(rate * time)))
    floor = Obstacle("lift", Box((1.0, 1.0, 0.1)), (0.0, 0.0, -0.1), motion=lift)
    rollout = rolled_out(on(floor, Box(HALF), CoulombFriction(0.5)), dt, 1.2, at(0.05 - math.sqrt(1.6 * GRAVITY / 4 / 1e8)))
    assert bool(rollout.solved.all())
    path = lift.path(rollout.time)
    exact = GRAVITY + (path[2:] - 2 * path[1:-1] + path[:-2]) / dt**2
    weight = rollout.contact_force.sum(-2)[1:, 2]
    settled = len(weight) // 4
    assert float((weight - exact)[settled:].abs().max()) <= 5e-3 * GRAVITY


# Rolling over a sphere ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rolls", [True, False], ids=["rolling", "frictionless"])
def test_sphere_over_a_sphere(rolls: bool) -> None:
    """Down from 20° off the top of a fixed sphere: v² = 2g (R + r)(cos θ_0 − cos θ)/(1 + k), k = 2/5 rolling without slip and 0
    without friction, and N = m g cos θ − m v²/(R + r): both to 2 %."""
    big, small, start = 0.5, 0.1, math.radians(20)
    inertia = 0.4 * small**2
    law = CoulombFriction(5.0, 1e-4) if rolls else None
    scene = on(Obstacle("sphere", Sphere(big)), Sphere(small), law, inertia=diagonal(inertia, inertia, inertia))
    far = big + small - math.sqrt(GRAVITY / 1e8)
    rollout = rolled_out(scene, 0.004, 0.36 if rolls else 0.3, moved_along(at(far * math.cos(start)), far * math.sin(start)))
    assert bool(rollout.solved.all())
    share = 0.4 if rolls else 0.0
    center = rollout.center_of_mass
    cosine = center[:, 2] / torch.linalg.vector_norm(center, dim=-1)
    speed = torch.linalg.vector_norm(rollout.v[1:, :3], dim=-1)
    middle = 0.5 * (cosine[1:] + cosine[:-1])  # the velocity is that over the step
    on_way = (cosine[1:] < math.cos(math.radians(30))) & (cosine[1:] > math.cos(math.radians(40)))
    assert int(on_way.sum()) >= 5
    square = 2 * GRAVITY * far * (math.cos(start) - middle) / (1 + share)
    torch.testing.assert_close(speed[on_way], square.sqrt()[on_way], rtol=0.02, atol=0)
    normal = (rollout.contact_force[:, 0] * center[1:]).sum(-1) / torch.linalg.vector_norm(center[1:], dim=-1)
    torch.testing.assert_close(normal[on_way], (GRAVITY * middle - square / far)[on_way], rtol=0, atol=0.02 * GRAVITY)
    if rolls:
        spin = torch.linalg.vector_norm(rollout.v[1:, 3:], dim=-1)
        torch.testing.assert_close(small * spin[on_way], speed[on_way], rtol=2e-3, atol=0)


# Restitution ----------------------------------------------------------------------------------------------------------


def _peaks(height: Tensor) -> list[float]:
    """The highest point of every flight after the first impact."""
    inside = height[1:-1]
    return [float(x) for x in inside[(inside > height[:-2]) & (inside >= height[2:])]]


@pytest.mark.parametrize(("dt", "height", "tolerance"), [(0.002, 0.1, 0.02), (0.01, 0.3, 0.005), (0.02, 0.5, 0.005)])
@pytest.mark.parametrize(("shape", "share"), [(Sphere(0.05), 0.6), (Sphere(0.05), 1.0), (Box(HALF), 0.8)])
@pytest.mark.parametrize("integrator", [ImplicitEuler(), EnergyMomentum()], ids=["implicit Euler", "energy-momentum"])
def test_rebound(integrator: Integrator[Any], shape: Shape, share: float, dt: float, height: float, tolerance: float) -> None:
    """Dropped from h, a body rebounds to e² h, within `tolerance` h: what the contact gives way at C⊥ = 1e8."""
    scene = on(HalfSpace(), shape, CoulombFriction(0.5), restitution=Restitution(share))
    rollout = rolled_out(scene, dt, 2.2 * math.sqrt(2 * height / GRAVITY), at(0.05 + height), integrator=integrator)
    assert bool(rollout.solved.all())
    grid = GRAVITY * dt**2 / 8  # how far the top of a flight is above the steps beside it
    assert _peaks(rollout.center_of_mass[:, 2] - 0.05)[0] == pytest.approx(height * share**2, abs=tolerance * height + grid)
    assert float(rollout.q[:, 4:6].abs().max()) <= 1e-6


@pytest.mark.parametrize(("dt", "duration"), [(0.02, 3.5), (0.05, 4.0)])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.8])
def test_bouncing_ends(share: float, dt: float, duration: float) -> None:
    """Every flight is at most e² as high as the last, but for half a step's fall, and the body ends at rest at its rest depth; at
    e = 0 it rebounds by less than 1 % of the drop."""
    scene = on(TOPS["box"], Sphere(0.05), CoulombFriction(0.5), restitution=Restitution(share))
    rollout = rolled_out(scene, dt, duration, at(0.55))
    assert bool(rollout.solved.all())
    height = rollout.center_of_mass[:, 2] - 0.05
    peaks = [0.5, *_peaks(height)]
    for before, after in itertools.pairwise(peaks):
        assert after <= max(share**2, 0.01) * before + 0.5 * GRAVITY * dt**2
    assert float(height[-1]) == pytest.approx(-math.sqrt(GRAVITY / 1e8), abs=1e-9)
    assert abs(float(rollout.v[-1, 2])) <= 1e-8


def test_energy_of_tilted_boxes_that_bounce() -> None:
    """Boxes dropped tilted, e = .5: solved, never higher than at the start, and at rest in the end with less energy."""
    scene = on(HalfSpace(), Box(HALF), CoulombFriction(0.5), restitution=Restitution(0.5))
    q = torch.stack([at(0.4), at(0.4, (0.3, 0.2, 0.0)), at(0.4, (0.7, 0.5, 0.1))])
    rollout = rolled_out(scene, 0.02, 2.4, q)
    assert bool(rollout.solved.all())
    assert float((rollout.energy - rollout.energy[:1]).max()) <= 1e-9
    assert float(rollout.v[-1].abs().max()) <= 1e-3
    assert float((rollout.energy[-1] - 0.6 * rollout.energy[0]).max()) <= 0


def test_an_impact_below_the_threshold_does_not_bounce() -> None:
    """Let go 1 mm above the floor, v⁻ = √(2 g h) = .14 m/s: bounces with a threshold of .05 m/s and not with one of .2 m/s."""
    for threshold, bounces in ((0.05, True), (0.2, False)):
        scene = on(HalfSpace(), Point(), None, restitution=Restitution(0.8, threshold))
        height = rolled_out(scene, 0.001, 0.05, at(1e-3)).center_of_mass[:, 2]
        assert (max(_peaks(height), default=0.0) > 3e-4) is bounces


def test_a_rising_floor_throws() -> None:
    """A floor that rises at w meets a ball at rest without gravity's help: it leaves at (1 + e) w, to 1 %."""
    rise = 2.0
    floor = Obstacle("floor", Box((1.0, 1.0, 0.1)), (0.0, 0.0, -0.1), motion=Lift.steady((0.0, 0.0, rise)))
    scene = on(floor, Sphere(0.05), None, restitution=Restitution(0.6))
    weightless = Scene(scene.articulation, scene.terms, torch.zeros(3, dtype=torch.float64))
    rollout = rolled_out(weightless, 0.01, 0.2, at(0.155))
    assert float(rollout.v[-1, 2]) == pytest.approx(1.6 * rise, rel=0.01)
