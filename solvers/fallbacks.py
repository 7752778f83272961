"""Fallbacks: worlds that the direct way leaves unsolved are solved along easier problems first.

A detour leads to a better start: a warm start through the minimiser of the energy with lagged friction, then continuations in the
friction's width and in stiffness. Only the unsolved worlds take it. What halves a step, which needs the integrator, is the
simulator's.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.objective import Objective, Relaxable, Solution, Status


class Detour(Protocol):
    """A way to a better start."""

    @property
    def kind(self) -> int:
        """Its place in `objective.FALLBACKS`."""
        ...

    @property
    def status(self) -> Status:
        """Of a world that it helped."""
        ...

    @property
    def stages(self) -> int:
        """How many problems it solves."""
        ...

    def lead(self, solver: Descent, objective: Relaxable, start: Tensor) -> list[Solution]:
        """Solves easier problems in turn, from `start`; the last solution is the better start."""
        ...


def climbed(solver: Descent, tolerance: float, stages: Sequence[Callable[[Tensor], Objective]], start: Tensor) -> list[Solution]:
    """Solves each stage, a problem that may depend on where the one before it ended, to the tolerance from there."""
    rough = dataclasses.replace(solver, tolerance=tolerance)
    climbs: list[Solution] = []
    for stage in stages:
        climbs.append(rough.solve(stage(start), start))
        start = climbs[-1].q
    return climbs


@dataclass(frozen=True)
class WarmStart:
    """The minimiser of E with the friction lagged: held at the normal forces of the start, then at those of the minimiser found."""

    passes: int = 2
    tolerance: float = 1e-2
    kind: int = 0
    status: Status = Status.WARM_STARTED

    @property
    def stages(self) -> int:
        """See `Detour`."""
        return self.passes

    def lead(self, solver: Descent, objective: Relaxable, start: Tensor) -> list[Solution]:
        """See `Detour`."""
        return climbed(solver, self.tolerance, [objective.lagged] * self.passes, start)


@dataclass(frozen=True)
class Continuation:
    """Stages (width of friction as a multiple, stiffness as a share of the full one), from easy to hard: wide friction does not
    yet decide between sticking and slipping, and soft contacts let a step pass that stiff ones bend too much."""

    ladder: tuple[tuple[float, float], ...]
    tolerance: float = 1e-1
    kind: int = 1
    status: Status = Status.CONTINUED

    @property
    def stages(self) -> int:
        """See `Detour`."""
        return len(self.ladder)

    def lead(self, solver: Descent, objective: Relaxable, start: Tensor) -> list[Solution]:
        """See `Detour`."""

        def eased(width: float, stiffness: float, _: Tensor) -> Relaxable:
            stage = objective.widened(width) if width > 1 else objective
            return stage.softened(stiffness) if stiffness < 1 else stage

        return climbed(solver, self.tolerance, [functools.partial(eased, *rung) for rung in self.ladder], start)


@dataclass(frozen=True)
class Following:
    """Stages that are as of a step that grows from a share of its length to the whole: their roots follow the motion from its
    start."""

    shares: tuple[float, ...] = (2**-8, 2**-6, 2**-4, 2**-2)
    tolerance: float = 1e-2
    kind: int = 1
    status: Status = Status.CONTINUED

    @property
    def stages(self) -> int:
        """See `Detour`."""
        return len(self.shares)

    def lead(self, solver: Descent, objective: Relaxable, start: Tensor) -> list[Solution]:
        """See `Detour`."""

        def shorter(share: float, _: Tensor) -> Relaxable:
            return objective.shortened(share)

        return climbed(solver, self.tolerance, [functools.partial(shorter, x) for x in self.shares], start)


WIDTHS = Continuation(((1000.0, 1.0), (100.0, 1.0), (10.0, 1.0)))
STIFFNESSES = Continuation(((1.0, 1e-3), (1.0, 1e-2), (1.0, 1e-1)), tolerance=1e-2)
SOON, LONG = 40, 60  # evaluations


@dataclass(frozen=True)
class Fallbacks:
    """Attributes:
    direct: solves the problem itself.
    last: solves the problem from where a detour has led.
    along: tried by worlds whose root has strayed.
    detours: tried in turn.
    stage: solves every stage of a detour.
    """

    direct: Descent = field(default_factory=lambda: Descent(max_evaluations=200))
    last: Descent = field(default_factory=lambda: Descent(max_evaluations=100))
    along: Detour = Following()
    detours: tuple[Detour, ...] = (WarmStart(), WIDTHS, STIFFNESSES)
    stage: Descent = field(default_factory=lambda: Descent(max_evaluations=60))

    @classmethod
    def within(cls, tolerance: float | None) -> Fallbacks:
        """The default one to another tolerance, see `Descent`."""
        direct, last, stage = (Descent(tolerance=tolerance, max_evaluations=most) for most in (200, 100, 60))
        return cls(direct, last, stage=stage)

    @property
    def brisk(self) -> Descent:
        """For a step that has an easier one to fall back on: the direct way, given up soon. What it does not solve by then seldom
        has a solution, and no detour leads to one."""
        return dataclasses.replace(self.direct, max_evaluations=min(SOON, self.direct.max_evaluations))

    def solve(
        self, objective: Relaxable, guess: Tensor, retreat: Tensor | None = None, budget: int | Tensor | None = None
    ) -> Solution:
        """As `Descent.solve`; worlds that needed a detour say so in their status. Counts include the detours. budget: as in
        `rescued`, and enough for the direct way."""
        solution = doubted(objective, self.direct.solve(objective, guess, retreat))
        return self.accepted(self.rescued(objective, solution, guess, guess if retreat is None else retreat, budget))

    def rescued(
        self, objective: Relaxable, solution: Solution, guess: Tensor, start: Tensor, budget: int | Tensor | None = None
    ) -> Solution:
        """The solution of the direct way with its unsolved worlds led from `start` to where they are to be: those that have strayed
        along the motion, those without a root along the detours; what these leave tries the direct way from `guess` after all, as
        the retreat from it may have been the mistake. Both starts are `[*batch, nq]`. Roots that have strayed stay unsolved, but
        for those that the motion leads to. budget: evaluations that a world may spend in all, those of the solution included, a
        number or `[*batch]`; None: any. A way that might take more is not taken."""
        if len(solution.unsolved) == 0:
            return solution
        astray = objective.strayed(solution.q).reshape(-1)[solution.unsolved]
        solution = self._led(self.along, objective, solution, solution.unsolved[astray], start, budget)
        for detour in self.detours:
            solution = self._led(detour, objective, solution, self._rootless(solution), start, budget)
        index = solution.within(budget, self.last.max_evaluations, self._rootless(solution))
        if len(index) and guess is not start:
            part = objective.take(index)
            again = doubted(part, self.last.solve(part, guess.reshape(-1, guess.shape[-1])[index]))
            solution = merged(solution, index, [again], None, Status.SOLVED)
        return solution

    def accepted(self, solution: Solution) -> Solution:
        """The solution with roots that have strayed as good enough."""
        return solution.marked(~solution.solved & self._balanced(solution), Status.SOLVED)

    def _balanced(self, solution: Solution) -> Tensor:
        """Which worlds are at a root, wherever that is, `[*batch]` bool."""
        return solution.residual_norm <= self.last.tolerance_for(solution.q.dtype)

    def _rootless(self, solution: Solution) -> Tensor:
        """Positions `[n]` in the flattened batch of the unsolved worlds that are at no root."""
        return solution.unsolved[~self._balanced(solution).reshape(-1)[solution.unsolved]]

    def _led(
        self,
        detour: Detour,
        objective: Relaxable,
        solution: Solution,
        index: Tensor,
        start: Tensor,
        budget: int | Tensor | None,
    ) -> Solution:
        """The solution with those of the worlds at `index` led along a detour that can afford it."""
        index = solution.within(budget, detour.stages * self.stage.max_evaluations + self.last.max_evaluations, index)
        if len(index) == 0:
            return solution
        part = objective.take(index)
        climbs = detour.lead(self.stage, part, start.reshape(-1, start.shape[-1])[index])
        if detour is self.along:
            climbs.append(self.stage.solve(part, climbs[-1].q))
        else:
            climbs.append(doubted(part, self.last.solve(part, climbs[-1].q)))
        return merged(solution, index, climbs, detour.kind, detour.status)


def doubted(objective: Relaxable, solution: Solution) -> Solution:
    """The solution with worlds unsolved whose roots have strayed, and were found after a long search only: what a few of Newton's
    steps lead to is where the motion goes."""
    long = solution.solved & (solution.evaluations > LONG)
    # what is in the host's own memory it may look at; asking a device would make it wait
    if long.device.type == "cpu" and not bool(long.numpy().any()):
        return solution
    return solution.marked(long & objective.strayed(solution.q), Status.STALLED)


def merged(before: Solution, index: Tensor, climbs: list[Solution], kind: int | None, status: Status) -> Solution:
    """The solution with the worlds at `index` (of the flattened batch) replaced by the last of `climbs` where that is better, and
    charged with what all of them cost and with one fallback of this kind (None: of no kind)."""
    batch = before.status.shape

    def flat(x: Tensor) -> Tensor:
        return x.reshape(-1, *x.shape[len(batch) :])

    end = climbs[-1]
    solved, error = end.solved.reshape(-1), end.residual_norm.reshape(-1)
    better = solved | (error < flat(before.residual_norm)[index])
    ended = torch.where(solved, int(status), end.status.reshape(-1))

    def put(old: Tensor, new: Tensor) -> Tensor:
        rows = flat(old)
        mask = better.reshape(-1, *(1,) * (rows.ndim - 1))
        return rows.index_copy(0, index, torch.where(mask, new.reshape(-1, *rows.shape[1:]), rows[index])).reshape(old.shape)

    def charged(old: Tensor, costs: list[Tensor]) -> Tensor:
        cost = torch.stack([x.reshape(-1) for x in costs]).sum(0, dtype=torch.int32)
        return flat(old).index_copy(0, index, flat(old)[index] + cost).reshape(old.shape)

    tried = flat(before.fallbacks)[index]
    if kind is not None:
        tried[:, kind] += 1
    return Solution(
        q=put(before.q, end.q),
        status=put(before.status, ended.to(before.status.dtype)),
        residual_norm=put(before.residual_norm, end.residual_norm),
        iterations=charged(before.iterations, [x.iterations for x in climbs]),
        evaluations=charged(before.evaluations, [x.evaluations for x in climbs]),
        fallbacks=flat(before.fallbacks).index_copy(0, index, tried).reshape(before.fallbacks.shape),
        lanes=before.lanes + sum(x.lanes for x in climbs),
    )
