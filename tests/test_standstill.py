"""Worlds that are not finite or beyond the bounds stand still, cost one evaluation a step, and the others never notice."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Scene, Simulator
from pbfd_torch.integrators.integrator import State
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES
from pbfd_torch.models.chains import chain_ground
from pbfd_torch.schedules.asynchronous import AsynchronousRollout
from pbfd_torch.schedules.lock_step import rolled_out
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.tensors.structures import tensors_of
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.pushes import Pushes
from tests.random_numbers import normal

SICK = 5
POISONS = {
    "q NaN": ("q", -1, math.nan),
    "q infinite": ("q", 0, math.inf),
    "q 1e200": ("q", 0, 1e200),
    "v NaN": ("v", 0, math.nan),
    "v 1e8": ("v", 0, 1e8),
    "v 1e300": ("v", -1, 1e300),
    "turning by 1000 rad a step": ("v", -1, 1e5),
}


def others(worlds: int) -> Worlds:
    """All but the sick one."""
    return Worlds((worlds,), torch.tensor([k for k in range(worlds) if k != SICK]))


def started(name: str, worlds: int) -> tuple[Simulator[Any], Any]:
    """A scene with all worlds in slow motion."""
    setup = SCENES[name](worlds=worlds)
    simulator = Simulator(setup.scene, 0.01)
    return simulator, simulator.initial_state(setup.q, 0.1 * normal(worlds, setup.scene.articulation.nv))


def poisoned(state: Any, poison: str) -> Any:
    """The state with one number of one world changed."""
    field, place, value = POISONS[poison]
    changed = getattr(state, field).clone()
    changed[SICK, place] = value
    return dataclasses.replace(state, **{field: changed})


def assert_same(state: State, expected: State, solution: Solution, wanted: Solution) -> None:
    """Bitwise."""
    for one, other in zip(tensors_of(state), tensors_of(expected), strict=True):
        assert torch.equal(one.nan_to_num(), other.nan_to_num())
    for name in ("q", "status", "evaluations", "iterations", "residual_norm", "fallbacks"):
        assert torch.equal(getattr(solution, name), getattr(wanted, name))


def of(solution: Solution, worlds: Worlds) -> Solution:
    """That of some worlds."""
    names = ("q", "status", "evaluations", "iterations", "residual_norm", "fallbacks")
    rows: dict[str, Any] = {name: worlds.rows(getattr(solution, name)) for name in names}
    return dataclasses.replace(solution, **rows)


@pytest.mark.parametrize("poison", POISONS)
@pytest.mark.parametrize("name", ["chain-ground", "stack"])
def test_poisoned_world_among_others(name: str, poison: str) -> None:
    """One poisoned world of eight, on the ground and with bodies on each other: it costs one evaluation a step, keeps its state
    while its time goes on, and the others are bitwise those of the batch without it."""
    simulator, start = started(name, 8)
    rest = others(8)
    sick, well = poisoned(start, poison), start.take(rest)
    for k in range(3):
        sick, solution = simulator.step(sick)
        well, wanted = simulator.step(well)
        assert int(solution.status[SICK]) == Status.NON_FINITE
        assert int(solution.evaluations[SICK]) == 1
        assert_same(sick.take(rest), well, of(solution, rest), wanted)
        before = poisoned(start, poison)
        assert torch.equal(sick.q[SICK].nan_to_num(), before.q[SICK].nan_to_num())
        assert float(sick.time[SICK]) == pytest.approx(0.01 * (k + 1))
        assert int(sick.hazards[SICK]) == 0


@pytest.mark.parametrize("name", ["chain-ground", "stack"])
def test_cost_of_a_poisoned_world(name: str) -> None:
    """64 worlds with one poisoned: evaluations, and lanes that the schedule spends, are at most 1.1 times those of the batch
    without it."""
    simulator, start = started(name, 64)
    rest = others(64)
    sick, well = poisoned(start, "v 1e300"), start.take(rest)
    spent = torch.zeros(2, 2)
    for _ in range(2):
        sick, solution = simulator.step(sick)
        well, wanted = simulator.step(well)
        assert_same(sick.take(rest), well, of(solution, rest), wanted)
        spent += torch.tensor([[float(x.evaluations.sum()), float(x.lanes)] for x in (solution, wanted)])
    assert bool((spent[0] <= 1.1 * spent[1]).all())


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_every_integrator_stands_still(integrator: str) -> None:
    """A world with NaN for its configuration, in every scheme: NON_FINITE at one evaluation, its state as it was."""
    setup = chain_ground(2)
    simulator = Simulator(setup.scene, 0.01, INTEGRATORS[integrator]())
    state = simulator.initial_state(setup.q, setup.v)
    state, _ = simulator.step(state)
    q = state.q.clone()
    q[1, 2] = math.nan
    sick = dataclasses.replace(state, q=q)
    end, solution = simulator.step(sick)
    assert solution.status.tolist()[1] == Status.NON_FINITE
    assert int(solution.evaluations[1]) == 1
    for now, before in zip(tensors_of(end), tensors_of(sick), strict=True):
        if now is not end.time:
            assert torch.equal(now[1].nan_to_num(), before[1].nan_to_num())


def pushed(force: float) -> tuple[Scene, Tensor]:
    """Chains on the ground, world 1 of 2 with a force on its last link [N]; where they are."""
    setup = chain_ground(2)
    push = torch.zeros(2, setup.scene.articulation.nlink, 3, dtype=torch.float64)
    push[1, -1] = force
    pushes = Pushes.at_centers(setup.scene.articulation, push)
    return dataclasses.replace(setup.scene, terms=(*setup.scene.terms, pushes)), setup.q


@pytest.mark.parametrize("force", [1e12, 1e30, 1e100, 1e300])
def test_absurd_push(force: float) -> None:
    """Forces that no step can balance: the world is given up at its guess and at its start, and the other is bitwise as without."""
    scene, q = pushed(force)
    simulator, calm = Simulator(scene, 0.01), Simulator(pushed(0.0)[0], 0.01)
    state, quiet = simulator.initial_state(q), calm.initial_state(q)
    for _ in range(3):
        before = state
        state, solution = simulator.step(state)
        quiet, expected = calm.step(quiet)
        assert solution.status.tolist() == [int(expected.status[0]), Status.NON_FINITE]
        assert int(solution.evaluations[1]) <= 2
        assert torch.equal(state.q[0], quiet.q[0])
        assert torch.equal(state.q[1], before.q[1])
        assert bool(torch.isfinite(state.v).all())


@pytest.mark.parametrize("control", [math.nan, math.inf, 1e12])
def test_absurd_control(control: float) -> None:
    """NaN, infinity or absurd drive in one world: it stands still for that step, and goes on as soon as its control is fine."""
    setup = chain_ground(2)
    motors = Actuators.from_list(setup.scene.articulation, [Actuator.motor("m", setup.scene.articulation.joint_names[-1])])
    simulator = Simulator(Scene(setup.scene.articulation, (Inertia(), motors), setup.scene.gravity), 0.01)
    state = simulator.initial_state(setup.q)
    still, solution = simulator.step(state, torch.tensor([[0.0], [control]], dtype=torch.float64))
    assert solution.solved.tolist() == [True, False]
    assert int(solution.status[1]) == Status.NON_FINITE
    assert torch.equal(still.q[1], state.q[1])
    moved, solution = simulator.step(still, torch.zeros(2, 1, dtype=torch.float64))
    assert bool(solution.solved.all())
    assert not torch.equal(moved.q[1], still.q[1])


def test_asynchronous_standstill() -> None:
    """The asynchronous schedule says and keeps the same as lock step, to the bit."""
    simulator, start = started("chain-ground", 8)
    sick = poisoned(start, "v 1e8")
    together = rolled_out(simulator.eager, sick, steps=3)
    apart = AsynchronousRollout(simulator, sick, 3).finish()
    assert torch.equal(together.status, apart.status)
    assert together.status[:, SICK].tolist() == [Status.NON_FINITE] * 3
    assert torch.equal(together.evaluations, apart.evaluations)
    assert torch.equal(together.q, apart.q)
    assert bool(torch.isfinite(together.q).all())
