"""Solvers on small problems: known roots, honest statuses and counts."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.directions import GaussNewtonLm
from pbfd_torch.solvers.lbfgs import Lbfgs
from pbfd_torch.solvers.lock_step import FEWEST_LANES
from pbfd_torch.solvers.named import lbfgs, lm
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.solvers.searches import Backtracking
from tests.random_trees import generator
from tests.solver_problems import METHODS, PAIRS, ROOT_METHODS, FunctionObjective, Method, Problem, changed, problem

TOLERANCE = {torch.float64: 1e-9, torch.float32: 1e-3}
all_pairs = pytest.mark.parametrize(("name", "problem"), PAIRS, ids=[f"{name}: {p}" for name, p in PAIRS])
UNLIKE = [
    pair for pair in PAIRS if pair[0] not in ("Newton, secant", "Newton, backtracking", "projected, secant", "LM, backtracking")
]
all_methods = pytest.mark.parametrize("method", ROOT_METHODS.values(), ids=ROOT_METHODS)
both_dtypes = pytest.mark.parametrize("dtype", TOLERANCE, ids=["float64", "float32"])


@dataclass(frozen=True)
class Limit:
    """What a method is known to do with a problem instead of solving it: to end unsolved, or to find another root."""

    reason: str
    dtypes: tuple[torch.dtype, ...] = (torch.float64, torch.float32)
    root: tuple[float, ...] | None = None  # None: unsolved


ASTRAY = Limit("½‖∇E‖² sinks towards ½ for x → −∞ along the valley: a non-zero infimum far from the minimum")
UPHILL = Limit("the step that lowers E raises ½‖∇E‖², whose only root nearby is the saddle: backtracking on it stalls at the start")
SADDLE = Limit("½‖∇E‖² leads to the nearest root of ∇E, a saddle", root=(0.0, 0.0))
FINE = Limit("the slip of 1e-5 is a smaller share of the step than backtracking tries in float32 (ε^.6 = 7e-5)", (torch.float32,))
CONCAVE = Limit(
    "½‖r‖² is concave up to the root's neighbourhood: no pair of L-BFGS is usable, or it leads across to the other side"
)
LIMITS = {
    **{("Rosenbrock", name): ASTRAY for name in ("Newton, backtracking", "projected, backtracking")},
    **{("Rosenbrock", name): ASTRAY for name in ("JTJ-LM", "LM on GE", "L-BFGS on GE")},
    **{("beside a saddle", name): UPHILL for name in ("Newton, backtracking", "projected, backtracking")},
    **{("beside a saddle", name): SADDLE for name in ("JTJ-LM", "LM on GE", "L-BFGS on GE")},
    **{("sticking", name): FINE for name in ("Newton, backtracking", "projected, backtracking")},
    **{(name, "L-BFGS on GE"): CONCAVE for name in ("arc tangent", "logarithm")},
}


def limit(name: str, problem: Problem, dtype: torch.dtype) -> Limit | None:
    """The known limit of a method on a problem."""
    found = [
        x for (prefix, method), x in LIMITS.items() if method == name and problem.name.startswith(prefix) and dtype in x.dtypes
    ]
    return found[0] if found else None


def scalar_objective(function: Callable[[Tensor], Tensor], dtype: torch.dtype = torch.float64) -> FunctionObjective:
    return FunctionObjective(lambda q, ease: function(q), torch.ones(1, dtype=dtype))


# Problems with known roots --------------------------------------------------------------------------------------------


@all_pairs
@both_dtypes
def test_root_is_found(name: str, dtype: torch.dtype, problem: Problem) -> None:
    """r(q*) = 0 to the tolerance that the docs state, at the known root; the counts are those of the calls made. Methods with a
    known limit say that they are unsolved, or find the root that it names."""
    objective, known = problem.objective(dtype), limit(name, problem, dtype)
    solution = METHODS[name].solve(objective, problem.start(dtype))
    residual = problem.residual(solution.q)
    assert solution.q.dtype == dtype
    assert bool(torch.isfinite(solution.q).all())
    assert float(torch.linalg.vector_norm(residual)) == pytest.approx(float(solution.residual_norm), rel=1e-6, abs=1e-12)
    assert solution.fallbacks.tolist() == [0, 0, 0, 0]
    assert solution.lanes == int(solution.evaluations)
    # the exact Hessian of ½‖r‖² evaluates r once more, but where the solver has arrived
    again = int(solution.evaluations) - int(solution.solved) if name == "LM on GE" else 0
    assert len(objective.calls) == int(solution.evaluations) + again
    if known is not None and known.root is None:
        assert int(solution.status) in (Status.STALLED, Status.ITERATION_LIMIT)
        assert not bool(solution.solved)
        assert float(solution.residual_norm) > TOLERANCE[dtype]
        return
    root = problem.root if known is None or known.root is None else known.root
    assert int(solution.status) == Status.SOLVED
    assert 1 <= int(solution.iterations) < int(solution.evaluations)
    assert float(solution.residual_norm) <= TOLERANCE[dtype]
    near = problem.precision if dtype == torch.float64 else problem.precision32
    assert float((solution.q - torch.tensor(root, dtype=dtype)).abs().max()) <= near


@all_pairs
@both_dtypes
def test_solution_as_guess_comes_back_bitwise(name: str, dtype: torch.dtype, problem: Problem) -> None:
    """Guess = solution: 0 iterations, one evaluation, and the guess itself. The solution is Newton's, which has no limits here."""
    first = ROOT_METHODS["Newton, work"].solve(problem.objective(dtype), problem.start(dtype))
    again = METHODS[name].solve(problem.objective(dtype), first.q)
    assert torch.equal(again.q, first.q)
    assert (int(again.status), int(again.iterations), int(again.evaluations)) == (Status.SOLVED, 0, 1)
    assert torch.equal(again.residual_norm, first.residual_norm)


