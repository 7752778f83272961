"""Solvers: known roots, honest statuses and counts; and in simulations worlds that never feel each other, bit for bit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch.integrators.implicit_euler import State
from pbfd_torch.kinematics import retract
from pbfd_torch.models.boxes import box_slide
from pbfd_torch.models.chains import chain_fixed, chain_ground, chain_slope_drop
from pbfd_torch.models.setup import Setup
from pbfd_torch.objective import BalanceObjective
from pbfd_torch.simulator import Scene, Simulator
from pbfd_torch.solvers.continuation import Continuation
from pbfd_torch.solvers.jtj_lm import JtjLm
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.inertia import Inertia
from tests.random_trees import generator
from tests.solver_problems import PROBLEMS, FunctionObjective, Problem

Solver = JtjLm | Continuation
SOLVERS: tuple[Solver, ...] = (JtjLm(), Continuation())  # a new solver: append it, it gets every problem in both dtypes
# few evaluations a stage: detours and exhausted budgets become common and stay cheap
HASTY = Continuation(inner=JtjLm(max_evaluations=8), last=JtjLm(max_evaluations=12), ladders=((1e-2,),))
TOLERANCE = {torch.float64: 1e-9, torch.float32: 1e-3}
all_solvers = pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: type(s).__name__)
both_dtypes = pytest.mark.parametrize("dtype", TOLERANCE, ids=["float64", "float32"])


def scalar_objective(function: Callable[[Tensor], Tensor], dtype: torch.dtype = torch.float64) -> FunctionObjective:
    return FunctionObjective(lambda q, share: function(q), torch.ones(1, dtype=dtype))


# Problems with known roots --------------------------------------------------------------------------------------------


@all_solvers
@both_dtypes
@pytest.mark.parametrize("problem", PROBLEMS, ids=str)
def test_root_is_found(solver: Solver, dtype: torch.dtype, problem: Problem) -> None:
    """r(q*) = 0 to the tolerance that the docs state, at the known root; the counts are those of the calls made."""
    objective = problem.objective(dtype)
    solution = solver.solve(objective, torch.tensor(problem.guess, dtype=dtype))
    assert int(solution.status) == Status.SOLVED
    assert solution.q.dtype == dtype
    assert int(solution.evaluations) == len(objective.calls)
    assert 1 <= int(solution.iterations) < int(solution.evaluations)
    assert float(solution.residual_norm) <= TOLERANCE[dtype]
    residual = problem.function(solution.q, 1.0)
    assert float(torch.linalg.vector_norm(residual)) == pytest.approx(float(solution.residual_norm), rel=1e-6, abs=1e-12)
    near = problem.precision if dtype == torch.float64 else 5e-3
    assert float((solution.q - torch.tensor(problem.root, dtype=dtype)).abs().max()) <= near


@all_solvers
@both_dtypes
@pytest.mark.parametrize("problem", PROBLEMS, ids=str)
def test_solution_as_guess_comes_back_bitwise(solver: Solver, dtype: torch.dtype, problem: Problem) -> None:
    """Guess = solution: 0 iterations, one evaluation, and the guess itself."""
    objective = problem.objective(dtype)
    first = solver.solve(objective, torch.tensor(problem.guess, dtype=dtype))
    again = solver.solve(objective, first.q)
    assert torch.equal(again.q, first.q)
    assert (int(again.status), int(again.iterations), int(again.evaluations)) == (Status.SOLVED, 0, 1)
    assert torch.equal(again.residual_norm, first.residual_norm)


@all_solvers
@pytest.mark.parametrize("problem", PROBLEMS, ids=str)
def test_batch_of_guesses(solver: Solver, problem: Problem) -> None:
    """A batch `[2, 3]` of guesses gives, world by world, bitwise what each gives alone, counts included."""
    random = generator(1)
    objective = problem.objective(torch.float64)
    guess = torch.tensor(problem.guess, dtype=torch.float64)
    guesses = guess * (1 + 0.3 * torch.rand(2, 3, len(guess), dtype=torch.float64, generator=random))
    whole = solver.solve(objective, guesses)
    for i in range(2):
        for j in range(3):
            alone = solver.solve(objective, guesses[i, j])
            assert_same(whole, (i, j), alone)


def assert_same(whole: Solution, index: Any, alone: Solution) -> None:
    """One world of a batch and a solution of its own are bitwise the same."""
    for name in ("q", "status", "residual_norm", "iterations", "evaluations"):
        found, expected = getattr(whole, name)[index], getattr(alone, name)
        assert torch.equal(found, expected.reshape(found.shape)), name


@all_solvers
def test_scale_divides_the_residual(solver: Solver) -> None:
    """residual_norm = ‖r/scale‖₂, and that is what the tolerance is compared with."""
    objective = FunctionObjective(lambda q, share: q**3, torch.full((1,), 1e6, dtype=torch.float64))
    solution = solver.solve(objective, torch.tensor([2.0], dtype=torch.float64))
    assert int(solution.status) == Status.SOLVED
    assert float(solution.residual_norm) == pytest.approx(float(solution.q) ** 3 / 1e6, rel=1e-12)
    assert 1e-9 < float(solution.q) ** 3 <= 1e-3


# Statuses -------------------------------------------------------------------------------------------------------------


@all_solvers
@pytest.mark.parametrize(
    "function",
    [lambda q: q * q + 1, lambda q: torch.exp(q) + 0.5, lambda q: 1 + 0 * q, lambda q: torch.sign(q) + 0.5],
    ids=["q² + 1", "exp + ½", "constant", "jump"],
)
def test_unsolvable_problems_say_so(solver: Solver, function: Callable[[Tensor], Tensor]) -> None:
    """No root: STALLED or ITERATION_LIMIT, not solved; the point returned is finite, and its residual_norm is that of the point."""
    solution = solver.solve(scalar_objective(function), torch.tensor([3.0], dtype=torch.float64))
    assert int(solution.status) in (Status.STALLED, Status.ITERATION_LIMIT)
    assert not bool(solution.solved)
    assert bool(torch.isfinite(solution.q).all())
    assert float(solution.residual_norm) == pytest.approx(abs(float(function(solution.q))), rel=1e-12)


@all_solvers
def test_infinite_residuals_are_never_accepted(solver: Solver) -> None:
    """The first full step from 0 along r = −1/|1 − q| lands on the pole, where r pushes on with infinite force: refused; the point
    returned has a finite residual."""
    solution = solver.solve(scalar_objective(lambda q: -1 / (1 - q).abs()), torch.zeros(1, dtype=torch.float64))
    assert not bool(solution.solved)
    assert bool(torch.isfinite(solution.residual_norm))
    assert float(solution.q) < 1.0


@all_solvers
def test_unsolvable_world_harms_no_other(solver: Solver) -> None:
    """q³ = c with one world at c = NaN: that world is NON_FINITE, and the others come out bitwise as in a batch without it."""
    guess = torch.tensor([[3.0], [2.0], [5.0]], dtype=torch.float64)
    clean = solver.solve(scalar_objective(lambda q: q**3 - 8), guess)
    poisoned = guess.clone()
    poisoned[1] = math.nan
    dirty = solver.solve(scalar_objective(lambda q: q**3 - 8), poisoned)
    assert dirty.status.tolist() == [Status.SOLVED, Status.NON_FINITE, Status.SOLVED]
    for k in (0, 2):
        assert_same(
            dirty, k, Solution(clean.q[k], clean.status[k], clean.residual_norm[k], clean.iterations[k], clean.evaluations[k])
        )


@all_solvers
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_guess(solver: Solver, bad: float) -> None:
    """NaN or infinity in the guess, or in the residual there: NON_FINITE at once, the guess unchanged."""
    guess = torch.tensor([bad], dtype=torch.float64)
    solution = solver.solve(scalar_objective(lambda q: torch.atan(q) - 1), guess)
    assert int(solution.status) == Status.NON_FINITE
    assert int(solution.iterations) == 0
    assert torch.equal(solution.q.isnan(), guess.isnan())
    start = torch.tensor([-1.0], dtype=torch.float64)
    solution = solver.solve(scalar_objective(torch.log), start)
    assert int(solution.status) == Status.NON_FINITE
    assert torch.equal(solution.q, start)


@pytest.mark.parametrize("budget", [1, 2, 5])
def test_evaluation_budget_is_kept(budget: int) -> None:
    """max_evaluations: ITERATION_LIMIT after exactly that many evaluations, with the best point so far."""
    problem = next(p for p in PROBLEMS if p.name.startswith("Rosenbrock"))
    objective = problem.objective(torch.float64)
    solution = JtjLm(max_evaluations=budget).solve(objective, torch.tensor(problem.guess, dtype=torch.float64))
    assert int(solution.status) == Status.ITERATION_LIMIT
    assert int(solution.evaluations) == len(objective.calls) == budget
    residual = problem.function(solution.q, 1.0)
    assert float(torch.linalg.vector_norm(residual)) == pytest.approx(float(solution.residual_norm), rel=1e-12)


def test_tolerance_is_honoured() -> None:
    """A looser tolerance ends earlier, with a residual below it."""
    problem = PROBLEMS[2]
    guess = torch.tensor(problem.guess, dtype=torch.float64)
    rough = JtjLm(tolerance=1e-1).solve(problem.objective(torch.float64), guess)
    fine = JtjLm(tolerance=1e-13).solve(problem.objective(torch.float64), guess)
    assert 1e-9 < float(rough.residual_norm) <= 1e-1
    assert float(fine.residual_norm) <= 1e-13
    assert int(rough.evaluations) < int(fine.evaluations)


def test_rounding_is_not_asked_for() -> None:
    """A residual that rounds to no better than 1e-6 counts as solved there: ‖r/(scale + rounding/tolerance)‖ ≤ tolerance."""

    class Rough(FunctionObjective):
        @property
        def rounding(self) -> Tensor:
            return torch.full((1,), 2e-6, dtype=torch.float64)

    function = Rough(lambda q, share: torch.round((q - 0.3) * 1e6) / 1e6 + 1e-6 + 0 * q, torch.ones(1, dtype=torch.float64), _one)
    solution = JtjLm().solve(function, torch.tensor([1.0], dtype=torch.float64))
    assert int(solution.status) == Status.SOLVED
    assert float((solution.q - 0.3).abs().max()) <= 4e-6


def _one(q: Tensor) -> Tensor:
    return torch.ones(1, 1, dtype=q.dtype)


def test_retreat_replaces_a_bad_guess() -> None:
    """‖r/scale‖ > 2 at the guess: the better of guess and retreat starts the search; a guess that is near enough is kept."""
    retreat = torch.tensor([[1.1], [1.1], [1e6]], dtype=torch.float64)
    guess = torch.tensor([[50.0], [1.2], [3.0]], dtype=torch.float64)
    only = JtjLm(max_evaluations=1, retreat_above=2.0)
    solution = only.solve(scalar_objective(lambda q: q - 1), guess, retreat)
    assert solution.q.flatten().tolist() == [1.1, 1.2, 3.0]
    assert solution.evaluations.tolist() == [2, 1, 1]
    bad = torch.tensor([[math.nan]], dtype=torch.float64)
    rescued = JtjLm().solve(scalar_objective(lambda q: q - 1), bad, retreat[:1])
    assert int(rescued.status) == Status.SOLVED


def test_step_length_is_limited_by_rotation() -> None:
    """No step turns a joint by more than max_turn: from 10 rad off, the way home takes at least 10 iterations at 1 rad each."""

    class Turning(FunctionObjective):
        def turn(self, step: Tensor) -> Tensor:
            return step.abs().amax(-1)

    objective = Turning(lambda q, share: q, torch.ones(1, dtype=torch.float64))
    guess = torch.tensor([10.0], dtype=torch.float64)
    assert int(JtjLm(max_turn=1.0).solve(objective, guess).iterations) == 10
    assert int(JtjLm(max_turn=100.0).solve(objective, guess).iterations) == 1


# Continuation ---------------------------------------------------------------------------------------------------------


def test_continuation_climbs_its_ladder() -> None:
    """Where the inner solver fails, the stages run with the softened problem at the ladder's shares, then the full one; the status
    is CONTINUED, the counts include the detour; worlds that the inner solver did solve keep its result bitwise."""
    problem = next(p for p in PROBLEMS if p.name == "stiff contact")
    inner = JtjLm(max_evaluations=8)
    solver = Continuation(inner=inner, last=JtjLm(max_evaluations=50), ladders=((1e-3, 1e-1),))
    guess = torch.tensor([[0.05], [-0.0031]], dtype=torch.float64)
    alone = inner.solve(problem.objective(torch.float64), guess)
    assert alone.status.tolist() == [Status.ITERATION_LIMIT, Status.SOLVED]
    objective = problem.objective(torch.float64)
    solution = solver.solve(objective, guess)
    assert solution.status.tolist() == [Status.CONTINUED, Status.SOLVED]
    assert bool(solution.solved.all())
    assert float(solution.q[0]) == pytest.approx(problem.root[0], rel=1e-9)
    assert torch.equal(solution.q[1], alone.q[1])
    assert int(solution.evaluations[1]) == int(alone.evaluations[1])
    assert sorted(set(objective.calls)) == [1e-3, 1e-1, 1.0]
    assert int(alone.evaluations[0]) < int(solution.evaluations[0]) <= len(objective.calls)


def test_continuation_reports_failure() -> None:
    """Where the detours fail as well, the world stays unsolved and keeps the point with the smaller residual."""
    objective = scalar_objective(lambda q: q * q + 1)
    inner = JtjLm(max_evaluations=10)
    guess = torch.tensor([3.0], dtype=torch.float64)
    first = inner.solve(objective, guess)
    solution = Continuation(inner=inner, last=inner).solve(objective, guess)
    assert int(solution.status) in (Status.STALLED, Status.ITERATION_LIMIT)
    assert float(solution.residual_norm) <= float(first.residual_norm)


def test_continuation_solves_a_step_that_a_short_search_cannot() -> None:
    """The first steps after an impact: with 10 evaluations the search alone leaves worlds unsolved, the continuation with the same
    inner search solves them all."""
    setup = chain_slope_drop(worlds=1)
    short = JtjLm(max_evaluations=10)
    helped = Simulator(setup.scene, 0.05, solver=Continuation(inner=short))
    alone = Simulator(setup.scene, 0.05, solver=short)
    state = helped.initial_state(setup.q, setup.v)
    failures = 0
    for _ in range(20):
        failures += int((~alone.step(state)[1].solved).sum())
        state, solution = helped.step(state)
        assert bool(solution.solved.all())
    assert failures > 0


# Worlds apart, bit for bit --------------------------------------------------------------------------------------------


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


def run(simulator: Simulator, q: Tensor, v: Tensor, steps: int) -> tuple[State, Solution]:
    """State after some steps, and all solutions stacked along a new first dimension."""
    state = simulator.initial_state(q, v)
    solutions = []
    for _ in range(steps):
        state, solution = simulator.step(state)
        solutions.append(solution)
    names = ("q", "status", "residual_norm", "iterations", "evaluations")
    return state, Solution(*(torch.stack([getattr(s, name) for s in solutions]) for name in names))


@both_dtypes
def test_world_of_a_batch_equals_the_world_alone(dtype: torch.dtype) -> None:
    """World k of 64 is bitwise the same world alone over 20 steps of the falling chain, with impacts, detours by continuation and
    exhausted budgets among them; also as a single world without batch dimension."""
    setup = chain_ground(64, dtype)
    simulator = Simulator(setup.scene, 0.02, solver=HASTY)
    q, v = scattered(setup, 0)
    _, whole = run(simulator, q, v, 20)
    happened = set(whole.status.flatten().tolist())
    assert {Status.SOLVED, Status.CONTINUED, Status.ITERATION_LIMIT} <= happened
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
    _, whole = run(Simulator(setup.scene, 0.02), setup.q, setup.v, 20)
    for k in (0, 3):
        single = box_slide(k + 1, dtype)
        _, some = run(Simulator(single.scene, 0.02), single.q, single.v, 20)
        assert torch.equal(some.q[:, k], whole.q[:, k])


@both_dtypes
def test_world_with_its_own_gravity_equals_the_world_alone(dtype: torch.dtype) -> None:
    """A world on the moon is bitwise the same beside a world on Jupiter as alone: no tolerance is shared between worlds."""
    setup = chain_ground(2, dtype)
    q, v = scattered(setup, 7)
    q[:, 2] -= 0.3
    gravity = torch.stack((0.17 * setup.scene.gravity, 2.5 * setup.scene.gravity))
    _, whole = run(Simulator(dataclasses.replace(setup.scene, gravity=gravity), 0.02, solver=HASTY), q, v, 10)
    for k in range(2):
        scene = dataclasses.replace(setup.scene, gravity=gravity[k])
        _, alone = run(Simulator(scene, 0.02, solver=HASTY), q[k], v[k], 10)
        assert_same(whole, (slice(None), k), alone)


@both_dtypes
def test_permuted_batch_gives_the_permuted_result(dtype: torch.dtype) -> None:
    """The order of the worlds does not matter, bitwise, over 6 steps."""
    setup = chain_ground(16, dtype)
    simulator = Simulator(setup.scene, 0.02, solver=HASTY)
    q, v = scattered(setup, 1)
    order = torch.randperm(16, generator=generator(2))
    _, straight = run(simulator, q, v, 6)
    _, permuted = run(simulator, q[order], v[order], 6)
    assert_same(straight, (slice(None), order), permuted)


def test_batch_dimensions_are_only_a_shape() -> None:
    """Worlds `[6]` and the same worlds as `[2, 3]` come out bitwise the same."""
    setup = chain_ground(6)
    simulator = Simulator(setup.scene, 0.02, solver=HASTY)
    q, v = scattered(setup, 3)
    flat, _ = run(simulator, q, v, 6)
    shaped, _ = run(simulator, q.view(2, 3, -1), v.view(2, 3, -1), 6)
    assert torch.equal(shaped.q.reshape(6, -1), flat.q)


def test_same_run_twice() -> None:
    """Determinism: bitwise the same states and counts, from objects built anew."""

    def once() -> tuple[State, Solution]:
        setup = chain_ground(8)
        return run(Simulator(setup.scene, 0.02, solver=HASTY), *scattered(setup, 4), 10)

    (first, first_solution), (second, second_solution) = once(), once()
    assert torch.equal(first.q, second.q)
    assert torch.equal(first.q_previous, second.q_previous)
    assert torch.equal(first_solution.evaluations, second_solution.evaluations)


@both_dtypes
@pytest.mark.parametrize("where", ["q", "q_previous"])
def test_poisoned_state_harms_no_other_world(dtype: torch.dtype, where: str) -> None:
    """NaN in one world's state: its status says NON_FINITE, all other worlds are bitwise as without it, over 10 steps."""
    setup = chain_ground(6, dtype)
    simulator = Simulator(setup.scene, 0.02, solver=HASTY)
    clean = simulator.initial_state(*scattered(setup, 5))
    q, q_previous = clean.q.clone(), clean.q_previous.clone()
    (q if where == "q" else q_previous)[2, 9] = math.nan
    dirty = State(q, q_previous)
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
    simulator = Simulator(Scene(articulation, (Inertia(), motors), setup.scene.gravity), 0.01)
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
    simulator = Simulator(setup.scene, 0.02)
    q, v = scattered(setup, 6, bend=0.01)
    state, _ = run(simulator, q, v, 2)
    after, solution = simulator.step(state)
    assert bool(solution.solved.all())
    dt = torch.tensor(0.02, dtype=torch.float64)
    context = simulator.integrator.context(setup.scene.articulation, state, dt, setup.scene.gravity, None)
    scale = torch.ones(setup.scene.articulation.nv, dtype=torch.float64) * 9.81
    objective = BalanceObjective.of_step(setup.scene.articulation, setup.scene.terms, context, scale)
    fine = JtjLm(tolerance=1e-6).solve(objective, after.q)
    assert torch.equal(fine.q, after.q)
    assert fine.iterations.tolist() == [0, 0, 0]
    assert fine.evaluations.tolist() == [1, 1, 1]
