"""Schedules: asynchronous worlds and worker processes give the trajectories of lock step, and spend what they should."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from pbfd_torch import Simulator
from pbfd_torch.bench.starts import scattered
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Torch
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.schedules.asynchronous import AsynchronousRollout
from pbfd_torch.schedules.workers import Workers
from pbfd_torch.solvers import lock_step
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.named import OnSquares, lbfgs
from pbfd_torch.solvers.objective import Status
from tests.random_trees import generator
from tests.states import implicit, state_of

ARRAYS = [f.name for f in dataclasses.fields(Rollout) if f.type == "Tensor" and f.name != "lanes"]


def assert_equal(a: Rollout, b: Rollout) -> None:
    for name in ARRAYS:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def test_asynchronous_without_fallbacks() -> None:
    """A plain descent that gives up after 10 evaluations: what it leaves unsolved stays so, as in lock step."""
    setup = SCENES["chain-ground"](worlds=8)
    simulator = implicit(setup.scene, 0.05, solver=Descent(max_evaluations=10), halvings=0)
    state = simulator.initial_state(*scattered(setup))
    straight = simulator.rollout(state, steps=10)
    assert not bool(straight.solved.all())
    assert_equal(AsynchronousRollout(simulator, state, 10).finish(), straight)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
def test_asynchronous_trajectories_are_those_of_lock_step(dtype: torch.dtype) -> None:
    """12 falling chains through their landing, with fallbacks among them: bitwise the same record, counts and statuses included;
    every lane's evaluations went where they were needed, or nearly so."""
    setup = SCENES["chain-ground"](worlds=12, dtype=dtype)
    simulator = implicit(setup.scene, 0.05, solver=Fallbacks(Descent(max_evaluations=60)))
    state = simulator.initial_state(*scattered(setup))
    straight = simulator.rollout(state, steps=14)
    own_pace = AsynchronousRollout(simulator, state, 14)
    rollout = own_pace.finish()
    assert own_pace.done
    assert_equal(rollout, straight)
    if dtype == torch.float64:
        assert bool((straight.status == Status.WARM_STARTED).any())
    assert int(straight.evaluations.sum()) <= int(rollout.lanes) < int(straight.lanes)
    assert straight.utilisation < rollout.utilisation <= 1


def test_every_world_has_the_control_of_its_own_step() -> None:
    """Random controls of the hopper, one per world and step: the trajectories of lock step, to the tolerance (rolling contacts
    round by a world's place in memory)."""
    setup = SCENES["hopper"](worlds=12)
    simulator = implicit(setup.scene, 0.02)
    state = simulator.initial_state(*scattered(setup, bend=0.05))
    controls = 2 * torch.rand(20, 12, setup.scene.nu, dtype=torch.float64, generator=generator(3)) - 1
    straight = simulator.rollout(state, controls)
    rollout = AsynchronousRollout(simulator, state, 20, controls).finish()
    torch.testing.assert_close(rollout.q, straight.q, rtol=0, atol=1e-7)
    assert bool(rollout.solved.all())


def test_policy_sees_each_world_at_its_own_step() -> None:
    """A policy of step, q and v, row by row, against the same law applied in lock step."""
    setup = SCENES["hopper"](worlds=6)
    simulator = implicit(setup.scene, 0.02)
    state = simulator.initial_state(*scattered(setup, bend=0.05))

    def policy(step: Tensor, q: Tensor, v: Tensor) -> Tensor:
        return torch.sin(0.3 * step[:, None] + q[:, -setup.scene.nu :]) - 0.1 * v[:, -setup.scene.nu :]

    rollout = AsynchronousRollout(simulator, state, 15, policy).finish()
    for k in range(15):
        v = simulator.integrator.velocity(setup.scene.articulation, state, simulator.step_size)
        state, _ = simulator.step(state, policy(torch.full((6,), k), state.q, v))
        torch.testing.assert_close(rollout.q[k + 1], state.q, rtol=0, atol=1e-7)


