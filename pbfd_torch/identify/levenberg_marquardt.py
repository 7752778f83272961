"""Nonlinear least squares within bounds by Levenberg–Marquardt, many problems or many starts at once. Knows only vectors.

Every problem of a batch has its own damping, which follows the ratio of the decrease of ½‖r‖² to the one foreseen (Nielsen 1999).
Components at a bound that the gradient pushes against are held there; the others step, and are projected onto the bounds.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.errors import InputError

Linearized = Callable[[Tensor], tuple[Tensor, Tensor]]
"""x `[*batch, n]` → residual `[*batch, m]` and its exact Jacobian `[*batch, m, n]`. Row k must depend on row k of x only."""

FIRST_DAMPING = 1e-4  # of the diagonal of JᵀJ
LEAST_DAMPING = 1e-10
MOST_DAMPING = 1e12
FLOOR = 1e-6  # of the largest entry of that diagonal: what the data hardly see moves little


class Outcome(enum.IntEnum):
    """How a fit ended."""

    CONVERGED = 0  # the step or the decrease, made or foreseen, is below the tolerance
    EXHAUSTED = 1  # out of iterations
    STALLED = 2  # no step, however short, lowers the cost: the Jacobian is wrong, or the residual is not smooth there
    BROKEN = 3  # the residual or its Jacobian is not finite at the start


@dataclass(frozen=True)
class Stopping:
    """`iterations`: at most so many evaluations after the first. `step`: of the scale, `decrease`: of the cost; a fit that does
    less has converged."""

    iterations: int = 50
    step: float = 1e-6
    decrease: float = 1e-8

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise InputError(f"iterations is {self.iterations}: must be ≥ 1")
        for name in ("step", "decrease"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}: must be ≥ 0 and < 1")


@dataclass(frozen=True, eq=False)
class Bounds:
    """What x may be, and how far it is worth looking.

    Attributes:
        lower, upper: `[n]`, ∓inf where there is none.
        scale: `[n]` > 0, the size of a change of x that matters: what the data hardly see is damped as changes in units of it.
    """

    lower: Tensor
    upper: Tensor
    scale: Tensor

    def __post_init__(self) -> None:
        if not self.lower.shape == self.upper.shape == self.scale.shape or self.scale.ndim != 1:
            shapes = ", ".join(str(tuple(x.shape)) for x in (self.lower, self.upper, self.scale))
            raise InputError(f"lower, upper and scale have shapes {shapes}: must all be [n]")
        if not bool((self.lower < self.upper).all()):
            raise InputError(f"lower bounds {self.lower.tolist()} must be below upper bounds {self.upper.tolist()}")
        if not bool(((self.scale > 0) & torch.isfinite(self.scale)).all()):
            raise InputError(f"scale is {self.scale.tolist()}: must be > 0 and finite")

    def held(self, x: Tensor, gradient: Tensor) -> Tensor:
        """Which components `[*batch, n]` stand at a bound that a descent would leave."""
        return ((x <= self.lower) & (gradient >= 0)) | ((x >= self.upper) & (gradient <= 0))


@dataclass(frozen=True, eq=False)
class Fit:
    """Where fits ended.

    Attributes:
        x: `[*batch, n]`.
        residual: `[*batch, m]`; jacobian: `[*batch, m, n]` there.
        held: `[*batch, n]` bool, components that a bound holds.
        outcome: `[*batch]` values of `Outcome`.
        history: `[k, *batch]` the cost ½‖r‖² at the start and after every iteration.
    """

    x: Tensor
    residual: Tensor
    jacobian: Tensor
    held: Tensor
    outcome: Tensor
    history: Tensor

    @property
    def cost(self) -> Tensor:
        """½‖r‖² `[*batch]`."""
        return self.history[-1]

    @property
    def converged(self) -> Tensor:
        """`[*batch]` bool."""
        return self.outcome == int(Outcome.CONVERGED)


def levenberg_marquardt(
    function: Linearized,
    start: Tensor,
    bounds: Bounds,
    stopping: Stopping | None = None,
    progress: Callable[[int, float], object] | None = None,
) -> Fit:
    """Minimises ½‖r(x)‖² from `start` `[*batch, n]`, each row by itself. progress: called after every iteration with its number and
    the lowest cost of the batch. Raises `InputError` for a start of another length than the bounds'."""
    stopping = stopping or Stopping()
    if start.shape[-1:] != bounds.scale.shape:
        raise InputError(f"start has shape {tuple(start.shape)}: must end in {tuple(bounds.scale.shape)}")
    scale = bounds.scale
    x = start.detach().clamp(bounds.lower, bounds.upper)
    r, J = function(x)
    cost = _cost(r, J)
    outcome = torch.where(torch.isfinite(cost), int(Outcome.EXHAUSTED), int(Outcome.BROKEN)).to(torch.int32)
    running = torch.isfinite(cost)
    damping, growth = torch.full_like(cost, FIRST_DAMPING), torch.full_like(cost, 2.0)
    history = [cost]
    for k in range(stopping.iterations):
        gradient = scale * (r[..., None, :] @ J).squeeze(-2)
        hessian = _hessian(J, scale)
        move = _step(hessian, gradient, bounds.held(x, gradient), damping)
        trial = torch.where(running[..., None], (x + scale * move).clamp(bounds.lower, bounds.upper), x)
        taken = (trial - x) / scale
        foreseen = -(taken * gradient).sum(-1) - 0.5 * (taken * (hessian @ taken[..., None]).squeeze(-1)).sum(-1)
        r_trial, J_trial = function(trial)
        cost_trial = _cost(r_trial, J_trial)
        gained = cost - cost_trial
        better = running & (gained > 0) & torch.isfinite(cost_trial)
        # what is foreseen to gain next to nothing has arrived, even where rounding hides the gain
        small = foreseen <= stopping.decrease * cost
        short = taken.abs().amax(-1) <= stopping.step
        done = running & (
            small | short | (better & (gained <= stopping.decrease * cost) & (foreseen <= 2 * stopping.decrease * cost))
        )
        ratio = gained / torch.where(foreseen > 0, foreseen, torch.ones_like(foreseen))
        eased = damping * (1 - (2 * ratio - 1).clamp(-1, 1) ** 3).clamp_min(1 / 3)
        damping = torch.where(better, eased, damping * growth).clamp_min(LEAST_DAMPING)
        growth = torch.where(better, 2.0, 2 * growth)
        x = torch.where(better[..., None], trial, x)
        r = torch.where(better[..., None], r_trial, r)
        J = torch.where(better[..., None, None], J_trial, J)
        cost = torch.where(better, cost_trial, cost)
        stalled = running & ~done & ~better & (damping > MOST_DAMPING)
        outcome = torch.where(done, int(Outcome.CONVERGED), torch.where(stalled, int(Outcome.STALLED), outcome))
        running = running & ~done & ~stalled
        history.append(cost)
        if progress is not None:
            progress(k + 1, float(cost.nan_to_num(torch.inf).min()))
        if not bool(running.any()):
            break
    held = bounds.held(x, (r[..., None, :] @ J).squeeze(-2))
    return Fit(x, r, J, held, outcome, torch.stack(history))


