"""The parts of a solver one by one: directions against closed forms, searches against the functions that they model."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
import torch
from torch import Tensor

from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.directions import Direction, GaussNewtonLm, JtjLm, Lm, Model, Newton, ProjectedNewton, projected
from pbfd_torch.solvers.lbfgs import Lbfgs
from pbfd_torch.solvers.objective import Status
from pbfd_torch.solvers.searches import Backtracking, Bracket, Secant, Touching, Trial, TrustRegion, WorkSearch
from pbfd_torch.solvers.squared import Squared
from tests.finite_differences import derivative, jacobian, relative_error
from tests.random_trees import generator
from tests.solver_problems import Ease, FunctionObjective, problem
from tests.test_solver_steps import step_of


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=generator(seed))


def positive(*shape: int, seed: int = 0) -> Tensor:
    """Random positive definite matrices."""
    a = random(*shape, shape[-1], seed=seed)
    return a @ a.mT + 0.5 * torch.eye(shape[-1], dtype=torch.float64)


class Point:
    """Given values at one point."""

    def __init__(self, residual: Tensor, jacobian: Tensor, stiffness: Tensor | None = None, value: Tensor | None = None) -> None:
        self.residual = residual
        self.jacobian = jacobian
        self.stiffness = jacobian if stiffness is None else stiffness
        self.value = torch.zeros(residual.shape[:-1], dtype=residual.dtype) if value is None else value


def plain(n: int, scale: Tensor | None = None) -> FunctionObjective:
    """An objective of which only the scale matters."""
    return FunctionObjective(lambda q, ease: q, torch.ones(n, dtype=torch.float64) if scale is None else scale)


def stepped(direction: Direction, point: Point, damping: float = 0.0, scale: Tensor | None = None) -> Tensor:
    """The direction's step from a point without a past."""
    r = point.residual
    start = torch.ones(r.shape[:-1], dtype=torch.bool)
    model = direction.model(plain(r.shape[-1], scale), point, None, torch.zeros_like(r), start)
    return direction.step(model, torch.full(r.shape[:-1], damping, dtype=r.dtype))


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    return torch.linalg.solve(matrix, right[..., None]).squeeze(-1)


# Directions -----------------------------------------------------------------------------------------------------------


def test_newton_step() -> None:
    """−J⁻¹r where that descends; −K⁻¹r where J's curvature outweighs inertia; −r/diag K where K is no better."""
    r, h = random(5, 4, seed=1), positive(5, 4, seed=2)
    torch.testing.assert_close(stepped(Newton(), Point(r, h)), -solved(h, r), rtol=1e-12, atol=1e-12)
    k = positive(5, 4, seed=3)
    torch.testing.assert_close(stepped(Newton(), Point(r, -h, k)), -solved(k, r), rtol=1e-12, atol=1e-12)
    diagonal = h.diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(stepped(Newton(), Point(r, -h, -h)), -r / diagonal, rtol=1e-12, atol=1e-12)
    singular = torch.zeros(5, 4, 4, dtype=torch.float64)
    assert torch.equal(stepped(Newton(), Point(r, singular, singular)), -r)


