"""Descent directions. A direction keeps a model of the problem around the point it starts from, and gives a step from it.

Roots and minima differ in their merit only. A root direction lowers ½‖r/scale‖² (Eq. 13) and may use that r is a vector of forces;
a minimising one lowers the value whose gradient r is (Eq. 6). Damping λ pulls towards short steps; line searches leave it at 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pbfd_torch.solvers.linear import least_squares, solved, solved_with_sign
from pbfd_torch.solvers.objective import Evaluation, Objective, Valued

Model = tuple[Tensor, ...]  # every entry [*batch, ...]; the residual first


class Direction(Protocol):
    """How to step from a point."""

    def model(self, objective: Objective, evaluation: Evaluation, previous: Model | None, step: Tensor, restart: Tensor) -> Model:
        """What is to be remembered of a new point. previous, step: the model it was reached from, and by which step; worlds in
        `restart` `[*batch]` have no past."""
        ...

    def step(self, model: Model, damping: Tensor) -> Tensor:
        """The step `[*batch, n]` under the damping λ ≥ 0 `[*batch]`."""
        ...

    def merit(self, objective: Objective, evaluation: Evaluation) -> Tensor:
        """What the step is to lower, `[*batch]`."""
        ...

    def slope(self, model: Model, step: Tensor) -> Tensor:
        """Derivative of the merit along the step, `[*batch]`."""
        ...

    def decrease(self, model: Model, step: Tensor) -> Tensor:
        """How much the model says that the step lowers the merit, `[*batch]`."""
        ...


class _Root:
    """Merit ½‖r/scale‖²; models start with (r, J, K, scale)."""

    def model(self, objective: Objective, evaluation: Evaluation, previous: Model | None, step: Tensor, restart: Tensor) -> Model:
        r = evaluation.residual
        return r, evaluation.jacobian, evaluation.stiffness, objective.scale.expand_as(r)

    def merit(self, objective: Objective, evaluation: Evaluation) -> Tensor:
        return 0.5 * (evaluation.residual / objective.scale).square().sum(-1)

    def slope(self, model: Model, step: Tensor) -> Tensor:
        r, jacobian, _, scale = model[:4]
        return (r * times(jacobian, step) / scale.square()).sum(-1)

    def decrease(self, model: Model, step: Tensor) -> Tensor:
        r, jacobian, _, scale = model[:4]
        after = (r + times(jacobian, step)) / scale
        return 0.5 * ((r / scale).square() - after.square()).sum(-1)


class Minimising:
    """Merit: the value; models start with (r, H)."""

    def merit(self, objective: Objective, evaluation: Evaluation) -> Tensor:
        if not isinstance(evaluation, Valued):
            raise TypeError(
                "this direction minimises a value, and the objective has none: use a root direction, an energy, or "
                "Squared(objective)"
            )
        return evaluation.value

    def slope(self, model: Model, step: Tensor) -> Tensor:
        return (model[0] * step).sum(-1)

    def decrease(self, model: Model, step: Tensor) -> Tensor:
        return -(model[0] * step).sum(-1) - 0.5 * (step * times(model[1], step)).sum(-1)


@dataclass(frozen=True)
class Newton(_Root):
    """Newton's step −J⁻¹r where det J > 0 and the step descends (r·d < 0), else the stiffness' step −K⁻¹r.

    The balance that inertia alone would find has det J > 0, and so has every one that follows from it as the step grows, until
    J turns singular. Roots with det J < 0 are saddles, and Newton's steps lead there as readily as to minima, downhill or not: a
    chain that is pushed together, or that turns by a radian a step, has many. The determinant holds where friction makes the
    symmetric part of J indefinite at the very solution.

    Newton's step is that of JTJ-LM, (JᵀJ + λ1)⁻¹Jᵀr (Eq. 14), for λ → 0, taken from an LU factorisation of J itself: forming JᵀJ
    would square its condition number, and half the digits would be lost. It knows no damping."""

    def step(self, model: Model, damping: Tensor) -> Tensor:
        """See `Direction`."""
        r, jacobian, stiffness, _ = model
        steps, signs = solved_with_sign(torch.stack((jacobian, stiffness)), torch.stack((-r, -r))[..., None])
        newton, convex = steps.squeeze(-1).unbind(0)
        first = torch.where((signs[0] > 0)[..., None], newton, convex)
        return _first_descending(r, first, convex, newton, _scaled(r, stiffness))


@dataclass(frozen=True)
class ProjectedNewton(_Root):
    """Newton's step where it descends, else that of J with the negative eigenvalues of its symmetric part turned positive: to
    compare `Newton` with. The only direction that makes the host wait for a device: PyTorch checks there whether the eigenvalues
    were found."""

    def step(self, model: Model, damping: Tensor) -> Tensor:
        r, jacobian, stiffness, _ = model
        steps = solved(torch.stack((jacobian, projected(jacobian))), torch.stack((-r, -r))[..., None])
        newton, positive = steps.squeeze(-1).unbind(0)
        return _first_descending(r, newton, positive, _scaled(r, stiffness))


@dataclass(frozen=True)
class JtjLm(_Root):
    """The step of Eq. 14 with Marquardt's damping, min ‖(r + Jd)/scale‖² + λ‖Dd‖², D the column norms of J/scale.

    From a QR factorisation of [J/scale; √λ D]: the normal equations' matrix JᵀJ + λD² = RᵀR is never formed."""

    def step(self, model: Model, damping: Tensor) -> Tensor:
        r, jacobian, _, scale = model
        scaled = jacobian / scale[..., None]
        columns = torch.linalg.vector_norm(scaled, dim=-2)
        columns = torch.where(columns > 0, columns, torch.ones_like(columns))
        stacked = torch.cat((scaled, torch.diag_embed(torch.sqrt(damping)[..., None] * columns)), -2)
        right = torch.nn.functional.pad(-r / scale, (0, r.shape[-1]))
        return least_squares(stacked.nan_to_num(), right[..., None]).squeeze(-1)