def _cost(residual: Tensor, jacobian: Tensor) -> Tensor:
    """½‖r‖² `[*batch]`, NaN where the residual or its Jacobian is not finite."""
    cost = 0.5 * residual.square().sum(-1)
    return torch.where(torch.isfinite(jacobian).all(-1).all(-1), cost, torch.nan)


def _hessian(jacobian: Tensor, scale: Tensor) -> Tensor:
    """JᵀJ `[*batch, n, n]` in units of the scale; zero where J is not finite."""
    scaled = (scale * jacobian).nan_to_num(0.0, 0.0, 0.0)
    return scaled.mT @ scaled


def _step(hessian: Tensor, gradient: Tensor, held: Tensor, damping: Tensor) -> Tensor:
    """−(H + λD)⁻¹ g `[*batch, n]` of the components that are not held, D the diagonal of H with a floor."""
    free = (~held).to(gradient.dtype)
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    least = (FLOOR * diagonal.amax(-1, keepdim=True)).clamp_min(torch.finfo(gradient.dtype).tiny)
    matrix = free[..., :, None] * hessian * free[..., None, :] + torch.diag_embed(damping[..., None] * (diagonal + least))
    found, _ = torch.linalg.solve_ex(matrix, -(free * gradient).nan_to_num(0.0, 0.0, 0.0)[..., None])
    return free * found.squeeze(-1).nan_to_num(0.0, 0.0, 0.0)
