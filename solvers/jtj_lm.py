"""JTJ-LM on the balance of forces, globalised by a search on the work that the residual does along the step.

The step of JTJ-LM, (JᵀJ + λ1)⁻¹ Jᵀ r (Eq. 14), is for λ → 0 Newton's step J⁻¹ r, taken here from a factorisation of J itself. Its
length is found without a merit function: along a direction d the work φ(a) = r(q ⊕ a d)·d is negative while the forces
still push on, and the step ends near its zero. That needs no energy, so it serves friction too.

Every world is a small state machine that spends one evaluation a round: it either accepts its trial point and sets out
in a new direction, or changes the length of its current step. No world waits for another one's search.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.solvers.objective import Evaluation, Objective, Solution, Status


@dataclass(frozen=True, eq=False)
class _Search:
    """Where every world stands: at q, about to try q ⊕ a·direction; the zero of the work lies in (low, high)."""

    q: Tensor
    trial: Tensor
    direction: Tensor
    start_work: Tensor  # φ(0) < 0
    a: Tensor
    low: Tensor
    low_work: Tensor  # φ(low) < 0
    high: Tensor  # inf until a step has gone past the zero
    high_work: Tensor
    error: Tensor  # the residual's norm at q
    status: Tensor
    running: Tensor
    iterations: Tensor
    evaluations: Tensor


@dataclass(frozen=True)
class JtjLm:
    """Attributes:
    tolerance: solved when ‖r / (scale + rounding/tolerance)‖₂ is at or below it; scale is about the scene's weight. None: 1e-9 in
        float64, 1e-3 in float32.
    max_evaluations: evaluations of the residual before a world is given up.
    max_turn: largest rotation of a joint in one step [rad].
    overshoot: a step ends where the work is at most this share of the work at its start.
    retreat_above: where ‖r/scale‖₂ at the guess exceeds this, the better of the guess and the retreat is taken.
    """

    tolerance: float | None = None
    max_evaluations: int = 400
    max_turn: float = 1.0
    overshoot: float = 0.9
    retreat_above: float = 2.0

    def solve(self, objective: Objective, guess: Tensor, retreat: Tensor | None = None) -> Solution:
        """Solves all worlds from `guess` `[*batch, nq]`; never raises for one bad world. `retreat`: a second, safer guess. Between
        rounds the host asks whether any world still runs; nothing else leaves the device."""
        tolerance = self.tolerance if self.tolerance is not None else (1e-9 if guess.dtype == torch.float64 else 1e-3)
        with torch.no_grad():
            search = self._begin(objective, guess, retreat, tolerance)
            for _ in range(self.max_evaluations - 1):
                if not bool(search.running.any()):
                    break
                search = self._round(objective, search, tolerance)
        status = torch.where(search.running, int(Status.ITERATION_LIMIT), search.status)
        return Solution(search.q, status, search.error, search.iterations, search.evaluations)

    def _begin(self, objective: Objective, guess: Tensor, retreat: Tensor | None, tolerance: float) -> _Search:
        evaluation = objective.evaluate(guess)
        error = _error(objective, evaluation, tolerance)
        evaluations = torch.ones_like(error, dtype=torch.int32)
        far = ~(error <= self.retreat_above)
        if retreat is not None and bool(far.any()):
            other = objective.evaluate(retreat)
            other_error = _error(objective, other, tolerance)
            swap = far & ~(other_error >= error)
            guess = torch.where(swap[..., None], retreat, guess)
            error = torch.where(swap, other_error, error)
            evaluation = _Chosen(swap, other, evaluation)
            evaluations = evaluations + far.to(torch.int32)
        finite = torch.isfinite(error) & torch.isfinite(guess).all(-1)
        zero = torch.zeros_like(error)
        running = finite & (error > tolerance)
        blank = _Search(
            q=guess,
            trial=guess,
            direction=torch.zeros_like(evaluation.residual),
            start_work=zero,
            a=zero,
            low=zero,
            low_work=zero,
            high=zero,
            high_work=zero,
            error=error,
            status=torch.where(finite, int(Status.SOLVED), int(Status.NON_FINITE)).to(torch.int32),
            running=running,
            iterations=torch.zeros_like(evaluations),
            evaluations=evaluations,
        )
        return self._set_out(objective, blank, evaluation, running)

    def _set_out(self, objective: Objective, search: _Search, evaluation: Evaluation, where: Tensor) -> _Search:
        """A new direction from q for the worlds in `where`, first tried at full length."""
        direction = _descent(evaluation)
        direction = direction * (self.max_turn / objective.turn(direction).clamp_min(self.max_turn))[..., None]
        direction = torch.where(where[..., None], direction, search.direction)
        work = (evaluation.residual * direction).sum(-1)
        return dataclasses.replace(
            search,
            direction=direction,
            start_work=torch.where(where, work, search.start_work),
            a=torch.where(where, 1.0, search.a),
            low=torch.where(where, 0.0, search.low),
            low_work=torch.where(where, work, search.low_work),
            high=torch.where(where, math.inf, search.high),
            trial=torch.where(where[..., None], objective.retract(search.q, direction), search.trial),
        )

    def _round(self, objective: Objective, search: _Search, tolerance: float) -> _Search:
        evaluation = objective.evaluate(search.trial)
        error = _error(objective, evaluation, tolerance)
        finite = torch.isfinite(error)
        work = (evaluation.residual * search.direction).sum(-1)
        balanced = work.abs() <= self.overshoot * search.start_work.abs()
        unbounded = torch.isinf(search.high) & (work < 0)  # a full step that stops short of the zero
        good = finite & (balanced | unbounded | (error <= tolerance))
        accept, reject = search.running & good, search.running & ~good
        arrived = accept & (error <= tolerance)
        moved = dataclasses.replace(
            search,
            q=torch.where(accept[..., None], search.trial, search.q),
            error=torch.where(accept, error, search.error),
            iterations=search.iterations + accept.to(torch.int32),
            evaluations=search.evaluations + search.running.to(torch.int32),
            running=search.running & ~arrived,
        )
        onward = self._set_out(objective, moved, evaluation, accept & ~arrived)
        return self._change_length(objective, onward, torch.where(finite, work, math.inf), reject)

    def _change_length(self, objective: Objective, search: _Search, work: Tensor, where: Tensor) -> _Search:
        """Narrows the bracket around the zero of the work for the worlds in `where`, and tries the secant's estimate of it."""
        past, short = where & (work >= 0), where & (work < 0)
        low = torch.where(short, search.a, search.low)
        low_work = torch.where(short, work, search.low_work)
        high = torch.where(past, search.a, search.high)
        high_work = torch.where(past, work, search.high_work)
        # a non-finite work at the far end gives the share 0, which the clamp turns into a tenth
        share = (-low_work / (high_work - low_work)).nan_to_num(0.5).clamp(0.1, 0.9)
        a = torch.where(where, low + share * (high - low), search.a)
        epsilon = torch.finfo(a.dtype).eps
        stalled = where & ((a < epsilon**0.6) | (high - low < 16 * epsilon * high))
        trial = objective.retract(search.q, a[..., None] * search.direction)
        return dataclasses.replace(
            search,
            a=a,
            low=low,
            low_work=low_work,
            high=high,
            high_work=high_work,
            trial=torch.where(where[..., None], trial, search.trial),
            status=torch.where(stalled, int(Status.STALLED), search.status),
            running=search.running & ~stalled,
        )


