"""Iterative LQR within limits of the controls: box-DDP after Tassa, Mansard & Todorov (2014) with Gauss–Newton Hessians.

Every iteration linearises all steps of all worlds in one batch, finds the best small change of the controls and a feedback that
corrects it (`backward_pass`), and tries that at several lengths at once, each one a further batch of worlds. Every world has its
own regularisation, which rises not only where no length lowers the cost, but also where short ones do: keeping the whole step small
bends it towards the gradient, which gets further than a small part of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.linearization import Chart
from pbfd_torch.integrators.integrator import S
from pbfd_torch.optimize.backward_pass import Policy, Regularisation, backward_pass
from pbfd_torch.optimize.costs import Cost, expanded
from pbfd_torch.optimize.limits import Limits
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.objective import is_solved
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.tensors.structures import mapped_tensors

LONG = 1  # the last of the lengths that are not yet short


@dataclass(frozen=True, eq=False)
class Motion(Generic[S]):
    """A motion and its cost.

    Attributes:
        states: `[T + 1, *batch]`, the start included.
        controls: `[T, *batch, nu]`.
        status: `[T, *batch]` values of `Status`.
        cost: `[*batch]`; infinite where it is not finite or some step is unsolved.
    """

    states: S
    controls: Tensor
    status: Tensor
    cost: Tensor

    @property
    def end(self) -> S:
        """The last state."""
        return _at(self.states, -1)


@dataclass(frozen=True, eq=False)
class Improved(Generic[S]):
    """Where iLQR ended.

    Attributes:
        motion: the best one found.
        policy: the feedback about it, and the step that would have come next.
        history: `[k + 1, *batch]` cost at the start and after every iteration.
        converged: `[*batch]` bool; the others ran out of iterations, or are `stalled`: no step however short lowers their cost.
        doubts: `[T, *batch]` bits of `Doubt` about the policy: where its derivatives are not those of plain solved steps.
    """

    motion: Motion[S]
    policy: Policy
    history: Tensor
    converged: Tensor
    stalled: Tensor
    doubts: Tensor

    @property
    def controls(self) -> Tensor:
        """`[T, *batch, nu]`."""
        return self.motion.controls

    @property
    def unsolved(self) -> Tensor:
        """How many steps of each world are unsolved `[*batch]`; where any is, nothing was improved."""
        return (~is_solved(self.motion.status)).sum(0)

    @property
    def doubtful(self) -> Tensor:
        """How many steps of each world have doubtful derivatives `[*batch]`."""
        return (self.doubts != 0).sum(0)


@dataclass(frozen=True)
class Search:
    """`iterations`: at most. `lengths`: how many are tried at once, each `shrink` times the one before. `enough`: of the foreseen
    decrease. `decrease`: relative to the cost; what foresees or does less has converged."""

    iterations: int = 100
    lengths: int = 4
    shrink: float = 0.25
    enough: float = 1e-2
    decrease: float = 1e-6

    def __post_init__(self) -> None:
        for name in ("iterations", "lengths"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}: must be ≥ 1")
        for name in ("shrink", "enough", "decrease"):
            if not 0 < getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}: must be > 0 and < 1")


def ilqr(
    simulator: Simulator[S],
    start: S,
    controls: Tensor,
    cost: Cost[S],
    limits: Limits | None = None,
    search: Search | None = None,
    progress: Callable[[int, float], object] | None = None,
) -> Improved[S]:
    """Lowers the cost of the motion from `start` under `controls` `[T, *batch, nu]`, each world by itself. progress: called after
    every iteration with its number and the lowest cost of the batch. Raises `InputError` where shapes do not fit, and
    `GradientError` where the simulator's `gradients` say so."""
    search, batch = search or Search(), tuple(start.time.shape)
    if controls.numel() == 0 or controls.shape[1:] != (*batch, simulator.scene.nu):
        shape = ", ".join(map(str, ("T ≥ 1", *batch, simulator.scene.nu)))
        raise InputError(f"controls have shape {tuple(controls.shape)}: must be [{shape}] with nu ≥ 1")
    limits = limits or Limits.none(controls)
    lengths = search.shrink ** torch.arange(search.lengths, dtype=controls.dtype, device=controls.device)
    planned = limits.clamped(controls.detach())
    motion = _played(simulator, start, lambda k, state: planned[k], len(planned), cost)
    regularisation = Regularisation.none(motion.cost)
    running, history = torch.isfinite(motion.cost), [motion.cost]
    converged, stalled = torch.zeros_like(running), torch.zeros_like(running)
    for k in range(search.iterations):
        policy, _ = _policy(simulator, motion, cost, limits, regularisation)
        trials = _tried(simulator, motion, policy, cost, limits, lengths)
        foreseen, gained = policy.foreseen(lengths), motion.cost - trials.cost
        good = (gained >= search.enough * foreseen) & (gained > 0)
        least, which = torch.where(good, trials.cost, torch.inf).min(0)
        better = running & good.any(0)
        # what is left or was gained means little while steps are kept short
        small = (
            torch.minimum(foreseen[0], torch.where(better, motion.cost - least, torch.inf)) <= search.decrease * motion.cost.abs()
        )
        done = running & small & ~regularisation.active
        motion = _replaced(better, _one(trials, which), motion)
        regularisation = regularisation.after(better & (which == 0), ~better | (which > LONG))
        lost = running & ~done & regularisation.exhausted
        converged, stalled, running = converged | done, stalled | lost, running & ~done & ~lost
        history.append(motion.cost)
        if progress is not None:
            progress(k + 1, float(motion.cost.min()))
        if not bool(running.any()):
            break
    policy, doubts = _policy(simulator, motion, cost, limits, Regularisation.none(motion.cost))
    return Improved(motion, policy, torch.stack(history), converged, stalled, doubts)


