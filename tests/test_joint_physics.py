"""Joints in motion against closed forms and converged references. Every test states its equation."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from pbfd_torch.balance.dynamics import bias_force, mass_matrix
from pbfd_torch.models.chains import chain_heavy
from pbfd_torch.scene import Scene
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from tests.bodies import GRAVITY, diagonal, down, on_world, rises, rolled_out
from tests.setup_runs import run
from tests.states import implicit


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