@dataclass(frozen=True)
class Lm(Minimising):
    """Levenberg–Marquardt on a value: −(H + λD)⁻¹r with the exact Hessian H, D the diagonal of its approximation K. It is the
    stiffness' step where H + λD is indefinite and leads uphill."""

    def model(self, objective: Objective, evaluation: Evaluation, previous: Model | None, step: Tensor, restart: Tensor) -> Model:
        return evaluation.residual, evaluation.jacobian, evaluation.stiffness

    def step(self, model: Model, damping: Tensor) -> Tensor:
        r, hessian, stiffness = model
        added = torch.diag_embed(damping[..., None] * _positive_diagonal(stiffness))
        steps = solved(torch.stack((hessian + added, stiffness + added)), torch.stack((-r, -r))[..., None])
        exact, convex = steps.squeeze(-1).unbind(0)
        return _first_descending(r, exact, convex, _scaled(r, stiffness + added))


@dataclass(frozen=True)
class GaussNewtonLm(Minimising):
    """JTJ-LM on a value that is a sum of squares: −(K + λD)⁻¹r with K = Σ (∂p/∂θ)ᵀW(∂p/∂θ), the part of the Hessian without the
    curvature of p(θ) (assembled link by link, never as a product of tall matrices)."""

    def model(self, objective: Objective, evaluation: Evaluation, previous: Model | None, step: Tensor, restart: Tensor) -> Model:
        return evaluation.residual, evaluation.stiffness

    def step(self, model: Model, damping: Tensor) -> Tensor:
        r, stiffness = model
        damped = stiffness + torch.diag_embed(damping[..., None] * _positive_diagonal(stiffness))
        step = solved(damped, -r[..., None]).squeeze(-1)
        return _first_descending(r, step, _scaled(r, damped))


def times(matrix: Tensor, vector: Tensor) -> Tensor:
    """`[*, n, m], [*, m] → [*, n]`; not by a matrix product, which rounds differently for one world and for many."""
    return (matrix * vector[..., None, :]).sum(-1)


def projected(jacobian: Tensor) -> Tensor:
    """J with the negative eigenvalues of its symmetric part turned positive, and those near zero lifted off it."""
    symmetric = 0.5 * (jacobian + jacobian.mT)
    values, vectors = torch.linalg.eigh(symmetric.nan_to_num(posinf=0.0, neginf=0.0))
    floor = torch.finfo(values.dtype).eps ** 0.5 * values.abs().amax(-1, keepdim=True)
    lifted = torch.maximum(values.abs(), floor)
    return jacobian + (vectors * (lifted - values)[..., None, :]) @ vectors.mT


def _positive_diagonal(matrix: Tensor) -> Tensor:
    diagonal = matrix.diagonal(dim1=-2, dim2=-1).abs()
    return torch.where(diagonal > 0, diagonal, torch.ones_like(diagonal))


def _scaled(residual: Tensor, stiffness: Tensor) -> Tensor:
    return -residual / _positive_diagonal(stiffness)


def _first_descending(residual: Tensor, *steps: Tensor) -> Tensor:
    """Per world the first step that is finite and has r·d < 0; the last one where none is."""
    chosen = steps[-1]
    for step in reversed(steps[:-1]):
        work = (step * residual).sum(-1, keepdim=True)
        chosen = torch.where(torch.isfinite(step).all(-1, keepdim=True) & (work < 0), step, chosen)
    return chosen
