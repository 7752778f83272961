"""Whole simulations against closed forms, conservation laws and converged references. Every test states its equation."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from pbfd_torch.balance.dynamics import bias_force, center_of_mass, mass_matrix
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Point, Shape, Sphere
from pbfd_torch.models.boxes import box_slide, box_slope
from pbfd_torch.models.chains import chain_free, chain_ground, chain_heavy, chain_slope, chain_slope_drop
from pbfd_torch.models.setup import Setup
from pbfd_torch.models.spinning import dzhanibekov
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import place
from pbfd_torch.tree.rotations import quaternion_matrix, rotation_log
from tests.bodies import GRAVITY, at, box_inertia, diagonal, down, free_body, on_ground, on_world, rises, rolled_out
from tests.random_trees import generator, random_inertia
from tests.states import implicit

HALF = (0.1, 0.1, 0.05)  # half extents of the test box [m]
STIFF = NormalForce(1e8)


def run(setup: Setup, dt: float, duration: float) -> Rollout:
    """The set-up's own start, for `duration` seconds at step dt."""
    return rolled_out(setup.scene, dt, duration, setup.q, setup.v)


def metric(setup: Setup, rollout: Rollout, name: str) -> list[float]:
    value = setup.metrics(rollout)[name]
    return value if isinstance(value, list) else [value]


# Free motion ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [0.01, 0.3, 1.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rotation_oracle(seed: int, turn: float) -> None:
    """One implicit-Euler step of a free body without potential: Eq. 5 is least at R = polar((2R_n − R_{n−1}) J), J = ∫ρ x xᵀ about
    the centre of mass, which itself goes straight on, c = 2c_n − c_{n−1}: to 1e-12. The COM is not at the link's origin."""
    random = generator(seed)
    rows = random_inertia(random, 1.7)
    link = Link("body", joints=(Joint("free", JointKind.FREE),), mass=1.7, com=(0.2, -0.1, 0.3), inertia=rows)
    articulation = Articulation.from_links([link])
    scene = Scene(articulation, (Inertia(),), torch.zeros(3, dtype=torch.float64))
    simulator = implicit(scene, 0.1, solver=Descent(tolerance=1e-13))
    v = torch.randn(6, dtype=torch.float64, generator=random)
    v[3:] *= turn / 0.1 / torch.linalg.vector_norm(v[3:])
    state = simulator.initial_state(at(0.5, (0.3, 0.2, -0.7)), v)
    after, solution = simulator.step(state)
    assert bool(solution.solved)
    before, now, then = (place(articulation, q) for q in (state.q_previous, state.q, after.q))
    inertia = torch.tensor(rows, dtype=torch.float64)
    second = 0.5 * torch.trace(inertia) * torch.eye(3, dtype=torch.float64) - inertia
    ahead = 2 * now.poses[0, :3, :3] - before.poses[0, :3, :3]
    u, _, vh = torch.linalg.svd(ahead @ second)
    polar = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.sign(torch.linalg.det(u @ vh)))], dtype=torch.float64)) @ vh
    assert float((then.poses[0, :3, :3] - polar).abs().max()) <= 1e-12
    straight = 2 * center_of_mass(now) - center_of_mass(before)
    assert float((center_of_mass(then) - straight).abs().max()) <= 1e-12


@pytest.mark.parametrize("dt", [0.005, 0.02, 0.1, 0.25])
def test_projectile(dt: float) -> None:
    """p(t) = p_0 + v t + ½ g t² at every grid point, to 1e-9 from the second-order start at any step, while the body spins."""
    articulation = free_body(2.0, diagonal(0.1, 0.2, 0.25))
    v = torch.tensor([1.0, -2.0, 3.0, 0.5, -0.3, 0.8], dtype=torch.float64)
    rollout = rolled_out(Scene(articulation, (Inertia(),), down()), dt, 1.0, at(0.4), v)
    t = rollout.time[:, None]
    exact = at(0.4)[:3] + t * v[:3] + 0.5 * t * t * down()
    assert bool(rollout.solved.all())
    assert float((rollout.center_of_mass - exact).abs().max()) <= 1e-9
    assert float(rollout.time[-1]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("turn", [0.05, 0.5, 1.5])
def test_spin_down_of_the_scheme(turn: float) -> None:
    """About a principal axis the paper's integrator slows a spin by Δ' = atan2(sin Δ, 2 − cos Δ), Δ the turn per step: energy is
    lost at order Δt, and nothing else happens."""
    articulation = free_body(1.0, diagonal(0.1, 0.2, 0.25))
    scene = Scene(articulation, (Inertia(),), torch.zeros(3, dtype=torch.float64))
    v = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, turn / 0.05], dtype=torch.float64)
    rollout = rolled_out(scene, 0.05, 0.5, at(0.0), v)
    turned = rollout.v[:, 3:] * 0.05
    assert float(turned[:, :2].abs().max()) <= 1e-12
    expected = torch.atan2(torch.sin(turned[:-1, 2]), 2 - torch.cos(turned[:-1, 2]))
    assert float((turned[1:, 2] - expected).abs().max()) <= 1e-11