@pytest.mark.parametrize(("name", "problem"), UNLIKE, ids=[f"{name}: {p}" for name, p in UNLIKE])
def test_batch_of_guesses(name: str, problem: Problem) -> None:
    """A batch `[2, 3]` of guesses gives, world by world, bitwise what each gives alone, counts included."""
    objective, method = problem.objective(torch.float64), changed(METHODS[name], max_evaluations=12)
    guess = problem.start(torch.float64)
    guesses = guess * (1 + 0.3 * torch.rand(2, 3, len(guess), dtype=torch.float64, generator=generator(1)))
    whole = method.solve(objective, guesses)
    assert whole.fallbacks.shape == (2, 3, 4)
    for i in range(2):
        for j in range(3):
            assert_same(whole, (i, j), method.solve(objective, guesses[i, j]))


def assert_same(whole: Solution, index: Any, alone: Solution) -> None:
    """One world of a batch and a solution of its own are bitwise the same."""
    for name in ("q", "status", "residual_norm", "iterations", "evaluations", "fallbacks"):
        found, expected = getattr(whole, name)[index], getattr(alone, name)
        assert torch.equal(found, expected.reshape(found.shape)), name


@all_methods
def test_scale_divides_the_residual(method: Method) -> None:
    """residual_norm = ‖r/scale‖₂, and that is what the tolerance is compared with."""
    objective = FunctionObjective(lambda q, ease: q**3, torch.full((1,), 1e6, dtype=torch.float64))
    solution = method.solve(objective, torch.tensor([2.0], dtype=torch.float64))
    assert int(solution.status) == Status.SOLVED
    assert float(solution.residual_norm) == pytest.approx(float(solution.q) ** 3 / 1e6, rel=1e-12)
    assert 1e-9 < float(solution.q) ** 3 <= 1e-3


# Statuses -------------------------------------------------------------------------------------------------------------


@all_methods
@pytest.mark.parametrize(
    "function",
    [lambda q: q * q + 1, lambda q: torch.exp(q) + 0.5, lambda q: 1 + 0 * q, lambda q: torch.sign(q) + 0.5 + 0 * q],
    ids=["q² + 1", "exp + ½", "constant", "jump"],
)
def test_unsolvable_problems_say_so(method: Method, function: Callable[[Tensor], Tensor]) -> None:
    """No root: STALLED or ITERATION_LIMIT, not solved; the point returned is finite, and its residual_norm is that of the point."""
    short = changed(method, max_evaluations=30)
    solution = short.solve(scalar_objective(function), torch.tensor([3.0], dtype=torch.float64))
    assert int(solution.status) in (Status.STALLED, Status.ITERATION_LIMIT)
    assert not bool(solution.solved)
    assert bool(torch.isfinite(solution.q).all())
    assert float(solution.residual_norm) == pytest.approx(abs(float(function(solution.q))), rel=1e-12)


@pytest.mark.parametrize("name", ROOT_METHODS)
def test_infinite_residuals_are_never_accepted(name: str) -> None:
    """The first full step from 0 along r = −1/|1 − q| lands on the pole, where r pushes on with infinite force: refused; the point
    returned has a finite residual. Only what lowers ½‖r‖² by itself may turn round, to where r = −1e-9 counts as solved."""
    short = changed(ROOT_METHODS[name], max_evaluations=120)
    solution = short.solve(scalar_objective(lambda q: -1 / (1 - q).abs()), torch.zeros(1, dtype=torch.float64))
    if name in ("JTJ-LM", "LM on GE", "L-BFGS on GE"):
        assert not bool(solution.solved) or float(solution.q) <= 1 - 1e9
    else:
        assert not bool(solution.solved)
    assert bool(torch.isfinite(solution.residual_norm))
    assert float(solution.q) < 1.0