class _Chosen:
    """Per world, the evaluation at the retreat where `swap` says so, else the one at the guess."""

    def __init__(self, swap: Tensor, yes: Evaluation, no: Evaluation) -> None:
        self.residual = torch.where(swap[..., None], yes.residual, no.residual)
        self.jacobian = torch.where(swap[..., None, None], yes.jacobian, no.jacobian)
        self.stiffness = torch.where(swap[..., None, None], yes.stiffness, no.stiffness)


def _error(objective: Objective, evaluation: Evaluation, tolerance: float) -> Tensor:
    return torch.linalg.vector_norm(evaluation.residual / (objective.scale + objective.rounding / tolerance), dim=-1)


def _descent(evaluation: Evaluation) -> Tensor:
    """Newton's step where it descends (r·d < 0), else the step of the stiffness, else the residual over the stiffness' diagonal."""
    r = evaluation.residual
    both = torch.stack((evaluation.jacobian, evaluation.stiffness))
    steps, _ = torch.linalg.solve_ex(both, torch.stack((-r, -r)))
    newton, convex = steps.unbind(0)
    diagonal = evaluation.stiffness.diagonal(dim1=-2, dim2=-1).abs()
    scaled = -r / torch.where(diagonal > 0, diagonal, torch.ones_like(diagonal))
    direction = torch.where(_descends(convex, r), convex, scaled)
    return torch.where(_descends(newton, r), newton, direction)


def _descends(step: Tensor, residual: Tensor) -> Tensor:
    work = (step * residual).sum(-1, keepdim=True)
    return torch.isfinite(step).all(-1, keepdim=True) & (work < 0)
