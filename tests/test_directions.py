"""Directions of solvers against closed forms."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch
from torch import Tensor

from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.directions import Direction, GaussNewtonLm, JtjLm, Lm, Model, Newton, ProjectedNewton, projected
from pbfd_torch.solvers.lbfgs import Lbfgs
from tests.random_numbers import normal as random
from tests.solver_points import Point, plain
from tests.solver_problems import Ease, FunctionObjective, problem


def positive(*shape: int, seed: int = 0) -> Tensor:
    """Random positive definite matrices."""
    a = random(*shape, shape[-1], seed=seed)
    return a @ a.mT + 0.5 * torch.eye(shape[-1], dtype=torch.float64)


def stepped(direction: Direction, point: Point, damping: float = 0.0, scale: Tensor | None = None) -> Tensor:
    """The direction's step from a point without a past."""
    r = point.residual
    start = torch.ones(r.shape[:-1], dtype=torch.bool)
    model = direction.model(plain(r.shape[-1], scale), point, None, torch.zeros_like(r), start)
    return direction.step(model, torch.full(r.shape[:-1], damping, dtype=r.dtype))


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    return torch.linalg.solve(matrix, right[..., None]).squeeze(-1)


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