@all_methods
def test_unsolvable_world_harms_no_other(method: Method) -> None:
    """q³ = c with one world at c = NaN: that world is NON_FINITE, and the others come out bitwise as in a batch without it."""
    guess = torch.tensor([[3.0], [2.0], [5.0]], dtype=torch.float64)
    clean = method.solve(scalar_objective(lambda q: q**3 - 8), guess)
    poisoned = guess.clone()
    poisoned[1] = math.nan
    dirty = method.solve(scalar_objective(lambda q: q**3 - 8), poisoned)
    assert dirty.status.tolist() == [Status.SOLVED, Status.NON_FINITE, Status.SOLVED]
    for k in (0, 2):
        assert_same(
            dirty,
            k,
            Solution(
                clean.q[k], clean.status[k], clean.residual_norm[k], clean.iterations[k], clean.evaluations[k], clean.fallbacks[k]
            ),
        )


@all_methods
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_guess(method: Method, bad: float) -> None:
    """NaN or infinity in the guess, or in the residual there: NON_FINITE at once, the guess unchanged."""
    guess = torch.tensor([bad], dtype=torch.float64)
    solution = method.solve(scalar_objective(lambda q: torch.atan(q) - 1), guess)
    assert int(solution.status) == Status.NON_FINITE
    assert int(solution.iterations) == 0
    assert torch.equal(solution.q.isnan(), guess.isnan())
    start = torch.tensor([-1.0], dtype=torch.float64)
    solution = method.solve(scalar_objective(torch.log), start)
    assert int(solution.status) == Status.NON_FINITE
    assert torch.equal(solution.q, start)


@pytest.mark.parametrize("budget", [1, 2, 5])
def test_evaluation_budget_is_kept(budget: int) -> None:
    """max_evaluations: ITERATION_LIMIT after exactly that many evaluations, with the best point so far."""
    valley = problem("Rosenbrock")
    objective = valley.objective(torch.float64)
    solution = Descent(max_evaluations=budget).solve(objective, valley.start(torch.float64))
    assert int(solution.status) == Status.ITERATION_LIMIT
    assert int(solution.evaluations) == len(objective.calls) == budget
    residual = valley.residual(solution.q)
    assert float(torch.linalg.vector_norm(residual)) == pytest.approx(float(solution.residual_norm), rel=1e-12)


def test_tolerance_is_honoured() -> None:
    """A looser tolerance ends earlier, with a residual below it."""
    cubic = problem("cubic")
    guess = cubic.start(torch.float64)
    rough = Descent(tolerance=1e-1).solve(cubic.objective(torch.float64), guess)
    fine = Descent(tolerance=1e-13).solve(cubic.objective(torch.float64), guess)
    assert 1e-9 < float(rough.residual_norm) <= 1e-1
    assert float(fine.residual_norm) <= 1e-13
    assert int(rough.evaluations) < int(fine.evaluations)


def test_rounding_is_not_asked_for() -> None:
    """A residual that rounds to no better than 1e-6 counts as solved there: ‖r/(scale + rounding/tolerance)‖ ≤ tolerance."""

    class Rough(FunctionObjective):
        @property
        def rounding(self) -> Tensor:
            return torch.full((1,), 2e-6, dtype=torch.float64)

    function = Rough(lambda q, ease: torch.round((q - 0.3) * 1e6) / 1e6 + 1e-6 + 0 * q, torch.ones(1, dtype=torch.float64), _one)
    solution = Descent().solve(function, torch.tensor([1.0], dtype=torch.float64))
    assert int(solution.status) == Status.SOLVED
    assert float((solution.q - 0.3).abs().max()) <= 4e-6


def _one(q: Tensor) -> Tensor:
    return torch.ones(1, 1, dtype=q.dtype)


