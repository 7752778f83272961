"""Searches against the functions that they model: step lengths, damping, and the way back from NaN."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.directions import Direction, GaussNewtonLm, JtjLm, Lm, Newton
from pbfd_torch.solvers.lbfgs import Lbfgs
from pbfd_torch.solvers.objective import Status
from pbfd_torch.solvers.searches import Backtracking, Bracket, Secant, Touching, Trial, TrustRegion, WorkSearch
from tests.random_trees import generator
from tests.solver_points import Point, plain
from tests.solver_problems import problem


def bracket(low: Tensor, low_work: Tensor, low_slope: Tensor, high: Tensor, high_work: Tensor, high_slope: Tensor) -> Bracket:
    zero = torch.zeros_like(low)
    return Bracket(zero, zero, low_work, low, low_work, low_slope, high, high_work, high_slope)


def test_touching_is_exact_for_a_touching_force() -> None:
    """φ(a) = f + s (a − low) + c (a − t)²₊ with f < 0 ≤ s, c > 0: from both ends' values and slopes the zero is found exactly, be
    it before or after the touch at t."""
    u = torch.rand(6, 4000, dtype=torch.float64, generator=generator(1))
    low, width = 0.5 * u[0], 0.1 + u[1]
    f, s, touch, c = -0.1 - u[2], 1.5 * u[3], u[4], 0.1 + 10 ** (4 * u[5])  # with the bracket's width as the unit
    high_work = f + s + c * (1 - touch) ** 2
    high_slope = (s + 2 * c * (1 - touch)) / width
    share = Touching(nearest=0.0).share(bracket(low, f, s / width, low + width, high_work, high_slope))
    work = f + s * share + c * (share - touch).clamp_min(0) ** 2
    inside = (high_work > 1e-3) & (touch < 0.99)
    assert int(inside.sum()) > 2000
    assert float(work[inside].abs().max()) <= 1e-7
    near = Touching().share(bracket(low, f, s / width, low + width, high_work, high_slope))
    assert bool(((near >= 0.02) & (near <= 0.98))[inside].all())


def test_touching_falls_back_to_the_secant() -> None:
    """Slopes that contradict the model, and values that are not finite: the straight line, between a tenth and nine tenths."""
    one = torch.ones(3, dtype=torch.float64)
    high_work = torch.tensor([1.0, 1.0, math.inf], dtype=torch.float64)
    high_slope = torch.tensor([-5.0, math.nan, math.nan], dtype=torch.float64)
    given = bracket(0 * one, -one, 3 * one, one, high_work, high_slope)
    assert Touching().share(given).tolist() == Secant().share(given).tolist() == [0.5, 0.5, 0.1]


def test_work_search_brackets_the_zero() -> None:
    """φ(a) = 0 of a stiff touch: the bracket shrinks around the zero from both sides until |φ| ≤ ½ |φ(0)|."""
    contact = problem("stiff contact")
    solver = Descent()
    objective = contact.objective(torch.float64)
    progress = solver.begin(objective, contact.start(torch.float64)[None])
    widths = []
    while bool(progress.running.any()):
        before, progress = progress, solver.advance(objective, progress)
        memory = progress.memory
        assert isinstance(memory, Bracket)
        if bool(torch.isfinite(memory.high)):
            assert float(memory.low) < float(memory.length) < float(memory.high)
            assert float(memory.low_work) < 0 <= float(memory.high_work)
            widths.append(float(memory.high - memory.low))
        elif int(progress.iterations) > int(before.iterations) > 0 and bool(progress.running):
            work = (objective.residual(progress.q[0]) * before.direction[0]).sum()
            assert float(work) < 0.5 * abs(float(before.memory.start_work))  # type: ignore[attr-defined]
    assert len(widths) > 0
    assert progress.status.tolist() == [Status.SOLVED]


@pytest.mark.parametrize(
    ("direction", "name"), [(Newton(), "arc tangent"), (Lm(), "Rosenbrock"), (GaussNewtonLm(), "stiff"), (Lbfgs(), "Rosenbrock")]
)
def test_backtracking_satisfies_armijo(direction: Direction, name: str) -> None:
    """Every accepted step of length a lowers the merit by at least 1e-4 a |slope|, up to rounding; some full steps do not."""
    case = problem(name)
    solver = Descent(direction, Backtracking())
    objective = case.objective(torch.float64)
    progress = solver.begin(objective, case.start(torch.float64))
    shortened = 0
    while bool(progress.running):
        before, progress = progress, solver.advance(objective, progress)
        if int(progress.iterations) == int(before.iterations):
            shortened += int(before.model is not None)
            continue
        assert before.model is not None
        old, new = (float(direction.merit(objective, objective.evaluate(p.q))) for p in (before, progress))
        a, slope = float(before.memory.length), float(direction.slope(before.model, before.direction))
        assert slope < 0
        assert new <= old + 1e-4 * a * slope + 1e-14 * abs(old)
    assert int(progress.status) == Status.SOLVED
    assert shortened > 0


def test_damping_falls_and_rises() -> None:
    """λ: a tenth where the model keeps its promise, tenfold where the merit rises or is NaN, fourfold where little of the promise
    is kept, the same between; a rejected world is stalled once λ exceeds the largest."""
    n = 5
    search, rule = TrustRegion(), Lm()
    one = torch.ones(n, 1, dtype=torch.float64)
    objective = plain(1)
    start = Point(-one, one[..., None], value=torch.full((n,), 10.0, dtype=torch.float64))
    model = rule.model(objective, start, None, 0 * one, torch.ones(n, dtype=torch.bool))
    direction = rule.step(model, torch.zeros(n, dtype=torch.float64))  # promises a decrease by ½
    memory = search.begin(one[:, 0])
    memory = search.aim(memory, Trial(objective, rule, start, model, direction), torch.ones(n, dtype=torch.bool))
    assert torch.equal(memory.promised, 0.5 * one[:, 0])
    gained = torch.tensor([0.5, 0.2, 0.05, -1.0, math.nan], dtype=torch.float64)
    trial = Trial(objective, rule, Point(0 * one, one[..., None], value=10 - gained), model, direction)
    verdict, after = search.judge(memory, trial)
    assert verdict.good.tolist() == [True, True, True, False, False]
    factors = (after.damping / memory.damping).tolist()
    assert factors == pytest.approx([0.1, 1.0, 4.0, 10.0, 10.0])
    assert not bool(verdict.stalled.any())
    for _ in range(20):
        verdict, after = search.judge(after, trial)
    assert verdict.stalled.tolist()[3:5] == [True, True]
    assert float(after.damping[0]) == pytest.approx(1e-12)  # the square of the first


def test_promises_below_rounding_are_judged_by_the_residual() -> None:
    """A step that promises 1e-20 of a merit of 10 is good where ‖r‖ falls, whatever the merit's last digit does."""
    search, rule = TrustRegion(), Lm()
    one = torch.ones(2, 1, dtype=torch.float64)
    start = Point(-1e-10 * one, one[..., None], value=10 * one[:, 0])
    model = rule.model(plain(1), start, None, 0 * one, torch.ones(2, dtype=torch.bool))
    direction = rule.step(model, torch.zeros(2, dtype=torch.float64))
    memory = search.aim(search.begin(one[:, 0]), Trial(plain(1), rule, start, model, direction), one[:, 0] > 0)
    last_digit = torch.tensor([2e-15, -2e-15], dtype=torch.float64)
    found = Point(torch.tensor([[1e-11], [1e-9]], dtype=torch.float64), one[..., None], value=10 + last_digit)
    verdict, after = search.judge(memory, Trial(plain(1), rule, found, model, direction))
    assert verdict.good.tolist() == [True, False]
    assert (after.damping / memory.damping).tolist() == pytest.approx([0.1, 10.0])


@pytest.mark.parametrize("search", [WorkSearch(), WorkSearch(interpolation=Secant()), Backtracking(), TrustRegion()], ids=str)
def test_searches_recover_from_nan(search: WorkSearch | Backtracking | TrustRegion) -> None:
    """log q = 0 from 20: the full step lands where the logarithm is NaN; every search shortens it and goes on."""
    rule = JtjLm() if isinstance(search, TrustRegion) else Newton()
    solution = Descent(rule, search).solve(
        problem("logarithm").objective(torch.float64), torch.full((1,), 20.0, dtype=torch.float64)
    )
    assert int(solution.status) == Status.SOLVED