def test_projected_newton_step() -> None:
    """−J⁻¹r where that descends, else −|J|⁻¹r, |J| having the eigenvalues' absolute values; near-zero ones are lifted."""
    r, h = random(5, 4, seed=1), positive(5, 4, seed=2)
    torch.testing.assert_close(stepped(ProjectedNewton(), Point(r, h)), -solved(h, r), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(stepped(ProjectedNewton(), Point(r, -h)), -solved(h, r), rtol=1e-10, atol=1e-10)
    turn = torch.linalg.qr(random(4, 4, seed=4))[0]
    values = torch.tensor([3.0, -2.0, 0.0, 1.0], dtype=torch.float64)
    lifted = torch.tensor([3.0, 2.0, 3 * 2**-26, 1.0], dtype=torch.float64)  # ε^½ of the largest
    torch.testing.assert_close(projected(turn * values @ turn.mT), turn * lifted @ turn.mT, rtol=0, atol=1e-14)
    skew = random(4, 4, seed=5)
    skew = skew - skew.mT
    torch.testing.assert_close(projected(h + skew), h + skew, rtol=0, atol=1e-13)


def test_newton_steps_descend() -> None:
    """r·d < 0 for any J, K among random matrices, if r ≠ 0."""
    r, j, k = random(500, 4, seed=1), random(500, 4, 4, seed=2), random(500, 4, 4, seed=3)
    for direction in (Newton(), ProjectedNewton()):
        assert bool(((stepped(direction, Point(r, j, k)) * r).sum(-1) < 0).all())


@pytest.mark.parametrize("damping", [0.0, 1e-3, 1.0, 1e6])
def test_jtj_lm_step_solves_the_normal_equations(damping: float) -> None:
    """(JᵀS⁻²J + λ diag(JᵀS⁻²J)) d = −JᵀS⁻²r (Eq. 14 with Marquardt's damping), well conditioned: to 1e-12."""
    r, j = random(6, 4, seed=1), positive(6, 4, seed=2) + 0.3 * random(6, 4, 4, seed=3)
    scale = 0.5 + random(4, seed=4).abs()
    weighted = j / scale[:, None]
    normal = weighted.mT @ weighted
    normal = normal + damping * torch.diag_embed(normal.diagonal(dim1=-2, dim2=-1))
    expected = -solved(normal, (weighted.mT @ (r / scale)[..., None]).squeeze(-1))
    assert float(torch.linalg.cond(normal).max()) < 1e5
    found = stepped(JtjLm(), Point(r, j), damping, scale)
    assert float(((found - expected).norm(dim=-1) / expected.norm(dim=-1)).max()) <= 1e-12


def exactly_solved(matrix: Tensor, right: Tensor) -> list[Fraction]:
    """Gauss–Jordan elimination in rational numbers, of a float64 matrix taken as exact."""
    rows = [[Fraction(float(x)) for x in row] + [Fraction(float(b))] for row, b in zip(matrix, right, strict=True)]
    for k in range(len(rows)):
        pivot = max(range(k, len(rows)), key=lambda i: abs(rows[i][k]))
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [x / rows[k][k] for x in rows[k]]
        for i in range(len(rows)):
            if i != k:
                rows[i] = [a - rows[i][k] * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[-1] for row in rows]


def test_jtj_lm_step_of_an_ill_conditioned_problem() -> None:
    """κ(J) = 1e9: against rational arithmetic the QR step is right to κε ≈ 1e-6, where the normal equations, with κ² = 1e18, have
    no digit left."""
    turn = torch.linalg.qr(random(4, 4, seed=6))[0]
    j = turn * torch.tensor([1.0, 1e-3, 1e-6, 1e-9], dtype=torch.float64) @ turn.mT
    r = random(4, seed=8)
    exact = torch.tensor([-float(x) for x in exactly_solved(j, r)], dtype=torch.float64)

    def error(step: Tensor) -> float:
        return float((step - exact).norm() / exact.norm())

    normal = -solved(j.mT @ j, j.mT @ r)
    assert error(stepped(JtjLm(), Point(r, j))) <= 1e-6
    assert error(stepped(Newton(), Point(r, j))) <= 1e-6
    assert error(normal) > 1e-2


@pytest.mark.parametrize("damping", [0.0, 0.5, 100.0])
def test_lm_steps(damping: float) -> None:
    """−(H + λ diag K)⁻¹r with the exact Hessian, −(K + λ diag K)⁻¹r with Gauss–Newton's, and where H leads uphill."""
    r, h, k = random(5, 4, seed=1), positive(5, 4, seed=2), positive(5, 4, seed=3)
    added = damping * torch.diag_embed(k.diagonal(dim1=-2, dim2=-1))
    torch.testing.assert_close(stepped(Lm(), Point(r, h, k), damping), -solved(h + added, r), rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(stepped(GaussNewtonLm(), Point(r, h, k), damping), -solved(k + added, r), rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(stepped(Lm(), Point(r, -1e6 * h, k), damping), -solved(k + added, r), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("direction", [Newton(), ProjectedNewton(), JtjLm(), Lm()], ids=lambda d: type(d).__name__)
def test_slope_and_decrease_of_the_merit(direction: Direction) -> None:
    """The slope is the merit's derivative along the step, and on a quadratic (a linear residual) the decrease is exact."""
    h, away, step = positive(4, seed=2), random(4, seed=3), random(4, seed=4)
    scale = 0.5 + random(4, seed=5).abs()

    def energy(q: Tensor, ease: Ease) -> Tensor:
        return 0.5 * q @ h @ q

    objective = FunctionObjective(energy, scale, energy=True)

    def merit(a: float) -> float:
        return float(direction.merit(objective, objective.evaluate(away + a * step)))

    start = torch.ones((), dtype=torch.bool)
    model = direction.model(objective, objective.evaluate(away), None, torch.zeros_like(step), start)
    assert float(direction.slope(model, step)) == pytest.approx((merit(1e-4) - merit(-1e-4)) / 2e-4, rel=1e-7)
    assert float(direction.decrease(model, step)) == pytest.approx(merit(0) - merit(1), rel=1e-10)


@pytest.mark.parametrize("n", [1, 3, 6])
def test_lbfgs_learns_a_quadratic(n: int) -> None:
    """n pairs from exact line searches on an n-dimensional quadratic make the matrix H⁻¹ itself."""
    h, q = positive(n, seed=2), random(n, seed=3)
    rule, objective = Lbfgs(memory=8), plain(n)
    model, step = None, torch.zeros(n, dtype=torch.float64)
    for k in range(n + 1):
        model = rule.model(objective, Point(h @ q, h), model, step, torch.tensor(k == 0))
        direction = rule.step(model, torch.zeros(()))
        assert k == n or float(direction @ model[0]) < 0
        step = -(direction @ model[0]) / (direction @ h @ direction).clamp_min(1e-300) * direction
        q = q + step
    assert model is not None
    right = random(n, seed=9)
    found = rule.step((right, *model[1:]), torch.zeros(()))
    torch.testing.assert_close(found, -solved(h, right), rtol=1e-6, atol=1e-7)


def test_lbfgs_first_step_and_useless_pairs() -> None:
    """Without pairs: downhill, its largest entry `first_step`. A pair with y·s ≤ 0 is not kept; a restart forgets all."""
    rule, objective, r = Lbfgs(memory=3, first_step=0.01), plain(2), torch.tensor([[3.0, -4.0]], dtype=torch.float64)
    one = torch.eye(2, dtype=torch.float64)[None]
    fresh, going = torch.tensor([True]), torch.tensor([False])
    model = rule.model(objective, Point(r, one), None, torch.zeros_like(r), fresh)
    torch.testing.assert_close(rule.step(model, torch.zeros(1)), -0.01 * r / 4)
    back = rule.model(objective, Point(r - 1.0, one), model, torch.full_like(r, 0.5), going)
    assert not bool(back[3].any())
    learnt = rule.model(objective, Point(r + 1.0, one), model, torch.full_like(r, 0.5), going)
    assert learnt[3].tolist() == [[1.0, 0.0, 0.0]]
    assert not bool(rule.model(objective, Point(r + 2.0, one), learnt, torch.full_like(r, 0.5), fresh)[3].any())


def test_lbfgs_memory_is_a_queue() -> None:
    """Only the newest pairs stay, the newest first."""
    rule, objective, h = Lbfgs(memory=2), plain(1), torch.ones(1, 1, dtype=torch.float64)
    q, step = torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    model = rule.model(objective, Point(q, h), None, step, torch.tensor(True))
    for k in (1.0, 2.0, 3.0):
        step = torch.full((1,), k, dtype=torch.float64)
        q = q + step
        model = rule.model(objective, Point(q, h), model, step, torch.tensor(False))
    assert model[1].flatten().tolist() == [3.0, 2.0]


def test_no_direction_is_sought_where_all_have_arrived() -> None:
    """Newton on a quadratic: two evaluations, one direction, and the same end in the round that serves other schedules."""
    sought: list[int] = []

    class Counted(Newton):
        def step(self, model: Model, damping: Tensor) -> Tensor:
            sought.append(1)
            return super().step(model, damping)

    given = problem("quadratic")
    objective, solver = given.objective(torch.float64), Descent(Counted())
    guess = given.start(torch.float64).expand(3, -1)
    solution = solver.solve(objective, guess)
    assert solution.evaluations.tolist() == [2, 2, 2]
    assert solution.iterations.tolist() == [1, 1, 1]
    assert len(sought) == 1
    progress = solver.begin(objective, guess)
    for _ in range(2):
        progress = solver.advance(objective, progress)
    assert not bool(progress.running.any())
    assert torch.equal(progress.q, solution.q)
    assert torch.equal(progress.error, solution.residual_norm)
    assert torch.equal(progress.status, solution.status)


# Squares --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Rosenbrock", "cubic", "not a gradient", "beside"])
def test_derivatives_of_the_square(name: str) -> None:
    """Gradient and Hessian of ½‖r/scale‖² are its central differences; at a root the Hessian is JᵀJ."""
    case = problem(name)
    n = len(case.guess)
    scale = 0.5 + random(n, seed=1).abs()
    objective = Squared(FunctionObjective(case.function, scale, case.stiffness, case.energy))
    q = case.start(torch.float64)
    evaluation = objective.evaluate(q)
    by_value = derivative(lambda delta: objective.evaluate(q + delta).value, n, (), 1e-2)
    by_gradient = derivative(lambda delta: objective.evaluate(q + delta).residual, n, (), 1e-2)
    torch.testing.assert_close(evaluation.residual, by_value, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(evaluation.jacobian, by_gradient, rtol=1e-8, atol=1e-8)
    root = objective.evaluate(torch.tensor(case.root, dtype=torch.float64))
    torch.testing.assert_close(root.jacobian, root.stiffness, rtol=1e-10, atol=1e-10)
    j = root.roots.jacobian / scale[:, None]
    torch.testing.assert_close(root.stiffness, j.mT @ j)


def test_derivatives_of_the_square_on_a_contact_step() -> None:
    """The same on a chain that lands with friction, on its manifold, in contact and a little off the root."""
    step = step_of("two links landing", torch.float64)
    objective, articulation = Squared(step.objective), step.objective.articulation
    q = step.objective.retract(step.root, 1e-6 * random(*step.objective.scale.shape, seed=1))
    evaluation = objective.evaluate(q)

    def value(delta: Tensor) -> Tensor:
        return objective.evaluate(objective.retract(q, delta)).value

    by_value = derivative(value, articulation.nv, (1,), 1e-6)
    assert float((evaluation.residual - by_value).abs().max()) <= 1e-6 * float(by_value.abs().max())
    by_gradient = jacobian(articulation, lambda x: objective.evaluate(x).residual, q, 1e-6)
    assert relative_error(evaluation.jacobian, by_gradient) <= 1e-6
    assert relative_error(evaluation.jacobian, evaluation.jacobian.mT) <= 1e-12
    root = objective.evaluate(step.root)
    assert relative_error(root.jacobian, root.stiffness) <= 1e-9


def test_hessian_of_the_square_where_nothing_slips() -> None:
    """At the start of a step no point has slipped: r is differentiable twice there, and the Hessian of ½‖r‖² finite."""
    step = step_of("two links landing", torch.float64)
    assert bool(torch.isfinite(Squared(step.objective).evaluate(step.retreat).jacobian).all())
    assert bool(torch.isfinite(Squared(step.objective).evaluate(step.guess).jacobian).all())


# Searches -------------------------------------------------------------------------------------------------------------


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
