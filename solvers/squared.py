"""GE(θ) = ½‖r(θ)/scale‖² (Eq. 13) as a minimisation of its own, for the minimising directions."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pbfd_torch.solvers.objective import Evaluation, Objective


@dataclass(frozen=True, eq=False)
class Squared:
    """`roots`: the objective r whose ½‖r/scale‖² is minimised. The residual is then the gradient Jᵀr, the stiffness the
    Gauss–Newton matrix JᵀJ, the Jacobian the exact Hessian JᵀJ + Σ rₖ∇²rₖ. The latter holds third derivatives of the energy
    and comes from automatic differentiation, one backward pass per degree of freedom: this is the case that the paper excludes
    for its cost, Table I's O(n³). `error` stays that of r."""

    roots: Objective

    @property
    def scale(self) -> Tensor:
        """That of the roots' residual."""
        return self.roots.scale

    def evaluate(self, q: Tensor) -> SquaredEvaluation:
        """Value, gradient and, when asked for, second derivatives at q."""
        return SquaredEvaluation(self.roots, q, self.roots.evaluate(q))

    def error(self, evaluation: Evaluation, tolerance: float) -> Tensor:
        """‖r/…‖ of the roots' residual."""
        if not isinstance(evaluation, SquaredEvaluation):
            raise TypeError("the evaluation is not one of this objective")
        return self.roots.error(evaluation.roots, tolerance)

    def retract(self, q: Tensor, step: Tensor) -> Tensor:
        """As the roots do."""
        return self.roots.retract(q, step)

    def turn(self, step: Tensor) -> Tensor:
        """As the roots do."""
        return self.roots.turn(step)

    def take(self, index: Tensor) -> Squared:
        """The problems of some worlds."""
        return dataclasses.replace(self, roots=self.roots.take(index))


@dataclass(frozen=True, eq=False)
class SquaredEvaluation:
    """GE at q; `roots`: the evaluation of r there."""

    objective: Objective
    q: Tensor
    roots: Evaluation

    @cached_property
    def _scaled(self) -> tuple[Tensor, Tensor]:
        scale = self.objective.scale
        return self.roots.residual / scale, self.roots.jacobian / scale[..., None]

    @cached_property
    def value(self) -> Tensor:
        """½‖r/scale‖² `[*batch]`."""
        return 0.5 * self._scaled[0].square().sum(-1)

    @cached_property
    def residual(self) -> Tensor:
        """∂GE/∂θ = Jᵀr `[*batch, n]`, both over the scale."""
        r, jacobian = self._scaled
        return (jacobian.mT @ r[..., None]).squeeze(-1)

    @cached_property
    def stiffness(self) -> Tensor:
        """JᵀJ `[*batch, n, n]`, over the scale."""
        jacobian = self._scaled[1]
        return jacobian.mT @ jacobian

    @cached_property
    def jacobian(self) -> Tensor:
        """∂²GE/∂θ² `[*batch, n, n]`, by automatic differentiation of r twice."""
        objective = self.objective
        with torch.enable_grad():
            step = torch.zeros_like(self.roots.residual, requires_grad=True)
            r = objective.evaluate(objective.retract(self.q, step)).residual / objective.scale
            # a residual that does not depend on the step has no graph of its own
            (gradient,) = torch.autograd.grad(0.5 * r.square().sum() + 0 * step.square().sum(), step, create_graph=True)
            rows = []
            for k in range(step.shape[-1]):
                (row,) = torch.autograd.grad(gradient[..., k].sum(), step, retain_graph=True)
                rows.append(row)
        return torch.stack(rows, -2)
