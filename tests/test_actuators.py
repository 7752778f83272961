"""Actuators: their forces against closed forms, and joints that move as they are told."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from pbfd_torch import Simulator
from pbfd_torch.terms.actuators import Actuator, Actuators
from tests.small_scenes import arm, doubles
from tests.states import implicit
from tests.term_cases import situation


def test_actuator_forces() -> None:
    """Force gear · clamp(gain·u + bias − kp·x − kv·ẋ, effort) at x = gear·q, control clamped to its range; several actuators on one
    joint add up."""
    s = situation(0)
    a = s.articulation
    name = a.joint_names[int(a.topology.scalar_joint[0])]
    column, row = int(a.topology.scalar_q[0]), int(a.topology.scalar_v[0])
    dt, gear, u = float(s.dt), 1.5, 0.9
    x = gear * float(s.q[column])
    rate = (x - gear * float(s.state.q[column])) / dt

    def force(*made: Actuator) -> float:
        bank = Actuators.from_list(a, list(made))
        one = dataclasses.replace(s, control=torch.full((len(made),), u, dtype=torch.float64))
        residual = one.balance([bank], one.q).residual
        assert int((residual != 0).sum()) <= 1
        return -float(residual[row])

    assert force(Actuator.motor("m", name, gear)) == pytest.approx(gear * u, rel=1e-12)
    assert force(Actuator.motor("m", name, gear, effort=0.5)) == pytest.approx(gear * 0.5, rel=1e-12)
    expected = 20 * (u - x) - 3 * rate
    position = Actuator("p", name, gear, gain=20, stiffness=20, damping=3)
    assert force(position) == pytest.approx(gear * expected, rel=1e-12)
    limited = dataclasses.replace(position, force_range=(-0.01, 0.02))
    assert force(limited) == pytest.approx(gear * (0.02 if expected > 0 else -0.01), rel=1e-12)
    assert force(Actuator("v", name, gear, gain=3, damping=3)) == pytest.approx(gear * 3 * (u - rate), rel=1e-12)
    assert force(Actuator("c", name, gear, control_range=(-0.2, 0.2))) == pytest.approx(gear * 0.2, rel=1e-12)
    assert force(Actuator("b", name, gear, bias=-0.4)) == pytest.approx(gear * (u - 0.4), rel=1e-12)
    both = force(position, Actuator.motor("m", name, gear))
    assert both == pytest.approx(gear * (expected + u), rel=1e-12)


def test_actuators_without_control_get_zero() -> None:
    """control None is u = 0: a motor gives nothing, a position servo pulls to x = 0."""
    s = situation(0)
    a = s.articulation
    name, column = a.joint_names[int(a.topology.scalar_joint[0])], int(a.topology.scalar_q[0])
    bank = Actuators.from_list(a, [Actuator.motor("m", name), Actuator.position("p", name, kp=5.0)])
    residual = dataclasses.replace(s, control=None).balance([bank], s.q).residual
    assert float(residual[a.topology.scalar_v[0]]) == pytest.approx(5.0 * float(s.q[column]), rel=1e-12)


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_motor(dt: float) -> None:
    """x = ½ (F/m) t² exactly at the grid points, F = gear · min(u, effort)."""
    scene = arm(Actuator.motor("m", "joint", gear=2.0, effort=1.5))
    simulator = Simulator(scene, dt)
    for control, force in ((1.0, 2.0), (7.0, 3.0), (-7.0, -3.0)):
        u = doubles(control)
        rollout = simulator.rollout(simulator.initial_state(control=u), u.expand(20, 1))
        exact = 0.5 * force / 2.0 * rollout.time**2
        assert float((rollout.q[:, 0] - exact).abs().max()) <= 1e-9


@pytest.mark.parametrize("dt", [0.01, 0.1])
def test_position_servo_sags(dt: float) -> None:
    """Under a load F a position servo ends at u + F/kp, at rest; beyond its effort it gives way with (F − effort)/m."""
    load = doubles(3.0, 0.0, 0.0)  # m g_x = 6 N
    simulator = Simulator(arm(Actuator.position("p", "joint", kp=200.0, kv=40.0), gravity=load), dt)
    rollout = simulator.rollout(simulator.initial_state(), doubles(0.5).expand(round(6.0 / dt), 1))
    assert float(rollout.q[-1, 0]) == pytest.approx(0.5 + 6.0 / 200.0, abs=1e-8)
    assert float(rollout.v[-1].abs()) <= 1e-8
    weak = implicit(arm(Actuator.position("p", "joint", kp=200.0, kv=40.0, effort=2.0), gravity=load), dt)
    rollout = weak.rollout(weak.initial_state(doubles(1.0)), doubles(0.0).expand(20, 1))
    acceleration = rollout.v[1:, 0].diff() / dt
    assert float((acceleration - (6.0 - 2.0) / 2.0).abs().max()) <= 1e-6


@pytest.mark.parametrize("dt", [0.01, 0.1])
def test_velocity_servo_lags(dt: float) -> None:
    """Under a load F a velocity servo runs at u + F/kv, which it nears by v_{n+1} = (v_n + Δt (kv u + F)/m)/(1 + Δt kv/m)."""
    mass, kv, u = 2.0, 15.0, 0.8
    simulator = implicit(arm(Actuator.velocity("v", "joint", kv=kv), gravity=doubles(3.0, 0.0, 0.0)), dt)
    rollout = simulator.rollout(simulator.initial_state(), doubles(u).expand(round(4.0 / dt), 1))
    v = rollout.v[:, 0]
    expected = (v[:-1] + dt * (kv * u + 6.0) / mass) / (1 + dt * kv / mass)
    assert float((v[1:] - expected).abs().max()) <= 1e-7
    assert float(v[-1]) == pytest.approx(u + 6.0 / kv, abs=1e-7)


def test_stiff_servo_is_stable() -> None:
    """kp = 1e7 at Δt .1: the joint is where it is told after one step, without ringing."""
    simulator = Simulator(arm(Actuator.position("p", "joint", kp=1e7)), 0.1)
    rollout = simulator.rollout(simulator.initial_state(), doubles(0.3).expand(20, 1))
    assert bool(rollout.solved.all())
    assert float((rollout.q[1:, 0] - 0.3).abs().max()) <= 0.3 * 2.0 / 0.1**2 / 1e7 * 2
