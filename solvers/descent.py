"""Descent: a direction and a search make a solver, in which every world is a small state machine.

A world spends one evaluation a round. It either accepts its trial point and sets out in a new direction, or changes the length or
the damping of its present step. No world waits for another one's search, so the same round serves worlds that are at different
places of different problems; schedules only decide which rounds to run (`lock_step`, and the simulator's asynchronous rollout).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.solvers.directions import Direction, Newton
from pbfd_torch.solvers.lock_step import lock_step
from pbfd_torch.solvers.objective import Objective, Sane, Solution, Status
from pbfd_torch.solvers.per_world import chosen
from pbfd_torch.solvers.progress import AT_GUESS, AT_RETREAT, SEARCHING, Progress, Sighting
from pbfd_torch.solvers.searches import Memory, Search, Trial, WorkSearch


@dataclass(frozen=True)
class Descent:
    """Attributes:
    direction, search: see `directions`, `searches`.
    tolerance: solved when ‖r / (scale + rounding/tolerance)‖₂ is at or below it; scale is about the scene's weight. None: 1e-9 in
        float64, 1e-3 in float32.
    max_evaluations: evaluations of the residual before a world is given up.
    max_turn: largest rotation of a joint in one step [rad].
    retreat_above: where ‖r/scale‖₂ at the guess exceeds this, the retreat is taken for it.
    """

    direction: Direction = field(default_factory=Newton)
    search: Search[Any] = field(default_factory=WorkSearch)
    tolerance: float | None = None
    max_evaluations: int = 400
    max_turn: float = 1.0
    retreat_above: float = 2.0

    def solve(self, objective: Objective, guess: Tensor, retreat: Tensor | None = None) -> Solution:
        """Solves all worlds from `guess` `[*batch, nq]` in lock step; never raises for one bad world. `retreat`: a second, safer
        guess."""
        with torch.no_grad():
            return lock_step(self, objective, guess, retreat)

    def tolerance_for(self, dtype: torch.dtype) -> float:
        """The tolerance in effect."""
        return self.tolerance if self.tolerance is not None else (1e-9 if dtype == torch.float64 else 1e-3)

    def begin(self, objective: Objective, guess: Tensor, retreat: Tensor | None = None) -> Progress:
        """All worlds at their guess, nothing evaluated yet. Without a retreat the guess is kept, however bad."""
        like = guess[..., 0]
        zero = torch.zeros_like(like)
        count = torch.zeros_like(like, dtype=torch.int32)
        return Progress(
            q=guess,
            trial=guess,
            retreat=guess if retreat is None else retreat.expand_as(guess),
            stage=count + (AT_RETREAT if retreat is None else AT_GUESS),
            direction=(objective.scale * zero[..., None]).to(guess.dtype),
            model=None,
            memory=self.search.begin(like),
            error=zero,
            status=count + int(Status.ITERATION_LIMIT),
            running=count == 0,
            iterations=count,
            evaluations=count,
        )

    def advance(self, objective: Objective, progress: Progress) -> Progress:
        """One round: one evaluation for every world, and each world's own decision. Nothing leaves the device."""
        return self.proceed(objective, self.sight(objective, progress))

    def sight(self, objective: Objective, progress: Progress) -> Sighting:
        """The first half of a round: the evaluation, and who ends with it."""
        p = progress
        evaluation = objective.evaluate(p.trial)
        error = objective.error(evaluation, self.tolerance_for(p.q.dtype))
        finite = torch.isfinite(error) & torch.isfinite(p.trial).all(-1)
        searching = p.stage == SEARCHING
        good = finite & (error <= self.retreat_above)
        refuge = torch.isfinite(p.retreat).all(-1)
        retreating = p.running & (p.stage == AT_GUESS) & ~good & refuge
        last = (p.stage == AT_RETREAT) | ((p.stage == AT_GUESS) & ~refuge)
        hopeless = ~finite
        # what is in the host's own memory it may look at; asking a device would make it wait
        if isinstance(objective, Sane) and (last.device.type != "cpu" or bool((p.running & last).numpy().any())):
            hopeless = hopeless | objective.absurd(evaluation)
        lost = p.running & last & hopeless
        usable = p.running & finite & ~retreating & ~lost
        arrived = usable & (error <= self.tolerance_for(p.q.dtype))
        status = torch.where(arrived, int(Status.SOLVED), p.status)
        ended = dataclasses.replace(
            p,
            q=chosen(arrived, p.trial, p.q),
            error=torch.where(arrived | lost | retreating, error, p.error),
            status=torch.where(lost, int(Status.NON_FINITE), status).to(torch.int32),
            running=p.running & ~arrived & ~lost,
            iterations=p.iterations + (arrived & searching).to(torch.int32),
            evaluations=p.evaluations + p.running.to(torch.int32),
        )
        return Sighting(ended, evaluation, error, retreating, usable & ~arrived)

    def proceed(self, objective: Objective, sighting: Sighting) -> Progress:
        """The second half: every world that runs sets out in a new direction, or changes the length or the damping of its step."""
        p, evaluation = sighting.progress, sighting.evaluation
        searching = p.stage == SEARCHING
        old = p.model if p.model is not None else self.direction.model(objective, evaluation, None, p.direction, ~searching)
        verdict, memory = self.search.judge(p.memory, Trial(objective, self.direction, evaluation, old, p.direction))
        accept = sighting.usable & (~searching | verdict.good)
        stalled = p.running & searching & ~accept & verdict.stalled
        memory = chosen(searching, memory, p.memory)

        new = self.direction.model(objective, evaluation, p.model, p.memory.length[..., None] * p.direction, ~searching)
        model = chosen(accept, new, old)
        # linear solvers leave columns in memory, and sums over those round differently for one world and for many
        direction = self.direction.step(model, memory.damping).contiguous()
        direction = direction * (self.max_turn / objective.turn(direction).clamp_min(self.max_turn))[..., None]
        memory = self.search.aim(memory, Trial(objective, self.direction, evaluation, model, direction), accept)

        q = chosen(accept, p.trial, p.q)
        trial = objective.retract(q, memory.length[..., None] * direction)
        stage = torch.where(accept, SEARCHING, torch.where(sighting.retreating, AT_RETREAT, p.stage))
        return Progress(
            q=q,
            trial=chosen(sighting.retreating, p.retreat, trial),
            retreat=p.retreat,
            stage=stage.to(torch.int32),
            direction=direction,
            model=model,
            memory=memory,
            error=torch.where(accept, sighting.error, p.error),
            status=torch.where(stalled, int(Status.STALLED), p.status).to(torch.int32),
            running=p.running & ~stalled & (p.evaluations < self.max_evaluations),
            iterations=p.iterations + (accept & searching).to(torch.int32),
            evaluations=p.evaluations,
        )


def renewed(progress: Progress, where: Tensor, guess: Tensor, retreat: Tensor, memory: Memory) -> Progress:
    """Worlds in `where` start anew, on another problem, from `guess`; memory: of worlds that have not moved."""
    zero = torch.zeros_like(progress.evaluations)
    return dataclasses.replace(
        progress,
        q=chosen(where, guess, progress.q),
        trial=chosen(where, guess, progress.trial),
        retreat=chosen(where, retreat, progress.retreat),
        stage=torch.where(where, AT_GUESS, progress.stage),
        memory=chosen(where, memory, progress.memory),
        status=torch.where(where, int(Status.ITERATION_LIMIT), progress.status),
        running=where | progress.running,
        iterations=torch.where(where, zero, progress.iterations),
        evaluations=torch.where(where, zero, progress.evaluations),
    )
