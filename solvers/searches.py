"""Globalisation: how far to go along a direction, and when a trial is good enough. Every world decides for itself.

`aim` is told where a step starts, `judge` what the trial found; between the two the world's memory holds what is left to try.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, Self, TypeVar

import torch
from torch import Tensor

from pbfd_torch.solvers.directions import Direction, Model, times
from pbfd_torch.solvers.objective import Evaluation, Foreseeing, Objective, weighted_error


@dataclass(frozen=True, eq=False)
class Trial:
    """An evaluation seen along the direction that led, or is to lead, away from `model`; quantities are computed when asked for."""

    objective: Objective
    rule: Direction
    evaluation: Evaluation
    model: Model
    direction: Tensor

    @property
    def work(self) -> Tensor:
        """φ = r·d `[*batch]`: negative while the forces push on along d."""
        return (self.evaluation.residual * self.direction).sum(-1)

    @property
    def curvature(self) -> Tensor:
        """φ' = d·J d `[*batch]`."""
        return (self.direction * times(self.evaluation.jacobian, self.direction)).sum(-1)

    @property
    def merit(self) -> Tensor:
        return self.rule.merit(self.objective, self.evaluation)


@dataclass(frozen=True, eq=False)
class Memory:
    """Attributes every search has: `length` a of the next trial q ⊕ a·d and `damping` λ of its direction, `[*batch]`."""

    length: Tensor
    damping: Tensor

    def merged(self, where: Tensor, **changes: Tensor) -> Self:
        """The same memory with some values changed, for the worlds in `where`."""
        return dataclasses.replace(self, **{k: torch.where(where, v, getattr(self, k)) for k, v in changes.items()})


M = TypeVar("M", bound=Memory)


@dataclass(frozen=True, eq=False)
class Verdict:
    """`good`: the trial may be accepted; `stalled`: no shorter step is left to try; both bool `[*batch]`."""

    good: Tensor
    stalled: Tensor


class Search(Protocol[M]):
    """A globalisation."""

    def begin(self, like: Tensor) -> M:
        """The memory of worlds that have not moved yet; like: `[*batch]`."""
        ...

    def aim(self, memory: M, start: Trial, where: Tensor) -> M:
        """Worlds in `where` set out from a new point, at which `start` was evaluated."""
        ...

    def judge(self, memory: M, trial: Trial) -> tuple[Verdict, M]:
        """Whether the trial will do; the memory returned says how to go on if it will not."""
        ...


@dataclass(frozen=True, eq=False)
class Bracket(Memory):
    """The zero of the work lies in (low, high); `high` is inf until a trial has gone past it."""

    start_work: Tensor
    low: Tensor
    low_work: Tensor
    low_curvature: Tensor
    high: Tensor
    high_work: Tensor
    high_curvature: Tensor


class FirstLength(Protocol):
    """Which length to try first."""

    def length(self, start: Trial) -> Tensor:
        """At most 1, `[*batch]`, for a step that sets out from `start`."""
        ...


@dataclass(frozen=True)
class FullStep:
    """The whole step."""

    def length(self, start: Trial) -> Tensor:
        """See `FirstLength`."""
        return torch.ones_like(start.work)


@dataclass(frozen=True)
class Foreseen:
    """The whole step where the objective expects it to end short of the zero of the work, or at it: |φ(1)| ≤ `balanced`·|φ(0)|;
    also where it cannot tell. Else the first zero expected: `samples` lengths at once, evenly spaced, then as many in the interval
    in which the sign changes, `rounds` times, and a straight line at last; never below `shortest`."""

    samples: int = 8
    rounds: int = 3
    shortest: float = 1e-4
    balanced: float = 1e-2

    def length(self, start: Trial) -> Tensor:
        """See `FirstLength`."""
        work = start.work
        full = torch.ones_like(work)
        if not isinstance(start.objective, Foreseeing):
            return full
        outlook = start.objective.outlook(start.evaluation, start.direction)
        end = outlook(full[None])[0]
        whole = (end < 0) | (end.abs() <= self.balanced * work.abs())
        # what is in the host's own memory it may look at; asking a device would make it wait, so there the zeros are always sought
        if work.device.type == "cpu" and bool(whole.numpy().all()):
            return full
        return torch.where(whole, full, self._first_zero(outlook, work))

    def _first_zero(self, outlook: Callable[[Tensor], Tensor], work: Tensor) -> Tensor:
        """φ(0) `[*batch]` → the length at which φ first vanishes, at most 1."""
        full = torch.ones_like(work)
        share = torch.linspace(0, 1, self.samples + 1, dtype=work.dtype, device=work.device)[1:].reshape(-1, *[1] * work.ndim)
        low, high, low_work, high_work = torch.zeros_like(work), full, work, torch.zeros_like(work)
        passed = torch.zeros_like(work, dtype=torch.bool)
        for _ in range(self.rounds):
            lengths = low + share * (high - low)
            works = outlook(lengths)
            before = (works < 0).to(torch.int64).cumprod(0).sum(0)  # how many samples lie before the first one past the zero
            passed = passed | (before < self.samples)
            end = before.clamp_max(self.samples - 1)[None]
            lengths, works = torch.cat((low[None], lengths)), torch.cat((low_work[None], works))
            low, low_work = lengths.gather(0, end)[0], works.gather(0, end)[0]
            high, high_work = lengths.gather(0, end + 1)[0], works.gather(0, end + 1)[0]
        zero = low + (low_work / (low_work - high_work)).nan_to_num(0.5).clamp(0, 1) * (high - low)
        return torch.where(passed, zero.clamp_min(self.shortest), full)