@pytest.mark.parametrize("dt", [0.01, 0.1])
def test_linear_momentum_of_a_free_chain(dt: float) -> None:
    """Σ m v is constant without external force: relative drift < 1e-10 over 2 s; energy never rises; every step solved."""
    setup = chain_free()
    rollout = run(setup, dt, 2.0)
    assert bool(rollout.solved.all())
    assert metric(setup, rollout, "linear_momentum_drift")[0] < 1e-10
    assert rises(rollout.energy) <= 1e-9 * float(rollout.energy[0])


def test_linear_momentum_under_internal_torques() -> None:
    """Random motor torques inside a free chain move its parts and not its centre of mass: drift of Σ m v < 1e-8 m v over .5 s."""
    setup = chain_free()
    articulation = setup.scene.articulation
    motors = Actuators.from_list(articulation, [Actuator.motor(n, n) for n in articulation.joint_names[1:]])
    simulator = implicit(Scene(articulation, (Inertia(), motors), setup.scene.gravity), 0.01)
    controls = 0.02 * torch.randn(50, 1, motors.nu, dtype=torch.float64, generator=generator(3))
    rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), controls)
    linear = rollout.linear_momentum
    assert bool(rollout.solved.all())
    assert float((linear - linear[:1]).abs().max() / linear[0].abs().max()) < 1e-8
    assert float((rollout.q[-1, 0, 7:] - rollout.q[0, 0, 7:]).abs().max()) > 0.1


def test_dzhanibekov() -> None:
    """A T-shaped body turning about its middle axis, no force: the COM stays (drift < 1e-12 m) and energy never rises."""
    setup = dzhanibekov()
    rollout = run(setup, 1 / 240, 1.5)
    assert bool(rollout.solved.all())
    assert float((rollout.center_of_mass - rollout.center_of_mass[:1]).abs().max()) < 1e-12
    assert rises(rollout.energy) <= 1e-12 * float(rollout.energy[0])


def test_tumbling_box() -> None:
    """Half sizes .1, .2, .3 m, ω = (1, 2, 3) rad/s, Δt .01: energy never rises, the angular momentum keeps its direction."""
    half = (0.1, 0.2, 0.3)
    scene = Scene(free_body(1.0, box_inertia(1.0, half)), (Inertia(),), torch.zeros(3, dtype=torch.float64))
    rollout = rolled_out(scene, 0.01, 2.0, at(0.0), torch.tensor([0.0, 0.0, 0.0, 1.0, 2.0, 3.0], dtype=torch.float64))
    assert rises(rollout.energy) <= 1e-12 * float(rollout.energy[0])
    start, end = rollout.angular_momentum[0], rollout.angular_momentum[-1]
    cosine = float(start @ end / torch.linalg.vector_norm(start) / torch.linalg.vector_norm(end))
    assert cosine > 0.99


# Joints ---------------------------------------------------------------------------------------------------------------


def test_pendulum_order() -> None:
    """θ'' = −m g l sin θ/(I + m l²) from .5 rad: the error after 1 s halves with Δt, ratio 2 ± .4 (first order)."""
    arm, mass = 0.4, 1.5
    scene = on_world(JointKind.HINGE, mass, gravity=down(), arm=arm)
    rate = mass * GRAVITY * arm / (0.02 + mass * arm**2)
    exact = solve_ivp(lambda _, y: [y[1], -rate * math.sin(y[0])], (0.0, 1.0), [0.5, 0.0], rtol=1e-12, atol=1e-13).y[0, -1]
    start = torch.tensor([0.5], dtype=torch.float64)
    errors = [float(rolled_out(scene, dt, 1.0, start).q[-1, 0]) - exact for dt in (0.02, 0.01, 0.005, 0.0025)]
    ratios = [a / b for a, b in itertools.pairwise(errors)]
    assert ratios == pytest.approx([2.0] * 3, abs=0.4)


