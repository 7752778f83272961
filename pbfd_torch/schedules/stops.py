"""When sliding stops within a step.

A step at whose end a contact no longer slides has braked for too long or too short, whatever its length: friction acts in it as it
does at its end. So the step is to end where the slip does. That instant τ is found by steps of other lengths t from the same state,
in all of which friction is fully there: the slip speed that is left, F(t) = ‖u(t)‖ − m, is smooth there, and zero at τ. A little
speed m is left, twice the slip speed of the friction law, below which friction would fade. As τ depends on the start,
dτ = −dF/Ḟ, Ḟ the derivative of F by the length of the step.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.integrators.integrator import State
from pbfd_torch.schedules.sliding import Sliding, may_slide
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.stepping.stepper import Stepper
from pbfd_torch.tensors.plain import carries
from pbfd_torch.tensors.structures import mapped_tensors
from pbfd_torch.tensors.vectors import dot
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.friction_law import slip_size

FAST, LEFT = 4.0, 2.0  # slip speeds: what slides at the start of a step, and what is left of it at the stop
TRIALS = 14  # steps that look for the stop
NEAR = 1e-8  # of the step, to which the stop is found
SOONER = 0.25  # of a step that is too long: the next one, as long as none is known that is short enough
Reached = Callable[[Any, Tensor], tuple[Any, Solution]]
"""Makes a step of some length [s] `[n]` from a state: where it ends, and how it was solved."""


def stopping(stepper: Stepper[Any], state: State, end: State, control: Tensor | None) -> Tensor | None:
    """Worlds in which something that slides at a state no longer does, or slides back, at the end of the step from it, `[*batch]`
    bool; None: in none."""
    if not isinstance(state, Velocities) or not isinstance(end, Velocities):
        return None
    with torch.no_grad():
        before, after = (mapped_tensors(x, torch.detach) for x in (state, end))
        asked = may_slide(stepper.scene, before, FAST)
        if asked is None:
            return None
        asked = asked & (before.push != 0).any(-1) & (after.push != 0).any(-1)
        index = asked.reshape(-1).nonzero().squeeze(-1)
        if len(index) == 0:
            return None
        worlds = Worlds(tuple(asked.shape), index)
        held = None if control is None else worlds.pick(control, 1)
        slide = _Slide(stepper.take(worlds), before.take(worlds), held)
        stops = slide.stops(after.take(worlds)).any(-1)
        return torch.zeros_like(asked).reshape(-1).index_copy(0, index, stops).reshape(asked.shape)


def stops_found(
    reached: Reached, stepper: Stepper[Any], ends: tuple[Any, Any], control: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """When the first of what slides stops [s] `[n]`, in which worlds that has been found `[n]` bool, and what the search has cost
    `[n]` int. It is not where the slip jumps, as through an impact. ends: the states before and after the step of the stepper; all
    worlds are such as `stopping` names."""
    with torch.no_grad():
        before, after = (mapped_tensors(x, torch.detach) for x in ends)
        slide = _Slide(stepper, before, control)
        stops = slide.stops(after)
        whole = stepper.step_size.detach().expand(before.time.shape)
        low, high, settled = torch.zeros_like(whole), whole, torch.zeros_like(whole, dtype=torch.bool)
        first = last = (low, slide.left(before, stops))  # the last two instants until which friction is fully there
        at, spent = SOONER * whole, torch.zeros_like(after.hazards)
        for _ in range(TRIALS):
            found, solution = reached(before, at)
            spent = spent + torch.where(settled, 0, solution.evaluations)
            left = slide.left(found, stops)
            low, high = torch.where(left > 0, at, low), torch.where(left > 0, high, at)
            known = (left > -slide.least) & ~settled
            first, last = _newer(known, first, last), _newer(known, last, (at, left))
            brakes = (first[1] - last[1]) / torch.where(last[0] == first[0], torch.inf, last[0] - first[0])
            settled = settled | (known & (left.abs() <= NEAR * whole * brakes))
            if bool(settled.all()):
                break
            guess = last[0] + last[1] / torch.where(brakes > 0, brakes, 1.0)
            inside = (brakes > 0) & (guess > low) & (guess < high)
            other = torch.where(low > 0, 0.5 * (low + high), SOONER * high)
            at = torch.where(settled, at, torch.where(inside, guess, other))
    return at, settled, spent


def at_stop(
    reached: Reached, stepper: Stepper[Any], ends: tuple[Any, Any], control: Tensor | None, at: Tensor
) -> tuple[Tensor, Any, Solution]:
    """The instant at which sliding stops, which is `at` [s] `[n]`, with its derivatives, the state there, and how it was made.
    Arguments: as in `stops_found`, which has found all of it."""
    there, solution = reached(ends[0], at)
    with torch.no_grad():
        before, after = (mapped_tensors(x, torch.detach) for x in ends)
        slide = _Slide(stepper, before, control)
        stops = slide.stops(after)
        gone = slide.gone(mapped_tensors(there, torch.detach), stops)
    if carries(there.q):
        at = at + slide.shift(functools.partial(reached, before), there, at, stops)
        there, solution = reached(ends[0], at)
    there = Sliding(stepper, ends[0], control).stilled(there, at, gone)
    return at, there, replaced(solution, steps=torch.ones_like(solution.status))


def _newer(where: Tensor, old: tuple[Tensor, Tensor], new: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    return torch.where(where, new[0], old[0]), torch.where(where, new[1], old[1])


class _Slide:
    """What slides at a state, and how it does later in the step from there. least: the smallest slip speed of the friction laws."""

    def __init__(self, stepper: Stepper[Any], state: Velocities, control: Tensor | None) -> None:
        self._sliding = Sliding(stepper, state, control)
        self.least = self._sliding.speed.min()
        start = self._sliding.start
        self._slip = start.slip(self._sliding.velocity(state))
        # the velocity alone does not tell: where friction has just stopped a slide it counts as if that went on
        average = start.slip(state.average)
        size = torch.minimum(slip_size(self._slip), slip_size(average))
        self._slides = start.pressing & (size > FAST * self._sliding.speed) & (dot(self._slip, average) > 0)

    def stops(self, end: Velocities) -> Tensor:
        """Which candidates press all along, have slid up to the start and no longer do, or slide back, at the end, `[*batch, n]`
        bool."""
        there, slip = self._sliding.at(end)
        return self._slides & there.pressing & (self._left(slip) <= 0)

    def left(self, state: Velocities, stops: Tensor) -> Tensor:
        """F of the module's head: how much faster than m the slowest of some candidates `[*batch, n]` slides at a state,
        `[*batch]` [m/s]; < −m where it slides back."""
        return torch.where(stops, self._left(self._sliding.at(state)[1]), torch.inf).amin(-1)

    def shift(self, reached: Callable[[Tensor], Any], there: Velocities, at: Tensor, stops: Tensor) -> Tensor:
        """How much later sliding stops as the state `there`, where it does after a time `at` [s] `[n]`, changes: zero `[n]` [s],
        with its derivatives."""
        with torch.enable_grad():
            length = at.detach().requires_grad_()
            (rate,) = torch.autograd.grad(self.left(reached(length)[0], stops).sum(), length)
        left = self.left(there, stops)
        return (left.detach() - left) / torch.where(rate < 0, rate, -torch.inf)

    def gone(self, there: Velocities, stops: Tensor) -> Tensor:
        """Which of some candidates `[*batch, n]` have stopped at a state, `[*batch, n]` bool."""
        return stops & (self._left(self._sliding.at(there)[1]) <= self.least)

    def _left(self, slip: Tensor) -> Tensor:
        """F of every candidate that slips like this, `[*batch, n, 3]` → `[*batch, n]` [m/s]."""
        size = slip_size(slip)
        return torch.where(dot(slip, self._slip) < 0, -size, size) - LEFT * self._sliding.speed