def test_retreat_replaces_a_bad_guess() -> None:
    """‖r/scale‖ > 2 at the guess: the retreat is taken for it, which costs one evaluation more, even where the retreat is no
    better; a guess that is near enough is kept. A guess that is NaN is as bad as any."""
    retreat = torch.tensor([[1.1], [1.1], [1e6], [1e6]], dtype=torch.float64)
    guess = torch.tensor([[50.0], [1.2], [3.0], [3.1]], dtype=torch.float64)
    objective = scalar_objective(lambda q: q - 1)
    first = Descent(max_evaluations=1, retreat_above=2.0).solve(objective, guess, retreat)
    assert torch.equal(first.q, guess)
    second = Descent(max_evaluations=2, retreat_above=2.0).solve(objective, guess, retreat)
    assert second.q.flatten().tolist() == [1.1, 1.0, 1.0, 1e6]
    assert second.status.tolist() == [Status.ITERATION_LIMIT, Status.SOLVED, Status.SOLVED, Status.ITERATION_LIMIT]
    assert second.residual_norm.tolist() == pytest.approx([0.1, 0.0, 0.0, 1e6 - 1], abs=1e-12)
    bad = torch.tensor([[math.nan]], dtype=torch.float64)
    rescued = Descent().solve(scalar_objective(lambda q: q - 1), bad, retreat[:1])
    assert int(rescued.status) == Status.SOLVED


def test_minimising_method_needs_a_value() -> None:
    """A search that compares values, on a root problem: a TypeError that says what to do. The work search compares none, and L-BFGS
    with it finds the zero of any r that is a gradient."""
    for solver in (lm(), Descent(GaussNewtonLm(), Backtracking()), Descent(Lbfgs(), Backtracking())):
        with pytest.raises(TypeError, match="value"):
            solver.solve(scalar_objective(lambda q: q), torch.ones(1, dtype=torch.float64))
    assert bool(lbfgs().solve(scalar_objective(lambda q: q), torch.ones(1, dtype=torch.float64)).solved)


def test_step_length_is_limited_by_rotation() -> None:
    """No step turns a joint by more than max_turn: from 10 rad off, the way home takes at least 10 iterations at 1 rad each."""

    class Turning(FunctionObjective):
        def turn(self, step: Tensor) -> Tensor:
            return step.abs().amax(-1)

    objective = Turning(lambda q, ease: q, torch.ones(1, dtype=torch.float64))
    guess = torch.tensor([10.0], dtype=torch.float64)
    assert int(Descent(max_turn=1.0).solve(objective, guess).iterations) == 10
    assert int(Descent(max_turn=100.0).solve(objective, guess).iterations) == 1


# Compaction -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [(64,), (4, 16), (2, 4, 8)], ids=str)
@pytest.mark.parametrize("name", ["Newton, work", "JTJ-LM", "L-BFGS"])
def test_finished_worlds_are_compacted_away(name: str, batch: tuple[int, ...]) -> None:
    """64 worlds, each with its own scale, 48 of which end at once and 15 soon: each comes out bitwise as alone with its scale; the
    schedule spends at least what the worlds ask for, less than all lanes until the last world is done, and no lane more than the
    compaction at half of the lanes allows: fewer than two per evaluation asked for while more than 8 run."""
    valley = problem("Rosenbrock")
    random = generator(5)
    guess = valley.start(torch.float64).repeat(64, 1)
    guess[:63] = 1 + 0.1 * torch.randn(63, 2, dtype=torch.float64, generator=random)
    guess[:48] = 1.0
    order = torch.randperm(64, generator=random)
    guess = guess[order].view(*batch, 2)
    scale = (0.5 + torch.rand(*batch, 2, dtype=torch.float64, generator=random)).contiguous()
    method = ROOT_METHODS["Newton, work"] if name == "Newton, work" else changed(METHODS[name], max_evaluations=60)
    objective = FunctionObjective(valley.function, scale, valley.stiffness, energy=True)
    whole = method.solve(objective, guess)
    assert whole.q.shape == (*batch, 2)
    assert whole.status.shape == whole.evaluations.shape == batch
    for index in ((0,) * len(batch), tuple(n - 1 for n in batch), tuple(n // 2 for n in batch)):
        assert_same(whole, index, method.solve(dataclasses.replace(objective, scale=scale[index]), guess[index]))
    asked, longest = int(whole.evaluations.sum()), int(whole.evaluations.max())
    assert longest > 10
    assert asked <= whole.lanes < 64 * longest
    assert whole.lanes < 2 * asked + FEWEST_LANES * longest


def test_few_worlds_are_not_compacted() -> None:
    """Up to 8 lanes a round costs the same: they all stay, and are counted."""
    valley = problem("Rosenbrock")
    guess = torch.cat((torch.ones(7, 2, dtype=torch.float64), valley.start(torch.float64)[None]))
    solution = Descent().solve(valley.objective(torch.float64), guess)
    assert solution.evaluations[:7].tolist() == [1] * 7
    assert solution.lanes == 8 * int(solution.evaluations[7])


def test_empty_batch() -> None:
    """No worlds: no evaluations, and empty results."""
    solution = Descent().solve(problem("cubic").objective(torch.float64), torch.ones(0, 1, dtype=torch.float64))
    assert solution.q.shape == (0, 1)
    assert solution.status.shape == (0,)
    assert solution.lanes == 0
