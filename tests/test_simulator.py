"""The simulator's interface: shapes of records, worlds, progress and interruptions, controls, single precision."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch

from pbfd_torch import Simulator
from pbfd_torch.models.chains import chain_fixed, chain_ground, chain_slope_drop
from pbfd_torch.native.engine import Torch
from pbfd_torch.terms.actuators import Actuator
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from tests.bodies import GRAVITY, at, down, rises, rolled_out
from tests.record_arrays import OVER_TIME
from tests.small_scenes import arm, ball, doubles

BATCHES: list[tuple[int, ...]] = [(), (3,), (2, 3)]
all_batches = pytest.mark.parametrize("batch", BATCHES, ids=str)


# Records --------------------------------------------------------------------------------------------------------------


@all_batches
@pytest.mark.parametrize("touching", [True, False], ids=["contacts", "no contacts"])
def test_shapes_of_a_rollout(batch: tuple[int, ...], touching: bool) -> None:
    """T steps give T + 1 states and T solves; batch dimensions follow time; without contact terms npoint is 0."""
    setup = chain_ground() if touching else chain_fixed()
    scene = setup.scene
    articulation = scene.articulation
    simulator = Simulator(scene, 0.02)
    q, v = setup.q[0].expand(*batch, -1), setup.v[0].expand(*batch, -1)
    rollout = simulator.rollout(simulator.initial_state(q, v), steps=4)
    points = 20 if touching else 0
    expected = {
        "time": (5,),
        "q": (5, *batch, articulation.nq),
        "v": (5, *batch, articulation.nv),
        "link_poses": (5, *batch, articulation.nlink, 3, 4),
        "center_of_mass": (5, *batch, 3),
        "kinetic_energy": (5, *batch),
        "potential_energy": (5, *batch),
        "linear_momentum": (5, *batch, 3),
        "angular_momentum": (5, *batch, 3),
        "status": (4, *batch),
        "iterations": (4, *batch),
        "evaluations": (4, *batch),
        "residual_norm": (4, *batch),
        "contact_point": (4, *batch, points, 3),
        "contact_depth": (4, *batch, points),
        "contact_force": (4, *batch, points, 3),
    }
    assert {name: tuple(getattr(rollout, name).shape) for name in expected} == expected
    assert rollout.steps == 4
    assert rollout.energy.shape == (5, *batch)
    assert rollout.penetration.shape == (4, *batch)
    assert rollout.solved.shape == (4, *batch)
    assert bool(rollout.solved.all())
    torch.testing.assert_close(rollout.time, 0.02 * torch.arange(5, dtype=torch.float64))
    assert rollout.link_names == articulation.link_names
    assert rollout.joint_names == articulation.joint_names


def test_worlds_with_their_own_gravity_and_mass() -> None:
    """gravity `[*batch, 3]` and pseudo-inertia `[*batch, nlink, 4, 4]`: every world falls and rests as it would alone."""
    gravity = torch.stack([0.2 * down(), down(), 2 * down()])
    scene = ball(CoulombFriction(0.5))
    mass = doubles(1.0, 2.0, 3.0)[:, None, None, None]
    heavier = dataclasses.replace(scene.articulation, pseudo_inertia=mass * scene.articulation.pseudo_inertia)
    many = dataclasses.replace(scene, articulation=heavier, gravity=gravity)
    whole = rolled_out(many, 0.02, 1.2, at(0.06).repeat(3, 1))
    assert bool(whole.solved.all())
    for k in range(3):
        one = dataclasses.replace(scene.articulation, pseudo_inertia=heavier.pseudo_inertia[k])
        alone = rolled_out(dataclasses.replace(scene, articulation=one, gravity=gravity[k]), 0.02, 1.2, at(0.06))
        torch.testing.assert_close(whole.q[:, k], alone.q, rtol=0, atol=1e-8)
        depth = math.sqrt(float(mass[k] * gravity[k].norm()) / 1e6)
        assert float(whole.contact_depth[-1, k]) == pytest.approx(depth, rel=1e-6)


def test_one_start_for_many_worlds() -> None:
    """q `[nq]` with v `[3, nv]` broadcasts to three worlds, and so does the rest configuration."""
    simulator = Simulator(ball(), 0.02)
    v = torch.zeros(3, 6, dtype=torch.float64)
    v[:, 0] = doubles(0.0, 1.0, 2.0)
    rollout = simulator.rollout(simulator.initial_state(at(0.3), v), steps=5)
    torch.testing.assert_close(rollout.q[-1, :, 0], v[:, 0] * 0.1)
    assert simulator.initial_state(v=v).q.shape == (3, 7)
    assert torch.equal(simulator.initial_state().q, ball().articulation.rest)
    worlds = Simulator(dataclasses.replace(ball(), gravity=torch.stack([down(), 2 * down()])), 0.02)
    fallen = worlds.rollout(worlds.initial_state(at(1.0)), steps=5)
    torch.testing.assert_close(fallen.q[-1, :, 2], 1.0 - 0.5 * GRAVITY * 0.01 * doubles(1.0, 2.0), rtol=0, atol=1e-9)
    scene = ball()
    heavier = scene.articulation.pseudo_inertia * torch.ones(4, 1, 1, 1, dtype=torch.float64)
    many = dataclasses.replace(scene, articulation=dataclasses.replace(scene.articulation, pseudo_inertia=heavier))
    assert Simulator(many, 0.02).initial_state().q.shape == (4, 7)


def test_quaternions_of_a_start_are_normalised() -> None:
    """A quaternion of any norm is a rotation; the state's has unit norm."""
    q = at(0.1, (0.3, 0.2, 0.1))
    q[3:] *= 7.0
    state = Simulator(ball(), 0.01).initial_state(q)
    assert float(torch.linalg.vector_norm(state.q[3:])) == pytest.approx(1.0, abs=1e-15)
    torch.testing.assert_close(state.q, at(0.1, (0.3, 0.2, 0.1)))


