"""Steps of one length that are cut where something strikes or stops sliding: each is made up to there, and from there on.

A step that ends long after an impact within it knows neither when that was nor what a change of the start does to it: its
derivatives, though exact, are those of a bounce at the step's end (docs/GRADIENTS.md). Cut at the instant τ at which something
first touches on the way of an explicit step (`RungeKutta`), its end depends on the start through τ as well: dτ = −dg/ġ, g how
hard it touches a little later. When sliding stops: `stops`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor

from pbfd_torch.errors import GradientError
from pbfd_torch.integrators.integrator import S
from pbfd_torch.integrators.runge_kutta import standing
from pbfd_torch.schedules.adaptive import BRINK, CUTS, REST
from pbfd_torch.schedules.composed import Composed
from pbfd_torch.schedules.stops import Reached, at_stop, stopping, stops_found
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.stepping.stepper import Stepper
from pbfd_torch.stepping.way import Way
from pbfd_torch.stepping.worlds import put
from pbfd_torch.tensors.plain import carries, wrapped
from pbfd_torch.tensors.structures import mapped_tensors, tensors_of
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.tree.kinematics import retract

Make = Callable[[Any, Any, Tensor | None], tuple[Any, Solution]]
"""Makes a step of a stepper from a state under a control: where it ends, and how it was solved."""
Instant = Callable[[Reached, Stepper[Any], tuple[Any, Any], Tensor | None, Tensor], tuple[Tensor, Any, Solution]]
"""Finds when something happens in a step, which is known nearly, with its derivatives, and the state there."""
LATER = (1e-6, 1e-5, 1e-4, 1e-3)  # of the step, after the instant: when it is felt how hard something touches


def made_with_events(make: Make, stepper: Stepper[S], state: S, control: Tensor | None, cuts: int = CUTS) -> tuple[S, Solution]:
    """The step, in worlds in which something strikes or stops sliding up to there and on from there, with so many cuts at most. It
    carries the derivatives that the steps of `make` carry. The solution has the worst status of a world's parts and what all that
    was tried has cost; its `strike` is when something first strikes, and its `steps` are the parts: one, where all that happens is
    left within it. Raises `GradientError` in torch.func."""
    if any(map(wrapped, tensors_of(state))):
        raise GradientError("torch.func cannot look into steps that are cut on their way: use autograd or forward_ad")
    if state.time.ndim == 0:  # a single world without batch: a batch of one
        alone = mapped(lambda x: x[None], state)
        made = made_with_events(make, stepper, alone, None if control is None else control[None], cuts)
        return cast(tuple[S, Solution], mapped(lambda x: x[0], made))
    end, solution = make(stepper, state, control)
    solution = replaced(solution, steps=torch.ones_like(solution.status))
    if cuts == 0 or solution.strike is None:
        return end, solution
    strike, size = solution.strike, stepper.step_size.detach().expand(solution.strike.shape)
    stops, solution = _stops(make, stepper, (state, end), control, solution)
    instants: tuple[tuple[Tensor, Instant], ...] = ((strike, _at_strike), (stops, at_stop))
    for share, instant in instants:
        # what is left after `share` of a step is worth a part of its own
        cut = (share < 1) & (share > BRINK) & ((1 - share) * size >= REST * stepper.dt)
        index = cut.reshape(-1).nonzero().squeeze(-1)
        if len(index) == 0:
            continue
        worlds, everywhere = Worlds(tuple(size.shape), index), torch.ones_like(index, dtype=torch.bool)
        held = None if control is None else worlds.pick(control, 1)
        part, ends, at = stepper.take(worlds), (state.take(worlds), end.take(worlds)), worlds.rows(share) * worlds.rows(size)
        at, there, first = instant(_reaching(make, part, held), part, ends, held, at)
        a, integrator, whole = part.scene.articulation, part.integrator, part.step_size.expand(index.shape)
        rest = part.sized(whole - at)
        after, last = made_with_events(make, rest, integrator.resized(a, there, at, rest.step_size), held, cuts - 1)
        after = integrator.resized(a, after, rest.step_size, whole)
        after = replaced(after, hazards=there.hazards | after.hazards)
        end, solution = put(end, after, worlds, everywhere), _joined(solution, worlds, (first, last))
    return end, solution


def _reaching(make: Make, stepper: Stepper[Any], control: Tensor | None) -> Reached:
    """What makes shorter steps from the states that a stepper's steps begin in."""
    a, integrator = stepper.scene.articulation, stepper.integrator

    def reached(start: Any, time: Tensor) -> tuple[Any, Solution]:
        begin = integrator.resized(a, start, stepper.step_size.expand(time.shape), time)
        return make(stepper.sized(time), begin, control)

    return reached


