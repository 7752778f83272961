"""Worlds that never feel each other, bit for bit, in simulations; and no waiting for the device inside a round."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from pbfd_torch.integrators.implicit_euler import Positions
from pbfd_torch.models.boxes import box_slide
from pbfd_torch.models.chains import chain_fixed, chain_ground
from pbfd_torch.models.setup import Setup
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import Continuation, Fallbacks
from pbfd_torch.solvers.named import jtj_lm, lbfgs, lm
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.kinematics import retract
from tests.random_trees import generator
from tests.states import implicit, state_of

# few evaluations a stage: detours and exhausted budgets become common and stay cheap
HASTY = Fallbacks(Descent(max_evaluations=8), Descent(max_evaluations=12), detours=(Continuation(((1.0, 1e-2),)),))
both_dtypes = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])


def assert_same(whole: Solution, index: Any, alone: Solution) -> None:
    """Some worlds of a batch and a solution of their own are bitwise the same."""
    for name in ("q", "status", "residual_norm", "iterations", "evaluations", "fallbacks"):
        found, expected = getattr(whole, name)[index], getattr(alone, name)
        assert torch.equal(found, expected.reshape(found.shape)), name


def scattered(setup: Setup, seed: int, bend: float = 0.1) -> tuple[Tensor, Tensor]:
    """Starts `[worlds, nq]`, `[worlds, nv]` around the set-up's own: at most .5 m lower, bent, turned and moving at random."""
    random = generator(seed)
    articulation = setup.scene.articulation
    delta = bend * torch.randn(setup.worlds, articulation.nv, dtype=torch.float64, generator=random)
    delta[:, :3] = 0.0
    delta[:, 2] = -0.5 * torch.rand(setup.worlds, dtype=torch.float64, generator=random)
    v = 0.5 * torch.randn(setup.worlds, articulation.nv, dtype=torch.float64, generator=random)
    q = retract(articulation.to(torch.float64), setup.q.double(), delta)
    return q.to(setup.q.dtype), v.to(setup.q.dtype)


def run(simulator: Simulator, q: Tensor, v: Tensor, steps: int) -> tuple[Positions, Solution]:
    """State after some steps, and all solutions stacked along a new first dimension."""
    state = simulator.initial_state(q, v)
    solutions = []
    for _ in range(steps):
        state, solution = simulator.step(state)
        solutions.append(solution)
    return state, Solution(
        q=torch.stack([s.q for s in solutions]),
        status=torch.stack([s.status for s in solutions]),
        residual_norm=torch.stack([s.residual_norm for s in solutions]),
        iterations=torch.stack([s.iterations for s in solutions]),
        evaluations=torch.stack([s.evaluations for s in solutions]),
        fallbacks=torch.stack([s.fallbacks for s in solutions]),
    )


@both_dtypes
def test_world_of_a_batch_equals_the_world_alone(dtype: torch.dtype) -> None:
    """World k of 64 is bitwise the same world alone over 20 steps of the falling chain, with impacts, detours by continuation,
    halved steps (in float64) and exhausted budgets among them; also as a single world without batch dimension."""
    setup = chain_ground(64, dtype)
    halvings = 1 if dtype == torch.float64 else 0
    simulator = implicit(setup.scene, 0.02, solver=HASTY, halvings=halvings)
    q, v = scattered(setup, 0)
    _, whole = run(simulator, q, v, 20)
    happened = set(whole.status.flatten().tolist())
    assert {Status.SOLVED, Status.CONTINUED, Status.ITERATION_LIMIT} <= happened
    assert (Status.HALVED in happened) == (halvings > 0)
    rough = (whole.status == Status.CONTINUED).any(0).nonzero().flatten().tolist()
    failed = (whole.status == Status.ITERATION_LIMIT).any(0).nonzero().flatten().tolist()
    for k in (63, rough[0], failed[0]):
        _, alone = run(simulator, q[k : k + 1], v[k : k + 1], 20)
        assert_same(whole, (slice(None), k), alone)
    _, alone = run(simulator, q[rough[-1]], v[rough[-1]], 20)
    assert_same(whole, (slice(None), rough[-1]), alone)


@both_dtypes
def test_world_with_its_own_parameters_equals_the_world_alone(dtype: torch.dtype) -> None:
    """The sliding boxes have one μ each: world k of 5 is bitwise a scene of its own with that μ, 20 steps."""
    setup = box_slide(5, dtype)
    _, whole = run(implicit(setup.scene, 0.02), setup.q, setup.v, 20)
    for k in (0, 3):
        single = box_slide(k + 1, dtype)
        _, some = run(implicit(single.scene, 0.02), single.q, single.v, 20)
        assert torch.equal(some.q[:, k], whole.q[:, k])