@pytest.mark.parametrize("dt", [0.01, 0.1])
def test_mass_spring_damper_armature(dt: float) -> None:
    """A slide obeys implicit Euler's recursion: (m + a)(x' − 2x + x_{−1})/Δt² + c (x' − x)/Δt + k (x' − x_r) = m g_x."""
    mass, armature, damping, stiffness, rest = 2.0, 0.7, 3.0, 50.0, 0.2
    gravity = torch.tensor([4.0, 0.0, -9.81], dtype=torch.float64)

    def one(value: float) -> Tensor:
        return torch.tensor([value], dtype=torch.float64)

    terms = (Armature(one(armature)), JointDamping(one(damping)), JointSprings(one(stiffness), one(rest)))
    scene = on_world(JointKind.SLIDE, mass, terms, gravity)
    simulator = implicit(scene, dt)
    state = simulator.initial_state(one(0.5), one(-1.0))
    rollout = simulator.rollout(state, steps=20)
    x = torch.cat((state.q_previous, rollout.q[:, 0]))
    inertia = (mass + armature) * (x[2:] - 2 * x[1:-1] + x[:-2]) / dt**2
    balance = inertia + damping * (x[2:] - x[1:-1]) / dt + stiffness * (x[2:] - rest) - mass * 4.0
    assert float(balance.abs().max()) <= 1e-8 * mass * 9.81
    end = rest + mass * 4.0 / stiffness
    assert abs(float(rolled_out(scene, 0.1, 20.0, one(0.5)).q[-1, 0]) - end) <= 1e-9


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_dry_friction_stops_a_joint(dt: float) -> None:
    """A force τ against the motion stops mass m after v²m/(2τ), to .5 %, and holds it; it never turns back."""
    mass, torque, speed = 2.0, 3.0, 1.0
    dry = JointDryFriction(torch.tensor([torque], dtype=torch.float64), 1e-4)
    scene = on_world(JointKind.SLIDE, mass, (dry,))
    rollout = rolled_out(scene, dt, 2.0, v=torch.tensor([speed], dtype=torch.float64))
    assert float(rollout.q[-1, 0]) == pytest.approx(speed**2 * mass / (2 * torque), rel=5e-3)
    assert abs(float(rollout.v[-1, 0])) <= 1e-9
    assert float((rollout.q[:, 0].diff() >= -1e-12).double().min()) == 1


def test_dry_friction_holds_a_load() -> None:
    """Half of τ pulls: the joint creeps at slip_speed·(1 − √½) and no faster; one and a half τ: it runs off with (F − τ)/m."""
    torque = torch.tensor([3.0], dtype=torch.float64)
    for share, gravity in ((0.5, 0.75), (1.5, 2.25)):
        scene = on_world(
            JointKind.SLIDE, 2.0, (JointDryFriction(torque, 1e-3),), torch.tensor([gravity, 0, 0], dtype=torch.float64)
        )
        rollout = rolled_out(scene, 0.02, 1.0)
        if share < 1:
            assert float(rollout.v[-1, 0]) == pytest.approx(1e-3 * (1 - math.sqrt(0.5)), rel=1e-6)
        else:
            accelerations = rollout.v[:, 0].diff()[10:] / 0.02
            assert float((accelerations - 1.5 / 2).abs().max()) <= 1e-7


LIMIT = torch.tensor([2000.0], dtype=torch.float64)  # N m/rad²


def _limited(lower: float, upper: float, gravity: Tensor | None = None) -> Scene:
    scene = on_world(JointKind.HINGE, 1.0, (JointLimits(LIMIT),), gravity, arm=0.3)
    bounds = (torch.tensor([lower], dtype=torch.float64), torch.tensor([upper], dtype=torch.float64))
    return dataclasses.replace(scene, articulation=dataclasses.replace(scene.articulation, lower=bounds[0], upper=bounds[1]))


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.05, 0.1])
def test_arm_thrown_at_its_limit(dt: float) -> None:
    """The violation x obeys k x³/3 ≤ ½ I ω², energy never rises, and the arm does not leave the limit faster than it came."""
    inertia, speed = 0.02 + 0.3**2, 4.0
    rollout = rolled_out(_limited(-1.0, 0.5), dt, 1.0, v=torch.tensor([speed], dtype=torch.float64))
    assert bool(rollout.solved.all())
    deepest = float(rollout.q[:, 0].max()) - 0.5
    assert 0 < deepest <= (1.5 * inertia * speed**2 / float(LIMIT)) ** (1 / 3) * (1 + 1e-9)
    assert rises(rollout.energy) <= 1e-9
    assert float(rollout.v[:, 0].abs().max()) <= speed * (1 + 0.5 * (speed * dt) ** 2)


