"""Anchored friction: a stuck contact does not creep, whatever the step, the schedule, the batch and the fallbacks."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.motion import Turntable
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Collider, Cylinder
from pbfd_torch.errors import InputError
from pbfd_torch.scene import Scene
from pbfd_torch.schedules.asynchronous import AsynchronousRollout
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.objective import Relaxable, Solution
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from tests.bodies import GRAVITY, at, box_inertia, down, free_body

HALF, MU, STRETCH = (0.1, 0.1, 0.02), 0.5, 1e-5
SHARES = torch.tensor([0.5, 0.98, 1.02], dtype=torch.float64)  # of the cone: tan slope = share · μ


def on_slope(law: FrictionLaw, obstacle: Obstacle | HalfSpace | None = None) -> tuple[Scene, Tensor]:
    """A box on slopes of `SHARES` of the cone, one a world, put down at its mean rest depth."""
    slope = torch.atan(SHARES * MU)
    articulation = free_body(1.0, box_inertia(1.0, HALF))
    colliders = [Collider("box", "body", Box(HALF))]
    contact = Contact.between(articulation, colliders, obstacle or HalfSpace(), NormalForce(1e8), law)
    q = at(HALF[2]).repeat(len(SHARES), 1)
    q[:, 2] -= (GRAVITY * torch.cos(slope) / 4 / 1e8).sqrt()
    return Scene(articulation, (Inertia(), contact), down(slope), colliders), q


@pytest.mark.parametrize(("dt", "duration"), [(0.02, 3.0), (0.1, 20.0)])
def test_a_stuck_box_does_not_creep(dt: float, duration: float) -> None:
    """At half and .98 of the cone the mean speed over the last half is < 1e-9 m/s, and all that the box ever gives way is a few
    stretches. At 1.02 of it the box slides off with g (sin − μ cos), to 1 %."""
    scene, q = on_slope(AnchoredFriction(MU, STRETCH))
    simulator = Simulator(scene, dt)
    rollout = simulator.rollout(simulator.initial_state(q), steps=round(duration / dt))
    assert bool(rollout.solved.all())
    x, half = rollout.q[:, :, 0], rollout.steps // 2
    creep = (x[-1] - x[half]).abs() / float(rollout.time[-1] - rollout.time[half])
    assert float(creep[:2].max()) < 1e-9
    assert float((x[-1] - x[0])[:2].abs().max()) <= 1e-4
    slope = torch.atan(SHARES[2] * MU)
    exact = float(GRAVITY * (torch.sin(slope) - MU * torch.cos(slope)))
    gained = float((rollout.v[-1, 2, 0] - rollout.v[half, 2, 0]) / (rollout.time[-1] - rollout.time[half]))
    assert gained == pytest.approx(exact, rel=0.01)


def test_without_anchor_it_creeps() -> None:
    """The same box with plain Coulomb friction creeps at ε_v (1 − √(1 − W/(μN))), to 1 %."""
    scene, q = on_slope(CoulombFriction(MU, 1e-3))
    simulator = Simulator(scene, 0.05)
    rollout = simulator.rollout(simulator.initial_state(q), steps=100)
    moved = (rollout.q[-1, :2, 0] - rollout.q[50, :2, 0]) / 2.5
    torch.testing.assert_close(moved, 1e-3 * (1 - (1 - SHARES[:2]).sqrt()), rtol=0.01, atol=0)


def test_kept_is_cut_to_the_stretch() -> None:
    """w is kept within the stretch, cut to it beyond, and forgotten where the contact has opened; finite at zero slip."""
    law = AnchoredFriction(MU, 0.1)
    slip = torch.tensor([[0.06, 0.0, 0.0], [0.3, -0.4, 0.0], [0.05, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    slip.requires_grad_()
    kept = law.kept(slip, torch.tensor([1e-3, 1e-3, 0.0, 1e-3], dtype=torch.float64))
    expected = torch.tensor([[0.06, 0.0, 0.0], [0.06, -0.08, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(kept.detach(), expected, rtol=0, atol=1e-15)
    (gradient,) = torch.autograd.grad(kept.sum(), slip)
    assert bool(torch.isfinite(gradient).all())
    for values in ((-1.0, 0.1), (MU, 0.0), (MU, math.inf)):
        with pytest.raises(InputError):
            AnchoredFriction(*values)


def test_memory_is_part_of_the_state() -> None:
    """Two rollouts, the second from the last state of the first, are one; so are the asynchronous schedule's and each world's
    alone; a state that has forgotten gives way anew."""
    scene, q = on_slope(AnchoredFriction(MU, STRETCH))
    simulator = Simulator(scene, 0.05)
    state = start = simulator.initial_state(q)
    assert [tuple(x.shape) for x in state.memory] == [(3, 8, 3)]
    whole = simulator.rollout(start, steps=12)
    for _ in range(6):
        state, _ = simulator.step(state)
    assert float(state.memory[0].abs().max()) > 0.3 * STRETCH
    later = simulator.rollout(state, steps=6)
    assert torch.equal(later.q[-1], whole.q[-1])
    other = AsynchronousRollout(simulator, start, 12).finish()
    torch.testing.assert_close(other.q, whole.q, rtol=0, atol=1e-12)
    forgotten = dataclasses.replace(state, memory=tuple(torch.zeros_like(x) for x in state.memory))
    assert float((simulator.rollout(forgotten, steps=6).q[-1] - whole.q[-1]).abs().max()) > 0.3 * STRETCH
    one = Simulator(dataclasses.replace(scene, gravity=scene.gravity[1]), 0.05)
    alone = one.rollout(one.initial_state(q[1]), steps=12)
    torch.testing.assert_close(alone.q, whole.q[:, 1], rtol=0, atol=1e-11)


def test_memory_survives_halvings() -> None:
    """A solver that gives up at once at the full step: every step is made of shorter ones, each of which hands its anchors on, and
    the box still does not creep."""
    scene, q = on_slope(AnchoredFriction(MU, STRETCH))
    whole = Simulator(scene, 0.1)
    start = whole.initial_state(q)
    hasty = Simulator(scene, 0.1, solver=_Hasty())
    state = start
    for _ in range(12):
        state, solution = hasty.step(state)
        assert bool(solution.solved.all())
    settled = state
    for _ in range(5):
        state, _ = hasty.step(state)
    assert float((state.q - settled.q)[:2, :3].abs().max()) <= 1e-9
    assert float(state.memory[0].abs().max()) > 0.3 * STRETCH


class _Hasty:
    """Leaves whole steps unsolved; solves the shorter ones."""

    def solve(self, objective: Relaxable, guess: Tensor, retreat: Tensor | None = None) -> Solution:
        assert isinstance(objective, BalanceObjective)
        return Descent(max_evaluations=1 if float(objective.step.dt) > 0.09 else 400).solve(objective, guess, retreat)


def test_anchors_turn_with_the_solid() -> None:
    """On a table that turns slowly under a slope, gravity drags the box along one way in the world, and the anchors lie in the
    table: the mean drift over the second turn is none where without anchors it creeps."""
    drift = []
    for law in (AnchoredFriction(MU, STRETCH), CoulombFriction(MU, 1e-3)):
        table = Obstacle("table", Cylinder(2.0, 0.1), (0.0, 0.0, -0.1), motion=Turntable(2 * math.pi))
        scene, q = on_slope(law, table)
        simulator = Simulator(scene, 0.05)
        v = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 2 * math.pi], dtype=torch.float64)
        rollout = simulator.rollout(simulator.initial_state(q, v.expand(3, 6)), steps=40)
        assert bool(rollout.solved.all())
        drift.append(torch.linalg.vector_norm(rollout.q[-1, 0, :2] - rollout.q[20, 0, :2]))
    assert float(drift[0]) <= 1e-2 * float(drift[1])
