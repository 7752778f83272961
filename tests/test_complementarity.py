"""The complementarity solver of the conventional formulation: Signorini's and Coulomb's laws, closed forms, limits."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pbfd_torch.conventional.complementarity import (
    FrictionProblem,
    natural_residual,
    projected,
    projection_slope,
    solve,
)
from pbfd_torch.solvers.objective import Status
from pbfd_torch.tree.rotations import skew
from tests.finite_differences import derivative
from tests.random_numbers import normal as numbers
from tests.random_trees import generator


def random_rows(worlds: int, count: int, dofs: int) -> Tensor:
    return numbers(worlds, count, 3, dofs, seed=count)


def body_rows(worlds: int, count: int, dofs: int) -> Tensor:
    """`count` points under one rigid body: GGᵀ has rank 6 of 3 `count`."""
    points = numbers(worlds, count, 3, seed=count) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    points[..., 2] = -1.0
    rows = torch.cat((torch.eye(3, dtype=torch.float64).expand(worlds, count, 3, 3), -skew(points)), -1)
    return rows[..., [2, 0, 1], :]


def repeated_rows(worlds: int, count: int, dofs: int) -> Tensor:
    """Every constraint twice."""
    return random_rows(worlds, count // 2, dofs).repeat(1, 2, 1, 1)


@pytest.mark.parametrize("mu", [0.0, 0.3, 1.0, 2.0])
@pytest.mark.parametrize(
    ("rows", "count", "dofs"),
    [
        (random_rows, 1, 6),
        (random_rows, 8, 6),
        (random_rows, 20, 15),
        (body_rows, 8, 6),
        (body_rows, 64, 6),
        (repeated_rows, 12, 8),
    ],
)
def test_random_problems_are_solved(rows: Callable[[int, int, int], Tensor], count: int, dofs: int, mu: float) -> None:
    """Signorini's and Coulomb's laws hold constraint by constraint, and λ is De Saxcé's: λ = P_K(λ − (u + μ‖u_t‖n)/w), P_K the
    Euclidean projection on the cone."""
    worlds = 16
    matrix = rows(worlds, count, dofs)
    velocity = (matrix * numbers(worlds, 1, 1, dofs, seed=7)).sum(-1)
    share = mu * torch.rand(worlds, count, dtype=torch.float64, generator=generator(8))
    problem = FrictionProblem(matrix, velocity, share, torch.zeros_like(share), velocity.new_ones(worlds))
    found = solve(problem, torch.zeros_like(velocity), 1e-8, 200)
    assert (found.status == int(Status.SOLVED)).all()
    assert found.residual_norm.max() <= 1e-8
    torch.testing.assert_close(natural_residual(problem, found.impulse), found.residual_norm)

    impulse, u = found.impulse, problem.relative(found.impulse)
    weight = (matrix * matrix).sum(-1).amax(-1)
    push, drag = impulse[..., 0], impulse[..., 1:]
    slip = torch.linalg.vector_norm(u[..., 1:], dim=-1)
    size = 1 + torch.linalg.vector_norm(problem.kick(impulse), dim=-1)
    assert push.min() >= 0
    bound = 1e-7 * size[:, None] * weight.sqrt()
    assert (u[..., 0] >= -bound).all()
    assert (torch.minimum(push * weight, u[..., 0]) <= bound).all()
    assert (torch.linalg.vector_norm(drag, dim=-1) <= share * push * (1 + 1e-12)).all()
    opposed = share[..., None] * push[..., None] * u[..., 1:] + slip[..., None] * drag
    assert (torch.linalg.vector_norm(opposed, dim=-1) <= bound * (share * push + slip / weight + 1e-12)).all()
    dilated = torch.cat(((u[..., 0] + share * slip)[..., None], u[..., 1:]), -1)
    error = weight.sqrt()[..., None] * (impulse - onto_cone(impulse - dilated / weight[..., None], share))
    assert (torch.linalg.vector_norm(error.flatten(1), dim=-1) / size).max() <= 2e-8 * (1 + mu)


def onto_cone(z: Tensor, mu: Tensor) -> Tensor:
    """Euclidean projection on ‖z_t‖ ≤ μ z_n."""
    size = torch.linalg.vector_norm(z[..., 1:], dim=-1)
    along = ((z[..., 0] + mu * size) / (1 + mu * mu)).clamp_min(0)
    inside = size <= mu * z[..., 0]
    cut = torch.cat((along[..., None], (mu * along / size.clamp_min(1e-300))[..., None] * z[..., 1:]), -1)
    return torch.where(inside[..., None], z, cut)


def test_single_sliding_contact_in_closed_form() -> None:
    """One point on a unit mass with velocity (−1 down, slip s): λ_n = 1, and the slip loses μ, or stops."""
    rows = torch.eye(3, dtype=torch.float64).expand(3, 1, 3, 3)
    velocity = torch.tensor([[-1.0, 3.0, 4.0], [-1.0, 0.1, 0.0], [1.0, 3.0, 4.0]], dtype=torch.float64)[:, None]
    mu = torch.full((3, 1), 0.5, dtype=torch.float64)
    found = solve(FrictionProblem(rows, velocity, mu, 0 * mu, torch.ones(3, dtype=torch.float64)), 0 * velocity, 1e-10, 50)
    exact = torch.tensor([[1.0, -0.3, -0.4], [1.0, -0.1, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(found.impulse[:, 0], exact, rtol=0, atol=1e-9)


def test_projection_slope() -> None:
    z = numbers(40, 3)
    mu, hold = numbers(40, seed=1).abs(), 0.3 * numbers(40, seed=2).abs()
    slope = derivative(lambda delta: projected(z + delta, mu, hold), 3, (40,), largest=1e-4)
    torch.testing.assert_close(projection_slope(z, mu, hold), slope, rtol=0, atol=1e-7)
    assert torch.isfinite(projection_slope(torch.zeros(1, 3), torch.ones(1), torch.zeros(1))).all()


def test_solution_is_kept_and_limit_reported() -> None:
    matrix = random_rows(4, 8, 6)
    velocity = (matrix * numbers(4, 1, 1, 6, seed=7)).sum(-1)
    mu = torch.full((4, 8), 0.5, dtype=torch.float64)
    problem = FrictionProblem(matrix, velocity, mu, 0 * mu, velocity.new_ones(4))
    first = solve(problem, torch.zeros_like(velocity), 1e-8, 200)
    again = solve(problem, first.impulse, 1e-8, 200)
    assert (again.iterations == 0).all()
    torch.testing.assert_close(again.impulse, first.impulse, rtol=0, atol=1e-15)
    assert (solve(problem, torch.zeros_like(velocity), 1e-8, 1).status == int(Status.ITERATION_LIMIT)).all()