@pytest.mark.parametrize("dt", [0.01, 0.1])
@pytest.mark.parametrize("start", [1.2, -2.5])
def test_arm_that_starts_outside_its_limit(dt: float, start: float) -> None:
    """It recovers without NaN: every step solved, the violation is never larger than at the start, and at the end the arm is
    within its range or nearly so."""
    rollout = rolled_out(_limited(-1.0, 0.5), dt, 3.0, torch.tensor([start], dtype=torch.float64))
    assert bool(rollout.solved.all())
    assert bool(torch.isfinite(rollout.q).all())
    x = rollout.q[:, 0]
    violation = torch.maximum(x - 0.5, -1.0 - x).clamp_min(0)
    assert float(violation.max()) <= float(violation[0]) * (1 + 1e-9)
    assert float(violation[-1]) <= 0.05 * float(violation[0])
    assert rises(rollout.energy) <= 1e-9 * float(rollout.energy[0])


def test_arm_rests_on_its_limit() -> None:
    """Under gravity an arm comes to rest where k x² = m g l sin(θ): the violation of a limit under load."""
    rollout = rolled_out(_limited(0.5, 2.0, down()), 0.02, 4.0, torch.tensor([1.0], dtype=torch.float64))
    angle = float(rollout.q[-1, 0])
    assert angle < 0.5
    assert float(LIMIT) * (0.5 - angle) ** 2 == pytest.approx(GRAVITY * 0.3 * math.sin(angle), rel=1e-6)


@pytest.mark.parametrize(("dt", "duration"), [(0.1, 10.0), (0.02, 2.0)])
def test_chain_with_a_heavy_end(dt: float, duration: float) -> None:
    """Mass ratio 1000 : 1, released from the horizontal: every step solved, all finite, energy never rises."""
    rollout = run(chain_heavy(), dt, duration)
    assert bool(rollout.solved.all())
    assert bool(torch.isfinite(rollout.q).all())
    assert rises(rollout.energy) <= 1e-9 * float(rollout.kinetic_energy.max())


# Contact: rest and impact ---------------------------------------------------------------------------------------------

RESTING: dict[str, tuple[Shape, float, int, tuple[float, float, float, float]]] = {
    "box": (Box(HALF), 0.05, 4, (1.0, 0.0, 0.0, 0.0)),
    "sphere": (Sphere(0.06), 0.06, 1, (1.0, 0.0, 0.0, 0.0)),
    "capsule": (Capsule(0.05, 0.1), 0.05, 2, (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)),
}


@pytest.mark.parametrize("exponent", [2.0, 2.5])
@pytest.mark.parametrize("name", RESTING)
def test_rest_depth(name: str, exponent: float) -> None:
    """Dropped by 1 mm, a body comes to rest at depth d = (N/C⊥)^{1/α} under each of its points: to 1e-6 relative."""
    shape, height, points, turn = RESTING[name]
    scene = on_ground(
        free_body(1.0, diagonal(0.003, 0.003, 0.002)), shape, NormalForce(1e6, exponent), CoulombFriction(0.5), quaternion=turn
    )
    rollout = rolled_out(scene, 0.02, 1.5, at(height + 1e-3))
    depth = rollout.contact_depth[-1]
    touching = depth[depth > 0]
    expected = (GRAVITY / points / 1e6) ** (1 / exponent)
    assert len(touching) == points
    assert float((touching / expected - 1).abs().max()) <= 1e-6
    assert float(rollout.contact_force[-1, :, 2].sum()) == pytest.approx(GRAVITY, rel=1e-6)


def test_rest_without_drift() -> None:
    """A box at rest stays for 60 s at Δt .1: moves and turns less than 1e-9."""
    depth = math.sqrt(GRAVITY / 4 / 1e8)
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, CoulombFriction(0.5))
    rollout = rolled_out(scene, 0.1, 60.0, at(0.05 - depth))
    assert bool(rollout.solved.all())
    assert float((rollout.q - rollout.q[:1]).abs().max()) <= 1e-9


