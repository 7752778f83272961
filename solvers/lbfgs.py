"""L-BFGS: Newton's step from the last few changes of the gradient alone, by the two-loop recursion."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.solvers.directions import Minimising, Model
from pbfd_torch.solvers.objective import Evaluation, Objective
from pbfd_torch.solvers.per_world import chosen


@dataclass(frozen=True)
class Lbfgs(Minimising):
    """Attributes:
    memory: pairs (step, change of the gradient) that are kept, the newest first.
    first_step: largest entry of the first step [m, rad], before any curvature is known.

    Pairs live in the tangent spaces where they were taken; on rotations they are used in the present one as they are."""

    memory: int = 8
    first_step: float = 1e-2

    def model(self, objective: Objective, evaluation: Evaluation, previous: Model | None, step: Tensor, restart: Tensor) -> Model:
        """(r, steps, changes, inverse products), the latter zero where there is no pair."""
        r = evaluation.residual
        if previous is None:
            pairs = r.new_zeros((*r.shape[:-1], self.memory, r.shape[-1]))
            return r, pairs, pairs, r.new_zeros((*r.shape[:-1], self.memory))
        before, steps, changes, inverse = previous
        change = r - before
        product = (step * change).sum(-1)
        # y·s must be clearly positive for the next matrix to be positive definite
        sizes = torch.linalg.vector_norm(step, dim=-1) * torch.linalg.vector_norm(change, dim=-1)
        usable = (product > 1e-10 * sizes) & ~restart
        newest = torch.where(usable, 1 / torch.where(usable, product, torch.ones_like(product)), torch.zeros_like(product))
        kept = torch.where(restart[..., None], torch.zeros_like(inverse), inverse)
        pushed = (
            torch.cat((step[..., None, :], steps[..., :-1, :]), -2),
            torch.cat((change[..., None, :], changes[..., :-1, :]), -2),
            torch.cat((newest[..., None], kept[..., :-1]), -1),
        )
        return r, *chosen(usable, pushed, (steps, changes, kept))

    def step(self, model: Model, damping: Tensor) -> Tensor:
        """−(H⁻¹)r; without pairs, downhill by `first_step`."""
        r, steps, changes, inverse = model
        direction = r
        shares = []
        for k in range(self.memory):
            share = inverse[..., k] * (steps[..., k, :] * direction).sum(-1)
            direction = direction - share[..., None] * changes[..., k, :]
            shares.append(share)
        newest = inverse[..., 0]
        known = newest > 0
        squares = newest * changes[..., 0, :].square().sum(-1)  # y·y / y·s
        largest = r.abs().amax(-1)
        first = self.first_step / torch.where(largest > 0, largest, torch.ones_like(largest))
        gamma = torch.where(known, 1 / torch.where(known, squares, torch.ones_like(squares)), first)
        direction = gamma[..., None] * direction
        for k in reversed(range(self.memory)):
            share = inverse[..., k] * (changes[..., k, :] * direction).sum(-1)
            direction = direction + (shares[k] - share)[..., None] * steps[..., k, :]
        return -direction

    def decrease(self, model: Model, step: Tensor) -> Tensor:
        """Half the slope: what the quadratic model says of its own full step."""
        return -0.5 * self.slope(model, step)
