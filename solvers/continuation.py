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
    inner: solves the problem itself, and every stage.
    last: solves the problem after the stages.
    ladders: detours, tried in turn; each is the stiffness of its stages as shares of the full one, rising.
    stage_tolerance: ‖r/scale‖₂ at which a stage is left.
    """

    inner: JtjLm = field(default_factory=lambda: JtjLm(max_evaluations=100))
    last: JtjLm = field(default_factory=lambda: JtjLm(max_evaluations=400))
    ladders: tuple[tuple[float, ...], ...] = ((1e-3, 1e-2, 1e-1), (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1))
    stage_tolerance: float = 1e-2

    def solve(self, objective: Objective, guess: Tensor, retreat: Tensor | None = None) -> Solution:
        """As `JtjLm.solve`; worlds that needed a detour end with `Status.CONTINUED`. Counts include the detours."""
        solution = self.inner.solve(objective, guess, retreat)
        start = guess if retreat is None else retreat
        for ladder in self.ladders:
            # a world with a non-finite start cannot be helped
            unsolved = ~solution.solved & (solution.status != int(Status.NON_FINITE))
            if not bool(unsolved.any()):
                break
            solution = _merged(solution, self._detour(objective, start, ladder), unsolved)
        return solution

    def _detour(self, objective: Objective, start: Tensor, ladder: tuple[float, ...]) -> Solution:
        stage = dataclasses.replace(self.inner, tolerance=self.stage_tolerance)
        climbs = []
        for factor in ladder:
            climbs.append(stage.solve(objective.softened(factor), start))
            start = climbs[-1].q
        climbs.append(self.last.solve(objective, start))
        return dataclasses.replace(
            climbs[-1],
            iterations=torch.stack([x.iterations for x in climbs]).sum(0, dtype=torch.int32),
            evaluations=torch.stack([x.evaluations for x in climbs]).sum(0, dtype=torch.int32),
        )


def _merged(before: Solution, detour: Solution, unsolved: Tensor) -> Solution:
    """For the worlds in `unsolved` the better of the two, and what both cost; for the others what was there before."""
    status = torch.where(detour.status == int(Status.SOLVED), int(Status.CONTINUED), detour.status)
    better = unsolved & (detour.solved | (detour.residual_norm < before.residual_norm))
    return Solution(
        q=torch.where(better[..., None], detour.q, before.q),
        status=torch.where(better, status, before.status),
        residual_norm=torch.where(better, detour.residual_norm, before.residual_norm),
        iterations=before.iterations + torch.where(unsolved, detour.iterations, 0),
        evaluations=before.evaluations + torch.where(unsolved, detour.evaluations, 0),
    )
