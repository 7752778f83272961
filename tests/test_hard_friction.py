"""Dry friction where it is hard: at the edge of the cone, through detected contacts, between bodies, and in a grip."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Capsule, Collider
from pbfd_torch.models.grounds import BELT, BELT_FRICTION, RADII, RAMP_FRICTION, RAMPS, conveyor, ramp_grid, turntable
from pbfd_torch.models.setup import Setup
from pbfd_torch.models.stacks import solid_box
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from tests.bodies import GRAVITY, at, down, rises, rolled_out
from tests.states import implicit
from tests.touching_bodies import stored

HALF = (0.1, 0.1, 0.02)  # half extents of the sliding box [m], flat enough not to tip
SLIP_SPEED = 1e-3  # ε_v [m/s]
STIFFNESS = 1e8
TABLE = Obstacle("table", Box((30.0, 3.0, 0.1)), (0.0, 0.0, -0.1))
GROUNDS: dict[str, HalfSpace | Obstacle] = {
    "half-space": HalfSpace(),
    "box": TABLE,
}  # candidate points of the box; contacts detected between two boxes
MU = torch.tensor([0.1, 0.2, 0.3, 0.5, 0.8], dtype=torch.float64)


def sliding(ground: str, law: FrictionLaw, slope: Tensor | float = 0.0) -> tuple[Scene, Tensor]:
    """A box of 1 kg at its rest depth on a ground that falls off towards +x by `slope` [rad], one a world; its start."""
    articulation = Articulation.from_links([solid_box("box", HALF, 1.0)])
    colliders = [Collider("box", "box", Box(HALF))]
    terms = contact_terms(articulation, colliders, [GROUNDS[ground]], ContactRules(NormalForce(STIFFNESS), law))
    angle = torch.as_tensor(slope, dtype=torch.float64)
    q = at(HALF[2]).repeat(*angle.shape, 1)
    q[..., 2] -= (GRAVITY * torch.cos(angle) / 4 / STIFFNESS).sqrt()
    return Scene(articulation, (Inertia(), *terms), down(angle), colliders), q


def thrown(*velocity: float) -> Tensor:
    return torch.tensor([*velocity, *[0.0] * (6 - len(velocity))], dtype=torch.float64)


def sound(rollout: Rollout) -> None:
    """Every step is solved, and nothing is suspected."""
    assert bool(rollout.solved.all())
    assert not bool(rollout.hazards.any())


def run(setup: Setup, dt: float, duration: float) -> Rollout:
    rollout = rolled_out(setup.scene, dt, duration, setup.q, setup.v)
    sound(rollout)
    return rollout


def numbers(setup: Setup, rollout: Rollout, name: str) -> list[float]:
    value = setup.metrics(rollout)[name]
    return value if isinstance(value, list) else [value]


# One box on a slope or on level ground --------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_edge_of_the_cone(dt: float) -> None:
    """On a box: 2° below atan μ, v < 2 ε_v; 2° above, g (sin − μ cos), to 1 %."""
    mu = torch.tensor(RAMP_FRICTION, dtype=torch.float64).repeat_interleave(2)
    slope = torch.atan(mu) + math.radians(2) * torch.tensor([-1.0, 1.0], dtype=torch.float64).repeat(5)
    scene, q = sliding("box", CoulombFriction(mu[:, None], SLIP_SPEED), slope)
    rollout = rolled_out(scene, dt, 1.0, q)
    sound(rollout)
    speed, half = rollout.v[:, :, 0], rollout.steps // 2
    assert float(speed[:, ::2].abs().max()) < 2 * SLIP_SPEED
    gained = (speed[-1] - speed[half]) / float(rollout.time[-1] - rollout.time[half])
    exact = GRAVITY * (torch.sin(slope) - mu * torch.cos(slope))
    torch.testing.assert_close(gained[1::2], exact[1::2], rtol=0.01, atol=0)


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_ramp_grid(dt: float) -> None:
    """The scene's 25 ramps: where μ > tan of the slope a box that has settled creeps slower than ε_v; elsewhere it gains
    g (sin − μ cos), to 1 %."""
    setup = ramp_grid()
    rollout = run(setup, dt, 0.5)
    place, half = rollout.link_poses[:, 0, :, :, 3], rollout.steps // 2
    speed = torch.linalg.vector_norm(place.diff(dim=0), dim=-1) / dt
    slope = torch.deg2rad(torch.tensor(RAMPS, dtype=torch.float64)).repeat_interleave(5)
    mu = torch.tensor(RAMP_FRICTION, dtype=torch.float64).repeat(5)
    exact = GRAVITY * (torch.sin(slope) - mu * torch.cos(slope))
    assert float(speed[half:, exact < 0].max()) < SLIP_SPEED
    gained = (speed[-1] - speed[half]) / float(rollout.time[-1] - rollout.time[half + 1])
    torch.testing.assert_close(gained[exact > 0], exact[exact > 0], rtol=0.01, atol=0)


@pytest.mark.parametrize(("ground", "dt"), [("half-space", 0.025), ("box", 0.1)])
def test_critical_slope(ground: str, dt: float) -> None:
    """tan = .5, 25 s: with μ = .49 the box slides ½ g (sin − μ cos) T², to 1 %; with μ = .5, the cone itself, it goes no faster
    than ε_v."""
    slope = torch.full((2,), math.atan(0.5), dtype=torch.float64)
    mu = torch.tensor([[0.49], [0.5]], dtype=torch.float64)
    scene, q = sliding(ground, CoulombFriction(mu, SLIP_SPEED), slope)
    rollout = rolled_out(scene, dt, 25.0, q)
    sound(rollout)
    slid, held = (rollout.q[-1, :, 0] - rollout.q[0, :, 0]).tolist()
    assert slid == pytest.approx(0.5 * GRAVITY * 0.01 * math.cos(math.atan(0.5)) * 25.0**2, rel=0.01)
    assert held <= SLIP_SPEED * 25.0


@pytest.mark.parametrize("ground", GROUNDS)
def test_critical_slope_with_anchors(ground: str) -> None:
    """tan = .5, μ = .51, 25 s at Δt .1: what the box gives way is a few stretches, and nothing after the first second."""
    scene, q = sliding(ground, AnchoredFriction(0.51, 1e-5), math.atan(0.5))
    rollout = rolled_out(scene, 0.1, 25.0, q)
    sound(rollout)
    x = rollout.q[:, 0] - rollout.q[0, 0]
    assert float(x.abs().max()) <= 1e-4
    assert float((x[-1] - x[10]).abs()) <= 1e-8


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_straight_path_over_a_box(dt: float) -> None:
    """v = (4, .8, 0), μ .25: y/x = .2 to 1e-6, without turning, and ‖v‖²/(2μg) far, to .5 %."""
    scene, q = sliding("box", CoulombFriction(0.25, SLIP_SPEED))
    rollout = rolled_out(scene, dt, 2.0, q, thrown(4.0, 0.8))
    sound(rollout)
    x, y = (rollout.q[-1, :2] - rollout.q[0, :2]).tolist()
    assert y / x == pytest.approx(0.2, abs=1e-6)
    assert math.hypot(x, y) == pytest.approx((16 + 0.64) / (2 * 0.25 * GRAVITY), rel=5e-3)
    assert float(rollout.v[:, 5].abs().max()) <= 1e-6


@pytest.mark.parametrize(("dt", "tolerance"), [(0.02, 5e-3), (0.05, 1e-2)])
@pytest.mark.parametrize("ground", GROUNDS)
def test_stopping_distance(ground: str, dt: float, tolerance: float) -> None:
    """v_0 ∈ {1, 2} m/s, μ ∈ {.1, .2, .3, .5, .8}: v_0²/(2μg), to .5 % at Δt .02, and to 1 % at Δt .05 where stopping takes at least
    four steps; at rest then, below 1e-3 m/s, and energy never rises."""
    mu, speed = MU.repeat(2), torch.tensor([1.0, 2.0], dtype=torch.float64).repeat_interleave(5)
    scene, q = sliding(ground, CoulombFriction(mu[:, None], SLIP_SPEED))
    rollout = rolled_out(scene, dt, 2.2, q, speed[:, None] * thrown(1.0))
    sound(rollout)
    error = (rollout.q[-1, :, 0] - rollout.q[0, :, 0]) / (speed**2 / (2 * mu * GRAVITY)) - 1
    slow = (speed / (mu * GRAVITY) >= 4 * dt) | (dt < 0.05)
    assert int(slow.sum()) >= 9
    assert float(error[slow].abs().max()) <= tolerance
    assert float(rollout.v[-1].abs().max()) < 1e-3
    energy = rollout.energy[1:] + stored(rollout, 0 if ground == "box" else 8)
    assert rises(energy) <= 1e-9


# Grounds that move ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.02, 0.05])
def test_conveyor_scene(dt: float) -> None:
    """The box slips back v²/(2μg) on the belt, to 1 %, and goes with it then, at its speed to 1e-9."""
    setup = conveyor()
    rollout = run(setup, dt, 2.0)
    assert abs(numbers(setup, rollout, "slip_back_error")[0]) <= 0.01
    assert numbers(setup, rollout, "final_speed_m_s")[0] == pytest.approx(BELT, abs=1e-9)
    gained = rollout.v[1:, 0, 0].diff() / dt
    sliding_on = rollout.v[2:, 0, 0] < 0.9 * BELT
    torch.testing.assert_close(gained[sliding_on], torch.full_like(gained[sliding_on], BELT_FRICTION * GRAVITY), rtol=0.01, atol=0)


def test_turntable_scene() -> None:
    """ω² r below μg: the box stays at its radius, to what friction's creep and the chords of Δt .02 let it drift; above it slides
    off and never comes back."""
    setup = turntable()
    rollout = run(setup, 0.02, 3.0)
    assert numbers(setup, rollout, "inner_drift_m")[0] <= SLIP_SPEED * 3.0
    outer = torch.linalg.vector_norm(rollout.link_poses[:, 0, 1, :2, 3], dim=-1)
    assert numbers(setup, rollout, "outer_distance_m")[0] > RADII[1] + 0.1
    assert bool((outer.diff()[3:] > 0).all())


# Between bodies -------------------------------------------------------------------------------------------------------


def bodies(shapes: Sequence[Box], masses: Sequence[float], mu: Sequence[float], slope: float) -> Scene:
    """Boxes, each with its own friction on a ground that has none, that falls off towards +x."""
    links = [solid_box(f"box{k}", shape.half_extents, mass) for k, (shape, mass) in enumerate(zip(shapes, masses, strict=True))]
    articulation = Articulation.from_links(links)
    colliders = [Collider(x.name, x.name, shape, friction=m) for x, shape, m in zip(links, shapes, mu, strict=True)]
    terms = contact_terms(articulation, colliders, [HalfSpace(friction=0.0)], ContactRules(NormalForce(STIFFNESS)))
    return Scene(articulation, (Inertia(), *terms), down(slope), colliders)


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_box_pushed_by_a_box(dt: float) -> None:
    """On 20°, a box of 2 kg with μ_1 = .1 above one of 1 kg with μ_2 = .6, which alone would stay: both go down with
    a = g (sin − cos Σμm/Σm), and push each other with m_2 (a − g (sin − μ_2 cos)), to 1 %. Their own forces leave Σ m v alone:
    it changes by the ground's forces and the weight, to 1e-6 of it."""
    slope, mass, mu = math.radians(20), (2.0, 1.0), (0.1, 0.6)
    scene = bodies([Box(HALF)] * 2, mass, mu, slope)
    sunk = [math.sqrt(m * GRAVITY * math.cos(slope) / 4 / STIFFNESS) for m in mass]
    q = torch.cat([at(HALF[2] - sunk[0]), at(HALF[2] - sunk[1])])
    q[7] = 2 * HALF[0]
    rollout = rolled_out(scene, dt, 1.0, q[None])
    sound(rollout)
    half = rollout.steps // 2
    mean = sum(m * x for m, x in zip(mass, mu, strict=True)) / sum(mass)
    exact = GRAVITY * (math.sin(slope) - mean * math.cos(slope))
    gained = (rollout.v[-1, 0] - rollout.v[half, 0]) / float(rollout.time[-1] - rollout.time[half])
    assert gained[[0, 6]].tolist() == pytest.approx([exact] * 2, rel=0.01)
    push = rollout.contact_force[half:, 0, 16:, 0].sum(-1).abs()  # behind the candidates of the two boxes on the ground
    pushed = mass[1] * (exact - GRAVITY * (math.sin(slope) - mu[1] * math.cos(slope)))
    torch.testing.assert_close(push, torch.full_like(push, pushed), rtol=0.01, atol=0)
    outside = rollout.contact_force[:, 0, :16].sum(-2) + sum(mass) * scene.gravity
    changed = rollout.linear_momentum[:, 0].diff(dim=0) / dt
    assert float((changed - outside).abs().max()) <= 1e-6 * sum(mass) * GRAVITY


