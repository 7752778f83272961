"""Steps of their own for every world: a user asks for an accuracy, and each world finds the Δt that gives it.

Every step is made twice, whole and as two halves; how far both end apart is the error estimate. What both say together is kept,
which is of fourth order, or of second where something presses, or the halves where something has struck. Explicit steps
(`RungeKutta`) know their error without halves.
A world goes on with the step that its own error asks for and never waits for another one but at the ends of the frames, where its
control changes and its state is recorded.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Generic

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import apart
from pbfd_torch.integrators.integrator import Extrapolating, Halved, S
from pbfd_torch.schedules.composed import Composed
from pbfd_torch.solvers.objective import FALLBACKS, Solution, Status
from pbfd_torch.stepping.accuracy import Accuracy
from pbfd_torch.stepping.stepper import Stepper
from pbfd_torch.stepping.way import Way
from pbfd_torch.stepping.worlds import put
from pbfd_torch.tensors.worlds import Worlds, replaced

SAFETY, SHRINK, GROW = 0.9, 0.2, 3.0
ORDER, EXPLICIT_ORDER = 3.0, 5.0  # of the error of one step
BRINK, REST = 1e-6, 1e-4  # of the step, before a strike; of the frame, after it: less is not worth a step of its own
CUTS = 5  # how often a step may be cut short


class AdaptiveStepper(Composed[S]):
    """A `Stepper` whose steps, the frames, are made of as many shorter ones as each world needs.

    `fixed`: makes the steps; its own step is the length of a frame, and of the longest step [s]."""

    def __init__(self, fixed: Stepper[S], accuracy: Accuracy) -> None:
        super().__init__(fixed)
        self.accuracy = accuracy

    def made(self, state: S, control: Tensor | None) -> tuple[S, Solution, Way]:
        """A frame of all worlds. Its way has the balance of the last step of every world, and no way back: which steps are taken
        depends on everything, but not smoothly."""
        with torch.no_grad():
            frame = _Frame(self, state, control)
            while frame.advance():
                pass
            return frame.finish()


class _Frame(Generic[S]):
    """How far every world is in one frame."""

    def __init__(self, stepper: AdaptiveStepper[S], state: S, control: Tensor | None) -> None:
        self._stepper, self._fixed, self._control = stepper, stepper.fixed, control
        like = torch.zeros_like(state.time)
        none = like.to(torch.int32)
        self._elapsed = like
        self._pace = like + stepper.dt if state.pace is None else state.pace
        self._state = replaced(state, pace=None, hazards=none)
        self._before = self._state  # at the start of the last step
        self._spacing = like + stepper.dt  # the step that the state's history is for
        self._cut = like + torch.inf  # the step that ends where something strikes
        self._cuts = none  # how often it has been cut short
        self._solution = Solution(
            q=state.q,
            status=torch.full_like(none, int(Status.EXPLICIT)),
            residual_norm=like,
            iterations=none,
            evaluations=none,
            fallbacks=none[..., None].expand(*none.shape, len(FALLBACKS)),
            steps=none,
        )

    def advance(self) -> bool:
        """One step of every world that is not at the end of the frame, whole and in halves; whether there was any."""
        left = self._stepper.dt - self._elapsed
        index = (left > 1e-9 * self._stepper.dt).reshape(-1).nonzero().squeeze(-1)
        if len(index) == 0:
            return False
        worlds = Worlds(tuple(left.shape), index)
        now, spacing, left = self._state.take(worlds), worlds.rows(self._spacing), worlds.rows(left)
        h = left / torch.ceil(left / torch.minimum(worlds.rows(self._pace), left) - 1e-6)
        h, cuts = torch.minimum(h, worlds.rows(self._cut)), worlds.rows(self._cuts)
        held = None if self._control is None else worlds.pick(self._control, 1)
        may_cut = (cuts < CUTS, (left - REST * self._stepper.dt) / h)
        tried = _tried(self._fixed.take(worlds), now, spacing, h, held, may_cut, self._stepper.accuracy.length)

        accuracy, solution = self._stepper.accuracy, tried.solution
        broken = solution.status == int(Status.NON_FINITE)
        shortest = h <= 1.001 * accuracy.shortest  # not but for rounding
        taken = ~tried.cut & (broken | shortest | ((tried.error <= accuracy.length) & solution.solved))
        order = torch.where(tried.explicit, EXPLICIT_ORDER, ORDER)
        factor = (SAFETY * (accuracy.length / tried.error) ** (1 / order)).nan_to_num(SHRINK).clamp(SHRINK, GROW)
        factor = torch.where(taken, factor, factor.clamp_max(0.5))
        wish, before = h * factor, worlds.rows(self._pace)
        # a step that was cut short does not slow down those that follow
        pace = torch.where(taken & (cuts > 0) & (wish <= before), before, wish.clamp(accuracy.shortest, self._stepper.dt))
        pace = torch.where(tried.cut, before, pace)

        everywhere = torch.ones_like(taken)
        self._elapsed = put(self._elapsed, worlds.rows(self._elapsed) + torch.where(broken, left, h), worlds, taken)
        self._pace = put(self._pace, pace, worlds, everywhere)
        self._cut = put(self._cut, torch.where(tried.cut, tried.strike * h, torch.inf), worlds, everywhere)
        self._cuts = put(self._cuts, torch.where(tried.cut, cuts + 1, 0), worlds, everywhere)
        self._spacing = put(self._spacing, torch.where(tried.explicit, h, 0.5 * h), worlds, taken)
        self._before = put(self._before, tried.before_last, worlds, taken)
        self._state = put(self._state, tried.end, worlds, taken)
        self._count(worlds, taken, tried)
        return True

    def _count(self, worlds: Worlds, taken: Tensor, tried: _Tried[S]) -> None:
        """All that was tried costs; how well the worlds are solved is said by what they keep."""
        total, found = self._solution, tried.solution
        everywhere = torch.ones_like(taken)
        made = torch.where(taken, torch.where(tried.explicit, 1, 2), 0)

        def worst(old: Tensor, new: Tensor) -> Tensor:
            return put(old, torch.maximum(worlds.rows(old), new), worlds, taken)

        def added(old: Tensor, new: Tensor) -> Tensor:
            return put(old, worlds.rows(old) + new.to(old.dtype), worlds, everywhere)

        self._solution = dataclasses.replace(
            total,
            status=worst(total.status, found.status),
            residual_norm=worst(total.residual_norm, found.residual_norm),
            iterations=added(total.iterations, found.iterations),
            evaluations=added(total.evaluations, found.evaluations),
            fallbacks=added(total.fallbacks, found.fallbacks),
            steps=added(torch.zeros_like(total.status) if total.steps is None else total.steps, made),
            lanes=total.lanes + found.lanes,
        )

    def finish(self) -> tuple[S, Solution, Way]:
        """The state at the end, how the frame was solved, and its way with the balance of the last step of every world."""
        last = self._fixed.sized(self._spacing)
        objective = last.objective(self._before, self._control)
        a, size = self._fixed.scene.articulation, self._fixed.step_size
        state = self._fixed.integrator.resized(a, self._state, self._spacing, size)
        way = Way(state.q, (), objective)
        return replaced(state, pace=self._pace), dataclasses.replace(self._solution, q=state.q), way


@dataclass(frozen=True, eq=False)
class _Tried(Generic[S]):
    """A step of `n` worlds, made as a whole and, where that was not explicit, again as two halves.

    Attributes:
        explicit: `[n]` bool. cut: `[n]` bool, which is to be made again, to where something strikes, after a share `strike` `[n]`.
        error: `[n]` [m], how far the step is off.
        before_last, end: the states around the last of the steps that are to be kept: the whole one, or the second half.
        solution: with the worst status and error of these steps, and what all that was made has cost.
    """

    explicit: Tensor
    cut: Tensor
    strike: Tensor
    error: Tensor
    before_last: S
    end: S
    solution: Solution


def _tried(
    stepper: Stepper[S],
    state: S,
    spacing: Tensor,
    h: Tensor,
    control: Tensor | None,
    may_cut: tuple[Tensor, Tensor],
    accuracy: float,
) -> _Tried[S]:
    """A step of length h `[n]` from a state whose history is for steps of `spacing`. may_cut: whether it may be cut short where
    something strikes, and the share of it where the latest cut may be, `[n]` each. accuracy: asked for [m]."""
    integrator, a = stepper.integrator, stepper.scene.articulation
    start = integrator.resized(a, state, spacing, h)
    coarse, first, _ = stepper.sized(h).made(start, control)
    explicit = first.status == int(Status.EXPLICIT)
    error = torch.zeros_like(h) if first.estimate is None else first.estimate
    strike = torch.ones_like(h) if first.strike is None else first.strike
    cut = (strike < 1) & (strike > BRINK) & may_cut[0] & (strike <= may_cut[1])
    whole = _Tried(explicit, cut, strike, error, start, replaced(coarse, hazards=state.hazards | coarse.hazards), first)
    index = (~explicit & ~cut).reshape(-1).nonzero().squeeze(-1)
    if len(index) == 0:
        return whole
    worlds, everywhere = Worlds(tuple(explicit.shape), index), torch.ones_like(index, dtype=torch.bool)
    half = stepper.take(worlds).sized(0.5 * worlds.rows(h))
    a, before = half.scene.articulation, state.take(worlds)
    held = None if control is None else worlds.pick(control, 1)
    begin = integrator.resized(a, before, worlds.rows(spacing), half.step_size)
    middle, second, _ = half.made(begin, held)
    end, third, _ = half.made(middle, held)
    rough = coarse.take(worlds)
    off = apart(a, rough.q, end.q)
    if isinstance(integrator, Extrapolating):
        end = integrator.extrapolated(a, half.scene.terms, Halved(before, rough, middle, end, off, accuracy))
    end = replaced(end, hazards=before.hazards | middle.hazards | end.hazards)

    def added(old: Tensor, one: Tensor, other: Tensor) -> Tensor:
        return put(old, worlds.rows(old) + one + other, worlds, everywhere)

    solution = dataclasses.replace(
        first,
        status=put(first.status, torch.maximum(second.status, third.status), worlds, everywhere),
        residual_norm=put(first.residual_norm, torch.maximum(second.residual_norm, third.residual_norm), worlds, everywhere),
        iterations=added(first.iterations, second.iterations, third.iterations),
        evaluations=added(first.evaluations, second.evaluations, third.evaluations),
        fallbacks=added(first.fallbacks, second.fallbacks, third.fallbacks),
        lanes=first.lanes + second.lanes + third.lanes,
    )
    return _Tried(
        explicit,
        cut,
        strike,
        put(whole.error, off, worlds, everywhere),
        put(whole.before_last, middle, worlds, everywhere),
        put(whole.end, end, worlds, everywhere),
        solution,
    )