def test_rollout_equals_steps() -> None:
    """`rollout` records what repeated `step` gives, bitwise, and leaves the state that it got alone."""
    setup = chain_slope_drop(2)
    simulator = Simulator(setup.scene, 0.05)
    state = simulator.initial_state(setup.q, setup.v)
    before = state.q.clone()
    rollout = simulator.rollout(state, steps=6)
    assert torch.equal(state.q, before)
    for k in range(6):
        assert torch.equal(rollout.q[k], state.q)
        state, solution = simulator.step(state)
        assert torch.equal(rollout.evaluations[k], solution.evaluations)
    assert torch.equal(rollout.q[-1], state.q)


def test_energy_and_momentum_of_the_record() -> None:
    """The record's energies and momenta are those of a free fall: ½mv² with the step's average velocity, m g z, m v."""
    rollout = rolled_out(ball(), 0.1, 0.5, at(5.0), doubles(1.0, 0, 0, 0, 0, 0))
    velocity = rollout.q[:, :3].diff(dim=0) / 0.1
    torch.testing.assert_close(rollout.kinetic_energy[1:], 0.5 * velocity.square().sum(-1), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(rollout.potential_energy, GRAVITY * rollout.q[:, 2], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(rollout.linear_momentum[1:], velocity, rtol=0, atol=1e-10)
    assert float(rollout.angular_momentum.abs().max()) <= 1e-12
    # entry 0 belongs to the virtual step before the start: v − ½ g Δt
    torch.testing.assert_close(rollout.v[0, :3], doubles(1.0, 0, 0) - 0.05 * down(), rtol=0, atol=1e-10)


# Progress and interruption --------------------------------------------------------------------------------------------


def test_progress_is_called_after_every_step() -> None:
    """With 1, 2, …, T."""
    seen: list[int] = []
    simulator = Simulator(ball(), 0.02)
    simulator.rollout(simulator.initial_state(at(0.3)), steps=5, progress=seen.append)
    assert seen == [1, 2, 3, 4, 5]


def test_interrupted_rollout_keeps_what_it_has() -> None:
    """KeyboardInterrupt in `progress` after step 3: a rollout of 3 steps, bitwise the beginning of the whole one; any other error
    comes through."""
    simulator = Simulator(ball(), 0.02)
    state = simulator.initial_state(at(0.06))
    whole = simulator.rollout(state, steps=6)

    def stop(step: int) -> None:
        if step == 3:
            raise KeyboardInterrupt

    part = simulator.rollout(state, steps=6, progress=stop)
    assert part.steps == 3
    assert all(len(getattr(part, name)) == len(getattr(whole, name)) - 3 for name in OVER_TIME)
    assert torch.equal(part.q, whole.q[:4])

    def fail(step: int) -> None:
        raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        simulator.rollout(state, steps=6, progress=fail)


@pytest.mark.parametrize("call", [1, 3])
def test_interruption_inside_a_step(monkeypatch: pytest.MonkeyPatch, call: int) -> None:
    """KeyboardInterrupt while a step is recorded: the steps before it are kept, whole; where there are none it comes through."""
    simulator = Simulator(ball(), 0.02, engine=Torch())
    state = simulator.initial_state(at(0.06))
    points, calls = Contact.points, [0]

    def interrupted(self: Contact, *arguments: Any) -> Any:
        calls[0] += 1
        if calls[0] == call:
            raise KeyboardInterrupt
        return points(self, *arguments)

    monkeypatch.setattr(Contact, "points", interrupted)
    if call == 1:
        with pytest.raises(KeyboardInterrupt):
            simulator.rollout(state, steps=6)
        return
    part = simulator.rollout(state, steps=6)
    assert part.steps == 2
    lengths = {name: len(getattr(part, name)) for name in OVER_TIME}
    assert set(lengths.values()) == {2, 3}
    assert lengths["q"] == lengths["time"] == 3
    assert lengths["status"] == lengths["contact_force"] == 2


# Controls -------------------------------------------------------------------------------------------------------------


@all_batches
def test_controls_of_every_world(batch: tuple[int, ...]) -> None:
    """controls `[steps, *batch, nu]`: each world moves as its own control says; a control without batch goes to all."""
    simulator = Simulator(arm(Actuator.motor("a", "joint"), Actuator.motor("b", "joint")), 0.05)
    start = torch.zeros(*batch, 1, dtype=torch.float64)
    count = math.prod(batch)
    control = torch.arange(1.0, 2 * count + 1, dtype=torch.float64).view(*batch, 2)
    state = simulator.initial_state(start, control=control)
    rollout = simulator.rollout(state, control.expand(10, *batch, 2))
    expected = 0.5 * control.sum(-1) / 2.0 * 0.5**2
    torch.testing.assert_close(rollout.q[-1, ..., 0], expected, rtol=1e-9, atol=1e-9)
    shared = simulator.rollout(simulator.initial_state(start), torch.ones(10, 2, dtype=torch.float64))
    assert shared.q.shape == (11, *batch, 1)


# Single precision -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.02, 0.05])
def test_single_precision(dt: float) -> None:
    """float32 solves every step of the chain's fall onto the slope at its own tolerance, .6 s: penetration < 1 mm, energy never
    rises by more than its rounding. At Δt .02 its centre of mass is within a millimetre of float64's; at Δt .05 the impact has
    several solutions, and the two may take different ones."""
    single, double = chain_slope_drop(1, torch.float32), chain_slope_drop()
    rough = rolled_out(single.scene, dt, 0.6, single.q, single.v)
    assert rough.q.dtype == rough.energy.dtype == rough.contact_force.dtype == torch.float32
    assert bool(rough.solved.all())
    assert 0 < float(rough.penetration.max()) < 1e-3
    assert rises(rough.energy) <= 1e-5
    if dt == 0.02:
        exact = rolled_out(double.scene, dt, 0.6, double.q, double.v)
        assert float((rough.center_of_mass - exact.center_of_mass).abs().max()) <= 1e-3
