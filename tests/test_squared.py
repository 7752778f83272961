"""The square of a residual as an objective: its derivatives on small problems and on steps with contact."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pbfd_torch.solvers.squared import Squared
from tests.finite_differences import derivative, jacobian, relative_error
from tests.random_numbers import normal as random
from tests.solver_problems import FunctionObjective, problem
from tests.test_solver_steps import step_of


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