class Interpolation(Protocol):
    """Where in a bracket of the work's zero to try next."""

    def share(self, bracket: Bracket) -> Tensor:
        """Position of the estimate, 0 at low, 1 at high."""
        ...

    def curvature(self, trial: Trial) -> Tensor:
        """What `share` wants to know beside the work."""
        ...


@dataclass(frozen=True)
class Secant:
    """The straight line between both ends; asks for no second derivative."""

    def share(self, bracket: Bracket) -> Tensor:
        share = -bracket.low_work / (bracket.high_work - bracket.low_work)
        # a non-finite work at the far end gives the share 0, which the clamp turns into a tenth
        return share.nan_to_num(0.5).clamp(0.1, 0.9)

    def curvature(self, trial: Trial) -> Tensor:
        return torch.zeros_like(trial.work)


@dataclass(frozen=True)
class Touching:
    """A straight line that starts at the low end, plus a parabola that sets in where something touches: what a trial sees that has
    run into a contact whose force grows with the square of the depth. Both ends' slopes fix all of it; the secant where they
    contradict it."""

    nearest: float = 0.02

    def share(self, bracket: Bracket) -> Tensor:
        width = bracket.high - bracket.low
        f, slope = bracket.low_work, bracket.low_curvature * width
        gap = bracket.high_work - (f + slope)  # what the parabola has reached at the high end
        steepness = bracket.high_curvature * width - slope
        touch = (1 - 2 * gap / steepness).clamp_min(0)
        curve = gap / (1 - touch).square()
        left = f + slope * touch
        further = -2 * left / (slope + torch.sqrt((slope * slope - 4 * curve * left).clamp_min(0)))
        share = torch.where(left < 0, touch + further, -f / slope)
        fits = (gap > 0) & (steepness > 0) & (share > 0) & (share < 1)
        return torch.where(fits, share.clamp(self.nearest, 1 - self.nearest), Secant().share(bracket))

    def curvature(self, trial: Trial) -> Tensor:
        return trial.curvature


@dataclass(frozen=True)
class WorkSearch:
    """Search for the zero of the work φ(a) = r(q ⊕ a d)·d, which is negative while the forces push on. It needs no energy, so it
    serves friction too; and it does not stop at non-zero minima of ½‖r‖² (the gap of Lemma 4.2).

    A full step that stays short of the zero is good; once shortened, |φ| ≤ overshoot·|φ(0)| on either side. (Accepting only the
    near side leaves a new contact just out of touch, and the search zigzags.)"""

    overshoot: float = 0.5
    first: FirstLength = field(default_factory=Foreseen)
    interpolation: Interpolation = field(default_factory=Touching)

    def begin(self, like: Tensor) -> Bracket:
        """See `Search`."""
        zero = torch.zeros_like(like)
        return Bracket(zero + 1, zero, zero, zero, zero, zero, zero + math.inf, zero, zero)

    def aim(self, memory: Bracket, start: Trial, where: Tensor) -> Bracket:
        """See `Search`."""
        work, zero = start.work, torch.zeros_like(start.work)
        return memory.merged(
            where,
            length=self.first.length(start),
            start_work=work,
            low=zero,
            low_work=work,
            low_curvature=self.interpolation.curvature(start),
            high=zero + math.inf,
        )

    def judge(self, memory: Bracket, trial: Trial) -> tuple[Verdict, Bracket]:
        """See `Search`."""
        work = trial.work
        work = torch.where(torch.isfinite(work), work, math.inf)
        curvature = self.interpolation.curvature(trial)
        balanced = work.abs() <= self.overshoot * memory.start_work.abs()
        short = work < 0
        good = balanced | (short & torch.isinf(memory.high))
        memory = memory.merged(short, low=memory.length, low_work=work, low_curvature=curvature)
        memory = memory.merged(~short, high=memory.length, high_work=work, high_curvature=curvature)
        length = memory.low + self.interpolation.share(memory) * (memory.high - memory.low)
        epsilon = torch.finfo(length.dtype).eps
        # in float32 sticking and slipping may be 1e-5 of a step apart
        stalled = (length < epsilon**0.8) | (memory.high - memory.low < 16 * epsilon * memory.high)
        return Verdict(good, stalled), dataclasses.replace(memory, length=length)