@pytest.mark.parametrize("dt", [0.01, 0.02, 0.05, 0.1])
def test_inelastic_drop(dt: float) -> None:
    """Boxes, flat and tilted, from .5 m: the centre never rises again by more than 1 % of the drop height, energy never rises, and
    they end flat and at rest; every step solved."""
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, CoulombFriction(0.5))
    q = torch.stack([at(0.65), at(0.65, (0.3, 0.2, 0.0)), at(0.65, (0.7, 0.5, 0.1))])
    rollout = rolled_out(scene, dt, 1.2, q)
    height = rollout.center_of_mass[..., 2]
    assert bool(rollout.solved.all())
    assert float((height - height.cummin(0).values).max()) <= 0.01 * 0.5
    assert rises(rollout.energy) <= 1e-9 * float(rollout.energy[0].max())
    assert float(rollout.v[-1].abs().max()) <= 1e-3
    torch.testing.assert_close(height[-1], torch.full((3,), 0.05 - math.sqrt(GRAVITY / 4 / 1e8)).double(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("dt", [0.02, 0.1])
def test_fast_impact(dt: float) -> None:
    """Chains thrown at the ground at 20 m/s, one straight and five bent and turning: every step solved, directly or by a fallback,
    energy never rises, penetration < 1 cm."""
    setup = chain_ground(6)
    random = torch.Generator().manual_seed(3)
    v = setup.v + 0.5 * torch.randn(6, setup.scene.articulation.nv, dtype=torch.float64, generator=random)
    v[0], v[:, 2] = 0.0, -20.0
    rollout = run(dataclasses.replace(setup, v=v), dt, 0.4)
    assert bool(rollout.solved.all())
    assert rises(rollout.energy) <= 1e-9 * float(rollout.energy[0].min())
    assert 0 < float(rollout.penetration.max()) < 0.01


def test_rod_pushed_into_the_ground() -> None:
    """Painlevé's rod: pitched by 45, 55 and 65°, μ 1.5, pushed along and down: finite forces, every step solved at Δt .01, and the
    energy never exceeds its start."""
    half = 0.5
    articulation = free_body(1.0, diagonal(half**2 / 300, half**2 / 3, half**2 / 3))
    colliders = [Collider(f"end{x}", "body", Point(), (x, 0.0, 0.0), margin=0.005) for x in (-half, half)]
    contact = Contact.between(articulation, colliders, HalfSpace(), NormalForce(1e7), CoulombFriction(1.5))
    angles = [math.radians(a) for a in (45, 55, 65)]
    q = torch.stack([at(half * math.sin(a) + 0.0049, (0.0, a, 0.0)) for a in angles])
    v = torch.tensor([3.0, 0.0, -1.0, 0.0, 0.0, 0.0], dtype=torch.float64).expand(3, 6)
    rollout = rolled_out(Scene(articulation, (Inertia(), contact), down()), 0.01, 0.5, q, v)
    assert bool(rollout.solved.all())
    assert bool(torch.isfinite(rollout.contact_force).all())
    assert float((rollout.energy - rollout.energy[:1]).max()) <= 1e-9 * float(rollout.energy[0].max())


# Contact: friction ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dt", "tolerance"), [(0.02, 5e-3), (0.05, 1e-2)])
def test_stopping_distance(dt: float, tolerance: float) -> None:
    """A box slides v_0²/(2μg): to .5 % at Δt .02 for every μ, to 1 % at Δt .05 where stopping takes at least four steps; then it
    rests at less than 1e-3 m/s."""
    setup = box_slide()
    rollout = run(setup, dt, 1.5)
    assert bool(rollout.solved.all())
    errors = metric(setup, rollout, "stop_distance_error")
    checked = 0
    for mu, error in zip(metric(setup, rollout, "mu"), errors, strict=True):
        if dt < 0.05 or 1.0 / (mu * GRAVITY) >= 4 * dt:
            checked += 1
            assert abs(error) <= tolerance, (mu, error)
    assert checked >= 4
    assert max(metric(setup, rollout, "final_speed_m_s")) < 1e-3
    assert rises(rollout.energy) <= 1e-9


@pytest.mark.parametrize("dt", [0.02, 0.05])
def test_slope_at_the_edge_of_the_cone(dt: float) -> None:
    """μ = .98 tan: slides ½ g (sin − μ cos) T² to 1 %. μ = 1.02 tan: creeps at v* = ε_v (1 − √(1 − W/(μN))), the root of
    (2 − y) y = W/(μN) at y = v*/ε_v, and no further than 2 % more."""
    setup = box_slope()
    rollout = run(setup, dt, 5.0)
    assert bool(rollout.solved.all())
    creep = metric(setup, rollout, "creep_m")[0]
    assert 0 < creep <= 1e-3 * (1 - math.sqrt(1 - 1 / 1.02)) * 5.0 * 1.02
    moved, exact = (metric(setup, rollout, f"slide_distance{part}_m")[1] for part in ("", "_exact"))
    assert abs(moved / exact - 1) < 0.01


def test_creep_under_a_part_of_the_cone() -> None:
    """Held at a share of the cone a box creeps at v* = ε_v (1 − √(1 − share)), for small loads ε_v W/(2μN): 10 s at Δt .05."""
    mu = 0.5
    share = torch.tensor([0.05, 0.25, 0.5, 0.9], dtype=torch.float64)
    slope = torch.atan(share * mu)
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, CoulombFriction(mu), down(slope))
    q = at(0.05).repeat(4, 1)
    q[:, 2] -= torch.sqrt(GRAVITY * torch.cos(slope) / 4 / 1e8)
    rollout = rolled_out(scene, 0.05, 10.0, q)
    moved = rollout.q[-1, :, 0] - rollout.q[0, :, 0]
    exact = 1e-3 * (1 - torch.sqrt(1 - share)) * 10.0
    torch.testing.assert_close(moved, exact, rtol=0.01, atol=0)
    assert float(moved[0]) <= 1e-3 * 0.05 / 2 * 10.0 * 1.02


@pytest.mark.parametrize("dt", [0.02, 0.05])
def test_ramp_grid(dt: float) -> None:
    """μ ∈ {.1, .3, .5, .7, 1}: 2° below atan μ a box holds, v < 2 ε_v; 2° above it slides at g (sin − μ cos), to 1 %."""
    mu = torch.tensor([0.1, 0.3, 0.5, 0.7, 1.0], dtype=torch.float64).repeat_interleave(2)
    slope = torch.atan(mu) + math.radians(2) * torch.tensor([-1.0, 1.0], dtype=torch.float64).repeat(5)
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, CoulombFriction(mu[:, None]), down(slope))
    q = at(0.05).repeat(10, 1)
    q[:, 2] -= torch.sqrt(GRAVITY * torch.cos(slope) / 4 / 1e8)
    rollout = rolled_out(scene, dt, 1.0, q)
    assert bool(rollout.solved.all())
    speed, half = rollout.v[:, :, 0], rollout.steps // 2
    assert float(speed[-1, ::2].abs().max()) < 2e-3
    acceleration = (speed[-1] - speed[half]) / float(rollout.time[-1] - rollout.time[half])
    exact = GRAVITY * (torch.sin(slope) - mu * torch.cos(slope))
    torch.testing.assert_close(acceleration[1::2], exact[1::2], rtol=0.01, atol=0)


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_straight_path(dt: float) -> None:
    """A block with v = (4, .8, 0), μ .25 goes straight: y/x = .2 to 1e-6 (a pyramid for the cone would bend it); it ends after
    ‖v‖²/(2μg), to .5 %."""
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, CoulombFriction(0.25))
    q = at(0.05 - math.sqrt(GRAVITY / 4 / 1e8))
    rollout = rolled_out(scene, dt, 2.0, q, torch.tensor([4.0, 0.8, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    x, y = (rollout.q[-1, :2] - rollout.q[0, :2]).tolist()
    assert y / x == pytest.approx(0.2, abs=1e-6)
    assert math.hypot(x, y) == pytest.approx((16 + 0.64) / (2 * 0.25 * GRAVITY), rel=5e-3)


def test_rolling_sphere() -> None:
    """A sphere rolling down 15° obeys the scheme's own law of rolling, x = Rφ, to 1e-3: with Δ the turn per step,
    m R² (Δ' − Δ)/Δt² + I (2 sin Δ' − sin(Δ' + Δ))/Δt² = m g R sin 15°; slip is what friction's creep needs, no more."""
    radius, slope, dt = 0.05, math.radians(15), 0.01
    inertia = 0.4 * radius**2
    scene = on_ground(
        free_body(1.0, diagonal(inertia, inertia, inertia)), Sphere(radius), NormalForce(1e6), CoulombFriction(1.0), down(slope)
    )
    q = at(radius - math.sqrt(GRAVITY * math.cos(slope) / 1e6))
    rollout = rolled_out(scene, dt, 0.6, q)
    assert bool(rollout.solved.all())
    turned = rollout.v[1:, 4] * dt
    pull = GRAVITY * radius * math.sin(slope) * dt**2
    balance = radius**2 * turned.diff() + inertia * (2 * torch.sin(turned[1:]) - torch.sin(turned[1:] + turned[:-1])) - pull
    assert float(balance.abs().max()) <= 1e-3 * pull
    slip = rollout.v[1:, 0] - radius * rollout.v[1:, 4]
    assert float(slip.abs().max()) <= 2e-4


@pytest.mark.parametrize("law", ["as printed", "as derived"])
def test_distance_falls_with_the_papers_friction(law: str) -> None:
    """Fig. 5: with PBFD friction the sliding distance falls monotonically with C∥ over four decades."""
    stiffness = (
        torch.logspace(8, 12, 9, dtype=torch.float64) if law == "as printed" else torch.logspace(6, 10, 9, dtype=torch.float64)
    )
    make = PbfdFriction.as_printed if law == "as printed" else PbfdFriction.as_derived
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, make(stiffness[:, None]))
    q = at(0.05 - math.sqrt(GRAVITY / 4 / 1e8)).repeat(9, 1)
    v = torch.zeros(9, 6, dtype=torch.float64)
    v[:, 0] = 1.0
    rollout = rolled_out(scene, 0.02, 0.6, q, v)
    assert bool(rollout.solved.all())
    distance = rollout.q[-1, :, 0] - rollout.q[0, :, 0]
    assert bool((distance.diff() < 0).all())
    assert float(distance[0]) > 2 * float(distance[-1])


# Chains on slopes and on the ground -----------------------------------------------------------------------------------


def test_chain_slides_down_a_slope() -> None:
    """Laid straight on 30°, μ .3: slides ½ g (sin − μ cos) T² in T = 10 s at Δt .05, to 1e-6 relative, at Coulomb's bound."""
    setup = chain_slope()
    rollout = run(setup, 0.05, 10.0)
    exact = 0.5 * GRAVITY * (math.sin(math.radians(30)) - 0.3 * math.cos(math.radians(30))) * 100.0
    assert bool(rollout.solved.all())
    assert metric(setup, rollout, "slide_distance_m")[0] == pytest.approx(exact, rel=1e-6)
    assert abs(metric(setup, rollout, "coulomb_margin_m")[0]) <= 1e-6 * exact


@pytest.mark.parametrize(("dt", "duration"), [(0.05, 10.0), (0.02, 5.0), (0.01, 2.0)])
def test_chain_dropped_onto_a_slope(dt: float, duration: float) -> None:
    """Every step solved; penetration < 1 mm; |Coulomb margin| ≤ 5 mm, the bound x(T) ≥ x_0 + ½ g (sin − μ cos) T² − μ (z(T) − z_0);
    energy never above its start by more than .1 %."""
    setup = chain_slope_drop()
    rollout = run(setup, dt, duration)
    assert bool(rollout.solved.all())
    assert 0 < float(rollout.penetration.max()) < 1e-3
    assert abs(metric(setup, rollout, "coulomb_margin_m")[0]) <= 5e-3
    start = float(rollout.energy[0].abs())
    assert float((rollout.energy - rollout.energy[:1]).max()) <= 1e-3 * start


def test_chain_dropped_onto_a_slope_in_large_steps() -> None:
    """Δt .1, 10 s: every step solved."""
    assert bool(run(chain_slope_drop(), 0.1, 10.0).solved.all())


@pytest.mark.parametrize(("stiffness", "deepest"), [(1e6, 7e-3), (5e7, 1e-3)])
def test_chain_dropped_onto_the_ground(stiffness: float, deepest: float) -> None:
    """From .5 m, pitched by 30°, Δt .02 and 2 s: every step solved, energy never rises, and it ends at rest. Penetration < 1 mm at
    C⊥ = 5e7, and √50 times that at the scene's own 1e6 (d ∝ 1/√C⊥)."""
    setup = chain_ground()
    stiff = tuple(
        dataclasses.replace(term, normal_force=NormalForce(stiffness)) if isinstance(term, Contact) else term
        for term in setup.scene.terms
    )
    rollout = run(dataclasses.replace(setup, scene=dataclasses.replace(setup.scene, terms=stiff)), 0.02, 2.0)
    assert bool(rollout.solved.all())
    assert 0 < float(rollout.penetration.max()) < deepest
    assert rises(rollout.energy) <= 1e-9 * float(rollout.energy[0])
    assert float(rollout.kinetic_energy[-1]) <= 1e-6 * float(rollout.energy[0])


def test_contact_forces_carry_the_weight() -> None:
    """Newton's law for the whole chain: Σ contact forces + m g = m a_com at every step of the fall, to 1e-6 of the weight."""
    setup = chain_slope_drop()
    rollout = run(setup, 0.02, 0.8)
    mass = float(setup.scene.articulation.mass.sum())
    momentum = rollout.linear_momentum.diff(dim=0) / 0.02
    force = rollout.contact_force.sum(-2) + mass * setup.scene.gravity
    assert float((momentum - force).abs().max()) <= 1e-6 * mass * GRAVITY
    assert float(rollout.contact_force.sum(-2)[..., 2].max()) > 0.8 * mass * GRAVITY


def test_friction_cone_and_complementarity() -> None:
    """Every recorded contact force has f·n = N ≤ C⊥ d² for d > 0, equal where the candidate sinks, and 0 for d ≤ 0, and
    ‖f∥‖ ≤ μ N; it never pulls."""
    rollout = run(chain_slope_drop(), 0.02, 0.8)
    force, depth = rollout.contact_force, rollout.contact_depth
    normal, most = force[..., 2], 5e7 * depth.clamp_min(0) ** 2
    assert bool((normal <= most * (1 + 1e-9) + 1e-9).all())
    assert float(normal.amin()) >= 0
    sinks = depth[1:] >= depth[:-1]
    assert int((sinks & (depth[1:] > 0)).sum()) > 100
    torch.testing.assert_close(normal[1:][sinks], most[1:][sinks], rtol=1e-9, atol=1e-9)
    tangential = torch.linalg.vector_norm(force[..., :2], dim=-1)
    assert bool((tangential <= 0.3 * normal * (1 + 1e-12)).all())
    sliding = torch.isclose(tangential, 0.3 * normal, rtol=1e-9, atol=0) & (depth > 0)
    assert int(sliding.sum()) > 100


def test_velocity_is_the_rate_of_the_poses() -> None:
    """v_{n+1} = (θ_{n+1} ⊖ θ_n)/Δt (Eq. 3): hinge rates are differences of angles, spins are logarithms of the links' rotations."""
    rollout = run(chain_slope_drop(), 0.02, 0.4)
    angles = rollout.q[:, 0, 7:]
    torch.testing.assert_close(rollout.v[1:, 0, 6:], angles.diff(dim=0) / 0.02, rtol=0, atol=1e-10)
    turns = rollout.link_poses[:, 0, 0, :, :3]
    spin = rotation_log(turns[:-1].mT @ turns[1:]) / 0.02
    torch.testing.assert_close(rollout.v[1:, 0, 3:6], spin, rtol=0, atol=1e-9)
    torch.testing.assert_close(turns, quaternion_matrix(rollout.q[:, 0, 3:7]), rtol=0, atol=1e-12)


def test_time_step_convergence_of_a_fall() -> None:
    """The tip of a double pendulum after .5 s converges at first order to scipy's solution of M(q) v̇ + h(q, v) = 0."""
    y = (0.0, 1.0, 0.0)
    rows = diagonal(0.003, 0.004, 0.005)
    links = [
        Link("upper", joints=(Joint("a", JointKind.HINGE, y),), mass=1.0, com=(0.2, 0.0, 0.05), inertia=rows),
        Link(
            "lower",
            "upper",
            (0.4, 0.0, 0.0),
            joints=(Joint("b", JointKind.HINGE, y),),
            mass=0.7,
            com=(0.15, 0.02, 0.0),
            inertia=rows,
        ),
    ]
    articulation = Articulation.from_links(links)

    def rate(_: float, state: np.ndarray) -> np.ndarray:
        q, v = torch.tensor(state[:2]), torch.tensor(state[2:])
        acceleration = torch.linalg.solve(mass_matrix(articulation, q), -bias_force(articulation, q, v, down()))
        return np.concatenate((state[2:], acceleration.numpy()))

    exact = torch.tensor(solve_ivp(rate, (0.0, 0.5), [0.2, -0.4, 0.0, 1.0], rtol=1e-9, atol=1e-10).y[:2, -1])
    scene = Scene(articulation, (Inertia(),), down())
    q, v = torch.tensor([0.2, -0.4], dtype=torch.float64), torch.tensor([0.0, 1.0], dtype=torch.float64)
    errors = [float((rolled_out(scene, dt, 0.5, q, v).q[-1] - exact).abs().max()) for dt in (0.01, 0.005, 0.0025)]
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.4)
    assert errors[1] / errors[2] == pytest.approx(2.0, abs=0.4)


def test_far_from_the_origin() -> None:
    """Physics does not depend on where the world's origin is: a chain dropped 1 km away does the same, to 1e-6 m."""
    setup = chain_slope_drop()
    far = setup.q.clone()
    far[:, 0] += 1000.0
    here, there = run(setup, 0.02, 0.5), run(dataclasses.replace(setup, q=far), 0.02, 0.5)
    moved = there.q.clone()
    moved[..., 0] -= 1000.0
    assert bool(there.solved.all())
    torch.testing.assert_close(moved, here.q, rtol=0, atol=1e-6)


def test_sign_of_quaternions_does_not_matter() -> None:
    """q and −q of a quaternion are one rotation: the same rollout, to 1e-9."""
    setup = chain_slope_drop()
    flipped = setup.q.clone()
    flipped[:, 3:7] *= -1
    one, other = run(setup, 0.05, 0.5), run(dataclasses.replace(setup, q=flipped), 0.05, 0.5)
    torch.testing.assert_close(one.link_poses, other.link_poses, rtol=0, atol=1e-9)