@both_dtypes
def test_world_with_its_own_gravity_equals_the_world_alone(dtype: torch.dtype) -> None:
    """A world on the moon is bitwise the same beside a world on Jupiter as alone: no tolerance is shared between worlds."""
    setup = chain_ground(2, dtype)
    q, v = scattered(setup, 7)
    q[:, 2] -= 0.3
    gravity = torch.stack((0.17 * setup.scene.gravity, 2.5 * setup.scene.gravity))
    _, whole = run(implicit(dataclasses.replace(setup.scene, gravity=gravity), 0.02, solver=HASTY, halvings=0), q, v, 10)
    for k in range(2):
        scene = dataclasses.replace(setup.scene, gravity=gravity[k])
        _, alone = run(implicit(scene, 0.02, solver=HASTY, halvings=0), q[k], v[k], 10)
        assert_same(whole, (slice(None), k), alone)


@both_dtypes
def test_permuted_batch_gives_the_permuted_result(dtype: torch.dtype) -> None:
    """The order of the worlds does not matter, bitwise, over 6 steps."""
    setup = chain_ground(16, dtype)
    simulator = implicit(setup.scene, 0.02, solver=HASTY, halvings=1)
    q, v = scattered(setup, 1)
    order = torch.randperm(16, generator=generator(2))
    _, straight = run(simulator, q, v, 6)
    _, permuted = run(simulator, q[order], v[order], 6)
    assert_same(straight, (slice(None), order), permuted)


def test_batch_dimensions_are_only_a_shape() -> None:
    """Worlds `[6]` and the same worlds as `[2, 3]` come out bitwise the same."""
    setup = chain_ground(6)
    simulator = implicit(setup.scene, 0.02, solver=HASTY, halvings=1)
    q, v = scattered(setup, 3)
    flat, _ = run(simulator, q, v, 6)
    shaped, _ = run(simulator, q.view(2, 3, -1), v.view(2, 3, -1), 6)
    assert torch.equal(shaped.q.reshape(6, -1), flat.q)


def test_same_run_twice() -> None:
    """Determinism: bitwise the same states and counts, from objects built anew."""

    def once() -> tuple[Positions, Solution]:
        setup = chain_ground(8)
        return run(implicit(setup.scene, 0.02, solver=HASTY, halvings=1), *scattered(setup, 4), 10)

    (first, first_solution), (second, second_solution) = once(), once()
    assert torch.equal(first.q, second.q)
    assert torch.equal(first.q_previous, second.q_previous)
    assert torch.equal(first_solution.evaluations, second_solution.evaluations)


@both_dtypes
@pytest.mark.parametrize("where", ["q", "q_previous"])
def test_poisoned_state_harms_no_other_world(dtype: torch.dtype, where: str) -> None:
    """NaN in one world's state: its status says NON_FINITE, all other worlds are bitwise as without it, over 10 steps."""
    setup = chain_ground(6, dtype)
    simulator = implicit(setup.scene, 0.02, solver=HASTY, halvings=1)
    clean = simulator.initial_state(*scattered(setup, 5))
    q, q_previous = clean.q.clone(), clean.q_previous.clone()
    (q if where == "q" else q_previous)[2, 9] = math.nan
    dirty = state_of(q, q_previous)
    others = [0, 1, 3, 4, 5]
    for k in range(10):
        clean, expected = simulator.step(clean)
        dirty, solution = simulator.step(dirty)
        if k == 0 or where == "q":  # a world whose θ_n is finite goes on from there
            assert int(solution.status[2]) == Status.NON_FINITE
        assert torch.equal(dirty.q[others], clean.q[others])
        assert torch.equal(solution.status[others], expected.status[others])
        assert torch.equal(solution.evaluations[others], expected.evaluations[others])


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_poisoned_control_harms_no_other_world(bad: float) -> None:
    """NaN or infinity in one world's control: NON_FINITE there, all other worlds bitwise unchanged."""
    setup = chain_fixed(4)
    articulation = setup.scene.articulation
    motors = Actuators.from_list(articulation, [Actuator.motor("m", articulation.joint_names[0])])
    simulator = implicit(Scene(articulation, (Inertia(), motors), setup.scene.gravity), 0.01)
    state = simulator.initial_state(setup.q, setup.v)
    control = torch.full((4, 1), 0.3, dtype=torch.float64)
    poisoned = control.clone()
    poisoned[1] = bad
    clean, _ = simulator.step(state, control)
    dirty, solution = simulator.step(state, poisoned)
    assert solution.status.tolist() == [Status.SOLVED, Status.NON_FINITE, Status.SOLVED, Status.SOLVED]
    assert torch.equal(dirty.q[[0, 2, 3]], clean.q[[0, 2, 3]])