PINCHED, RADIUS, PRESS = 0.045, 0.02, 12.0  # mass of the capsule [kg], its radius [m], the force of each jaw [N]


def grip(law: FrictionLaw) -> tuple[Scene, Tensor]:
    """A lying capsule between two jaws on slides, each pressed against it by a motor; its start, pinched."""
    jaw = (0.01, 0.04, 0.04)
    out = 0.01 + RADIUS - 1e-4
    links = [
        Link(
            name,
            joints=(Joint(name, JointKind.SLIDE, (1.0, 0.0, 0.0)),),
            mass=0.1,
            inertia=((1e-4, 0, 0), (0, 1e-4, 0), (0, 0, 1e-4)),
        )
        for name in ("left", "right")
    ]
    links.append(solid_box("capsule", (0.02, 0.04, 0.02), PINCHED))
    articulation = Articulation.from_links(links)
    quarter = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
    colliders = [Collider(name, name, Box(jaw), (x, 0.0, 0.0)) for name, x in (("left", -out), ("right", out))]
    colliders.append(Collider("capsule", "capsule", Capsule(RADIUS, 0.02), quaternion=quarter))
    terms = contact_terms(articulation, colliders, (), ContactRules(NormalForce(STIFFNESS), law, excluded=[("left", "right")]))
    motors = Actuators.from_list(articulation, [Actuator.motor(name, name) for name in ("left", "right")])
    return Scene(articulation, (Inertia(), motors, *terms), down(), colliders), torch.cat((torch.zeros(2).double(), at(0.0)))[None]


