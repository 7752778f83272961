"""Continuation in stiffness: a step that does not solve is solved soft first, then stiffer and stiffer.

Stiff contacts bend the path to the solution so much that a straight search step can only be short. Made softer, they let it
pass; each solution is then close to the next, stiffer one. Only worlds that are unsolved take the detour's result.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pbfd_torch.solvers.jtj_lm import JtjLm
from pbfd_torch.solvers.objective import Objective, Solution, Status


@dataclass(frozen=True)
class Continuation:
    """Attributes:
    inner: solves the problem itself, and every stage; last: solves the problem after the stages.
    factors: stiffness of the stages before the last, as shares of the full one, rising.
    stage_tolerance: ‖r/scale‖₂ at which a stage is left.
    """

    inner: JtjLm = field(default_factory=lambda: JtjLm(max_evaluations=100))
    last: JtjLm = field(default_factory=lambda: JtjLm(max_evaluations=400))
    factors: tuple[float, ...] = (1e-3, 1e-2, 1e-1)
    stage_tolerance: float = 1e-2

    def solve(self, objective: Objective, guess: Tensor, retreat: Tensor | None = None) -> Solution:
        """As `JtjLm.solve`; worlds that needed the continuation end with `Status.CONTINUED`. Counts include the detour."""
        first = self.inner.solve(objective, guess, retreat)
        # worlds with a non-finite start cannot be helped
        unsolved = ~first.solved & (first.status != int(Status.NON_FINITE))
        if not bool(unsolved.any()):
            return first
        stage = dataclasses.replace(self.inner, tolerance=self.stage_tolerance)
        q = guess if retreat is None else retreat
        iterations, evaluations = first.iterations, first.evaluations
        for factor in self.factors:
            solution = stage.solve(objective.softened(factor), q)
            q = solution.q
            iterations, evaluations = iterations + solution.iterations, evaluations + solution.evaluations
        solution = self.last.solve(objective, q)
        status = torch.where(solution.status == int(Status.SOLVED), int(Status.CONTINUED), solution.status)
        better = unsolved & (solution.solved | (solution.residual_norm < first.residual_norm))
        return Solution(
            q=torch.where(better[..., None], solution.q, first.q),
            status=torch.where(better, status, first.status),
            residual_norm=torch.where(better, solution.residual_norm, first.residual_norm),
            iterations=torch.where(unsolved, iterations + solution.iterations, first.iterations),
            evaluations=torch.where(unsolved, evaluations + solution.evaluations, first.evaluations),
        )