def _played(simulator: Simulator[S], start: S, control: Callable[[int, S], Tensor], steps: int, cost: Cost[S]) -> Motion[S]:
    """The motion under a law that gives the control `[*batch, nu]` of a step from its number and state."""
    with torch.no_grad():
        states, controls, status = [start], [], []
        for k in range(steps):
            controls.append(control(k, states[-1]))
            end, solution = simulator.step(states[-1], controls[-1])
            states.append(end)
            status.append(solution.status)
        whole, held = _stacked(states), torch.stack(controls)
        total = cost.running(_steps(whole), held).sum(0) + cost.final(end)
        solved = is_solved(torch.stack(status)).all(0)
    return Motion(whole, held, torch.stack(status), torch.where(solved & torch.isfinite(total), total, torch.inf))


def _policy(
    simulator: Simulator[S], motion: Motion[S], cost: Cost[S], limits: Limits, regularisation: Regularisation
) -> tuple[Policy, Tensor]:
    """And the doubts about its derivatives `[T, *batch]`."""
    before, end = _steps(motion.states), motion.end
    linear = simulator.linearize(before, motion.controls)
    running = expanded(simulator, before, cost.running, motion.controls)
    final = expanded(simulator, end, lambda state, _: cost.final(state), motion.controls[-1, ..., :0])
    left = limits.left(motion.controls)
    return backward_pass(linear.A, linear.B, running, final, left, regularisation.size), linear.doubts


def _tried(simulator: Simulator[S], motion: Motion[S], policy: Policy, cost: Cost[S], limits: Limits, lengths: Tensor) -> Motion[S]:
    """The motions `[n, *batch]` under the policy at lengths `[n]`."""
    a = lengths.reshape(-1, *(1,) * (motion.cost.ndim + 1))

    def control(k: int, state: S) -> Tensor:
        away = Chart(simulator, _at(motion.states, k)).of(state)
        return limits.clamped(motion.controls[k] + a * policy.step[k] + (policy.feedback[k] @ away[..., None]).squeeze(-1))

    first = _at(motion.states, 0)
    start: S = mapped_tensors(first, lambda x: x.expand(len(lengths), *x.shape))
    return _played(simulator, start, control, len(motion.controls), cost)


def _stacked(states: list[S]) -> S:
    whole: S = mapped(lambda *x: torch.stack(x), *states)
    return whole


def _at(states: S, k: int) -> S:
    """The state at a time."""
    one: S = mapped(lambda x: x[k], states)
    return one


def _steps(states: S) -> S:
    """Those that steps set out from."""
    before: S = mapped(lambda x: x[:-1], states)
    return before


def _one(trials: Motion[S], which: Tensor) -> Motion[S]:
    """Of motions `[n, *batch]` the one `which` `[*batch]` says."""
    rank = which.ndim

    def picked(x: Tensor, time: int) -> Tensor:
        index = which.reshape(*(1,) * (time + 1), *which.shape, *(1,) * (x.ndim - time - 1 - rank))
        return x.take_along_dim(index, time).squeeze(time)

    return Motion(
        states=mapped(lambda x: picked(x, 1), trials.states),
        controls=picked(trials.controls, 1),
        status=picked(trials.status, 1),
        cost=picked(trials.cost, 0),
    )


def _replaced(better: Tensor, new: Motion[S], old: Motion[S]) -> Motion[S]:
    """The new motions of the worlds `[*batch]` that are better."""

    def over_time(a: Any, b: Any) -> Any:
        return mapped(lambda x, y: torch.where(better.reshape(1, *better.shape, *(1,) * (x.ndim - 1 - better.ndim)), x, y), a, b)

    return Motion(
        states=over_time(new.states, old.states),
        controls=over_time(new.controls, old.controls),
        status=over_time(new.status, old.status),
        cost=torch.where(better, new.cost, old.cost),
    )