def gripped(law: FrictionLaw, dt: float, duration: float) -> Rollout:
    """What the jaws hold for a while."""
    scene, q = grip(law)
    press = torch.tensor([PRESS, -PRESS], dtype=torch.float64)
    simulator = implicit(scene, dt)
    steps = math.ceil(duration / dt - 1e-9)
    rollout = simulator.rollout(simulator.initial_state(q, control=press[None]), press.expand(steps, 1, 2))
    sound(rollout)
    return rollout


@pytest.mark.parametrize(("dt", "duration"), [(0.01, 2.0), (0.05, 5.0)])
def test_grip_holds(dt: float, duration: float) -> None:
    """A capsule of 45 g between jaws of 12 N, μ = 1: with anchors it sinks by less than a micrometre, and then not at all."""
    height = gripped(AnchoredFriction(1.0, 1e-5), dt, duration).q[:, 0, 4]
    assert float((height - height[0]).abs().max()) < 1e-6
    assert float((height[-1] - height[len(height) // 2]).abs()) < 1e-9


def test_grip_without_anchors_creeps() -> None:
    """The same at ε_v (1 − √(1 − mg/(2μN))), to 1 %."""
    rollout = gripped(CoulombFriction(1.0, SLIP_SPEED), 0.05, 5.0)
    half = rollout.steps // 2
    sinks = float(rollout.q[half, 0, 4] - rollout.q[-1, 0, 4]) / float(rollout.time[-1] - rollout.time[half])
    assert sinks == pytest.approx(SLIP_SPEED * (1 - math.sqrt(1 - PINCHED * GRAVITY / (2 * PRESS))), rel=0.01)