@dataclass(frozen=True, eq=False)
class Descended(Memory):
    """The merit at the start, and its slope along the direction."""

    merit: Tensor
    slope: Tensor


@dataclass(frozen=True)
class Backtracking:
    """Armijo's rule on the direction's merit: ½‖r/scale‖² for root directions, the value for minimising ones. Shortens by the
    parabola through what is known. On ½‖r‖² it stalls in non-zero minima."""

    sufficient: float = 1e-4

    def begin(self, like: Tensor) -> Descended:
        """See `Search`."""
        zero = torch.zeros_like(like)
        return Descended(zero + 1, zero, zero, zero)

    def aim(self, memory: Descended, start: Trial, where: Tensor) -> Descended:
        """See `Search`."""
        slope = start.rule.slope(start.model, start.direction)
        return memory.merged(where, length=torch.ones_like(slope), merit=start.merit, slope=slope)

    def judge(self, memory: Descended, trial: Trial) -> tuple[Verdict, Descended]:
        """See `Search`."""
        a, merit = memory.length, trial.merit
        merit = torch.where(torch.isfinite(merit), merit, math.inf)
        # near the end differences of merits are rounding only
        slack = 8 * torch.finfo(merit.dtype).eps * memory.merit.abs()
        good = merit <= memory.merit + self.sufficient * a * memory.slope + slack
        parabola = -memory.slope * a / (2 * (merit - memory.merit - memory.slope * a))
        shorter = a * parabola.nan_to_num(0.1).clamp(0.1, 0.5)
        stalled = (shorter < torch.finfo(a.dtype).eps ** 0.6) | (memory.slope >= 0)
        return Verdict(good, stalled), dataclasses.replace(memory, length=shorter)


@dataclass(frozen=True, eq=False)
class Trust(Memory):
    """The merit at the start, and what the model promised."""

    merit: Tensor
    promised: Tensor


@dataclass(frozen=True)
class TrustRegion:
    """Damping instead of shortening: a step is good if the merit falls by a share of what the model promised; λ grows where it
    does not and shrinks where the promise is kept. Promises too small to be seen in the merit are kept if ‖r/scale‖ falls."""

    accept_above: float = 1e-4
    first_damping: float = 1e-6
    largest_damping: float = 1e10

    def begin(self, like: Tensor) -> Trust:
        """See `Search`."""
        zero = torch.zeros_like(like)
        return Trust(zero + 1, zero + self.first_damping, zero, zero)

    def aim(self, memory: Trust, start: Trial, where: Tensor) -> Trust:
        """See `Search`; the promise is renewed everywhere, since a rejected world's step has changed with its damping."""
        promised = start.rule.decrease(start.model, start.direction)
        return dataclasses.replace(memory.merged(where, merit=start.merit), promised=promised)

    def judge(self, memory: Trust, trial: Trial) -> tuple[Verdict, Trust]:
        """See `Search`."""
        merit = trial.merit
        gained = torch.where(torch.isfinite(merit), memory.merit - merit, -math.inf)
        ratio = gained / memory.promised
        grown = torch.where(ratio >= self.accept_above, torch.where(ratio < 0.25, 4.0, 1.0), 10.0)
        factor = torch.where(ratio > 0.75, 0.1, grown)
        # where the promise is as small as the rounding of merits, their difference says nothing: the residuals do
        blind = memory.promised <= 64 * torch.finfo(merit.dtype).eps * memory.merit.abs()
        before, after = (weighted_error(r, trial.objective.scale, 0.0, 1.0) for r in (trial.model[0], trial.evaluation.residual))
        fell = after < before
        good = torch.where(blind, fell, ratio >= self.accept_above)
        factor = torch.where(blind, torch.where(fell, 0.1, 10.0), factor)
        damping = (memory.damping * factor).clamp_min(self.first_damping**2)
        return Verdict(good, damping > self.largest_damping), dataclasses.replace(memory, damping=damping)