def test_one_call_evaluates_every_world_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worlds of different difficulty: after some calls they are at different steps, no world has waited for another one, and the
    number of calls is the largest number of evaluations that one world needed."""
    monkeypatch.setattr("pbfd_torch.schedules.asynchronous.FEWEST_LANES", 10**9)
    setup = SCENES["box-slide"](worlds=5)
    simulator = implicit(setup.scene, 0.05)
    state = simulator.initial_state(setup.q, setup.v)
    own_pace = AsynchronousRollout(simulator, state, 12)
    for _ in range(12):
        own_pace.advance()
    assert len(set(own_pace.steps_made.tolist())) > 1
    rollout = own_pace.finish()
    assert own_pace.rounds == int(rollout.evaluations.sum(0).max())
    assert int(rollout.lanes) == own_pace.rounds * 5


def test_asynchronous_saves_what_max_over_mean_predicts() -> None:
    """256 falling chains of random starts: lock step without compaction costs Σ_k max_w evaluations for every world; the
    asynchronous schedule beats it by the factor max/mean, to 15 %."""
    setup = SCENES["chain-ground"](worlds=256)
    simulator = implicit(setup.scene, 0.02)
    state = simulator.initial_state(*scattered(setup))
    own_pace = AsynchronousRollout(simulator, state, 60)
    rollout = own_pace.finish()
    spent = 256 * int(rollout.evaluations.amax(1).sum())
    predicted = float(rollout.evaluations.amax(1).sum()) / float(rollout.evaluations.double().mean(1).sum())
    assert predicted > 3
    assert spent / own_pace.lanes == pytest.approx(predicted, rel=0.15)


def test_compaction_changes_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lock step with and without compaction: bitwise the same, at fewer evaluations spent."""
    setup = SCENES["chain-ground"](worlds=24)
    simulator = Simulator(setup.scene, 0.02, ImplicitEuler(), engine=Torch())
    state = simulator.initial_state(*scattered(setup))
    falling = Simulator(setup.scene, 0.02, ImplicitEuler())
    for _ in range(12):
        state, _ = falling.step(state)
    compacted = simulator.rollout(state, steps=8)
    monkeypatch.setattr(lock_step, "FEWEST_LANES", 10**9)
    masked = simulator.rollout(state, steps=8)
    assert_equal(compacted, masked)
    assert int(compacted.lanes) < int(masked.lanes)


def test_interrupted_asynchronous_rollout_keeps_the_steps_of_all_worlds() -> None:
    """Ctrl-C in the middle: the steps that every world has made are kept, bitwise those of the whole rollout."""
    setup = SCENES["chain-fixed"](worlds=3)
    simulator = Simulator(setup.scene, 0.05, ImplicitEuler(), engine=Torch())
    state = simulator.initial_state(*scattered(setup))
    done = 0

    def interrupting(arrived: int) -> None:
        nonlocal done
        done += arrived
        if done >= 15:
            raise KeyboardInterrupt

    part = AsynchronousRollout(simulator, state, 20).finish(interrupting)
    whole = simulator.rollout(state, steps=20)
    assert 1 <= part.steps < 20
    assert torch.equal(part.q, whole.q[: part.steps + 1])


def test_worker_processes_give_the_numbers_of_one() -> None:
    """Five boxes with a μ each over two workers: bitwise the record of a single process, at each use of the pool."""
    setup = SCENES["box-slide"](worlds=5)
    simulator = implicit(setup.scene, 0.05)
    state = simulator.initial_state(setup.q, setup.v)
    straight = simulator.rollout(state, steps=6)
    with Workers(2) as workers:
        for _ in range(2):
            assert_equal(workers.rollout(simulator, state, steps=6), straight)
        with pytest.raises(InputError, match="1 worlds for 2 workers: must be at least one each"):
            workers.rollout(simulator, state_of(state.q[:1], state.q_previous[:1]), steps=1)


def test_bad_input_is_named() -> None:
    """The message gives value and choices."""
    setup = SCENES["box-slide"](worlds=2)
    simulator = implicit(setup.scene, 0.05)
    state = simulator.initial_state(setup.q, setup.v)
    with pytest.raises(InputError, match="steps is 0: must be ≥ 1"):
        AsynchronousRollout(simulator, state, 0)
    with pytest.raises(InputError, match=r"controls have shape \(3, 2, 1\): must be \(4, 2, 0\)"):
        AsynchronousRollout(simulator, state, 4, torch.zeros(3, 2, 1, dtype=torch.float64))
    with pytest.raises(InputError, match="must be \\[worlds, nq\\]"):
        AsynchronousRollout(simulator, state_of(state.q[0], state.q_previous[0]), 4)
    with pytest.raises(InputError, match="the solver is a OnSquares: must be a Descent or Fallbacks"):
        AsynchronousRollout(implicit(setup.scene, 0.05, solver=OnSquares(lbfgs())), state, 4)
    with pytest.raises(InputError, match="count is 0: must be ≥ 1"):
        Workers(0)