def test_solved_step_as_guess() -> None:
    """The end of a solved step, given as the guess of the same step: 0 iterations, 1 evaluation, bitwise the same."""
    setup = chain_ground(3)
    simulator = implicit(setup.scene, 0.02)
    q, v = scattered(setup, 6, bend=0.01)
    state, _ = run(simulator, q, v, 2)
    after, solution = simulator.step(state)
    assert bool(solution.solved.all())
    fine = Descent().solve(simulator.objective(state), after.q)
    assert torch.equal(fine.q, after.q)
    assert fine.iterations.tolist() == [0, 0, 0]
    assert fine.evaluations.tolist() == [1, 1, 1]


@pytest.mark.parametrize("lagged", [False, True], ids=["roots", "energy"])
def test_compaction_changes_no_world(lagged: bool) -> None:
    """Of 64 chains 60 have long landed or still fall: the schedule drops their lanes, and no world's numbers change by a bit."""
    setup = chain_ground(64)
    simulator = implicit(setup.scene, 0.02)
    q, v = scattered(setup, 8, bend=0.02)
    q[:60, 2] += 5.0
    state, _ = run(simulator, q, v, 1)
    landing = dataclasses.replace(state, q=state.q.clone(), q_previous=state.q_previous.clone())
    for pose in (landing.q, landing.q_previous):
        pose[60:, 2] -= landing.q[60:, 2] - 0.03
    solver = lm() if lagged else Descent()
    objective = simulator.objective(landing)
    whole = solver.solve(objective.lagged(landing.q) if lagged else objective, objective.guess, landing.q)
    assert int(whole.evaluations.sum()) <= whole.lanes < 64 * int(whole.evaluations.max())
    for k in (0, 59, *range(60, 64)):
        part = simulator.objective(state_of(landing.q[k], landing.q_previous[k]))
        alone = solver.solve(part.lagged(landing.q[k]) if lagged else part, part.guess, landing.q[k])
        assert_same(whole, k, alone)


# No waiting -----------------------------------------------------------------------------------------------------------

WAITING = ("_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "item", "_to_copy", "unique", "_assert_async")


class Waits(TorchDispatchMode):
    """Notes operations that make the host wait for a device, or whose result's shape depends on values."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.seen: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = str(func.overloadpacket).removeprefix("aten.")
        keys = kwargs or {}
        moves = name == "_to_copy" and "device" not in keys  # a change of dtype alone stays on the device
        boolean = (
            name.startswith("index") and any(isinstance(x, Tensor) and x.dtype == torch.bool for x in args[1] or ())
            if len(args) > 1 and isinstance(args[1], list | tuple)
            else False
        )
        if boolean or (any(name == w or name.startswith(w + "_") for w in WAITING) and not moves):
            self.seen.append(name)
        return func(*args, **keys)


@pytest.mark.parametrize("solver", [Descent(), jtj_lm(), lbfgs()], ids=["Newton", "JTJ-LM", "L-BFGS"])
def test_a_round_waits_for_nothing(solver: Descent) -> None:
    """`Descent.advance` on a landing chain asks the device for no number: on a GPU it could be recorded as a graph."""
    setup = chain_ground(4)
    simulator = implicit(setup.scene, 0.02)
    q, v = scattered(setup, 9)
    state, _ = run(simulator, q, v, 14)
    with torch.no_grad():
        objective = simulator.objective(state)
        progress = solver.begin(objective, objective.guess, state.q)
        for _ in range(3):
            progress = solver.advance(objective, progress)
        assert bool(progress.running.any())
        waits = Waits()
        with waits:
            solver.advance(objective, progress)
    assert waits.seen == []


def test_waiting_is_seen() -> None:
    """The counter above does count."""
    x = torch.arange(3.0)
    for wait in (
        lambda: x.sum().item(),
        lambda: x.nonzero(),
        lambda: bool(x.sum() > 0),
        lambda: torch.equal(x, x),
        lambda: x[x > 1],
    ):
        waits = Waits()
        with waits:
            wait()
        assert waits.seen != []