def _stops(
    make: Make, stepper: Stepper[S], ends: tuple[S, S], control: Tensor | None, solution: Solution
) -> tuple[Tensor, Solution]:
    """The share of a step after which something stops sliding, 1 where nothing does, `[*batch]`, and how the step was solved with
    what this has cost. ends: the states before and after it."""
    share = torch.ones_like(ends[0].time)
    asked = stopping(stepper, *ends, control)
    index = None if asked is None else asked.reshape(-1).nonzero().squeeze(-1)
    if index is None or len(index) == 0:
        return share, solution
    worlds, everywhere = Worlds(tuple(share.shape), index), torch.ones_like(index, dtype=torch.bool)
    held, part = None if control is None else worlds.pick(control, 1), stepper.take(worlds)
    before, after = (x.take(worlds) for x in ends)
    at, found, spent = stops_found(_reaching(make, part, held), part, (before, after), held)
    spent = worlds.rows(solution.evaluations) + spent
    solution = replaced(solution, evaluations=put(solution.evaluations, spent, worlds, everywhere))
    return put(share, at / part.step_size.detach(), worlds, found), solution


def _at_strike(
    reached: Reached, stepper: Stepper[Any], ends: tuple[Any, Any], control: Tensor | None, at: Tensor
) -> tuple[Tensor, Any, Solution]:
    """When something strikes [s] `[n]`, about at `at`, the state there, and how it was made. ends: the states before and after the
    step of the stepper."""
    end, solution = reached(ends[0], at)
    spent = solution.evaluations
    for _ in range(CUTS):  # the way there is known better from nearby
        strike = solution.strike
        if strike is None or not bool((early := (strike < 1) & (strike > BRINK)).any()):
            break
        at = torch.where(early, strike * at, at)
        end, solution = reached(ends[0], at)
        spent = spent + torch.where(early, solution.evaluations, 0)
    if carries(end.q):
        at = at + _shift(stepper.sized(at), end, control, at)
        end, solution = reached(ends[0], at)
    return at, end, replaced(solution, evaluations=spent, steps=torch.ones_like(solution.status))


def _shift(stepper: Stepper[S], end: S, control: Tensor | None, at: Tensor) -> Tensor:
    """How much later something strikes as the end of a step does up to there changes: zero `[n]` [s], with its derivatives; without
    any where nothing touches soon."""
    a = stepper.scene.articulation
    plain: S = mapped_tensors(end, torch.detach)
    v = stepper.integrator.velocity(a, plain, at)
    objective = standing(stepper.objective(plain, control))
    found = torch.zeros_like(at)
    for share in LATER:
        passed = (share * at).requires_grad_()
        with torch.enable_grad():
            faster = objective.push(retract(a, plain.q, passed[..., None] * v))
            (rate,) = torch.autograd.grad(faster.sum(), passed)
        felt = objective.push(retract(a, end.q, share * at[..., None] * v))
        feels = (felt.detach() > 0) & (rate > 0) & (found == 0)
        shift = (felt.detach() - felt) / torch.where(feels, rate, torch.ones_like(rate))
        found = torch.where(feels, shift, found)
        if bool((felt > 0).all()):
            break
    return found


def _joined(whole: Solution, worlds: Worlds, parts: tuple[Solution, Solution]) -> Solution:
    """How steps were solved, those of some worlds in two parts."""
    everywhere = torch.ones_like(worlds.index, dtype=torch.bool)
    first, last = parts

    def worst(name: str) -> Tensor:
        return put(getattr(whole, name), torch.maximum(getattr(first, name), getattr(last, name)), worlds, everywhere)

    def added(name: str) -> Tensor:
        old = getattr(whole, name)
        return put(old, worlds.rows(old) + getattr(first, name) + getattr(last, name), worlds, everywhere)

    assert whole.steps is not None
    assert first.steps is not None
    assert last.steps is not None
    return replaced(
        whole,
        q=put(whole.q, last.q, worlds, everywhere),
        status=worst("status"),
        residual_norm=worst("residual_norm"),
        iterations=added("iterations"),
        evaluations=added("evaluations"),
        fallbacks=added("fallbacks"),
        steps=put(whole.steps, first.steps + last.steps, worlds, everywhere),
        lanes=whole.lanes + first.lanes + last.lanes,
    )


class EventStepper(Composed[S]):
    """A `Stepper` whose steps are cut where something strikes or stops sliding. `fixed`: makes the parts, and all other steps."""

    def made(self, state: S, control: Tensor | None) -> tuple[S, Solution, Way]:
        """See `Stepper`. Its way leads nowhere back: derivatives go through its parts."""

        def make(stepper: Stepper[S], start: S, held: Tensor | None) -> tuple[S, Solution]:
            return stepper.made(start, held)[:2]

        with torch.no_grad():
            end, solution = made_with_events(make, self.fixed, state, control)
        return end, solution, Way(end.q)
