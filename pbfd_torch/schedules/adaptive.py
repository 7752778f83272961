"""Steps of their own for every world: a user asks for an accuracy, and each world finds the Δt that gives it.

Every step is made twice, whole and as two halves. The halves are kept; how far both end apart is the error estimate. A world goes
on with the step that its own error asks for and never waits for another one but at the ends of the frames, where its control
changes and its state is recorded.
"""

from __future__ import annotations

import copy
import dataclasses
from typing import Generic, Self

import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.integrators.integrator import Integrator, S
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.objective import FALLBACKS, Solution, Status
from pbfd_torch.stepping.accuracy import Accuracy
from pbfd_torch.stepping.stepper import Solver, Stepper
from pbfd_torch.stepping.way import Way
from pbfd_torch.stepping.worlds import put
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import place

SAFETY, SHRINK, GROW = 0.9, 0.2, 3.0
ORDER = 3  # of the error of one step


class AdaptiveStepper(Generic[S]):
    """A `Stepper` whose steps, the frames, are made of as many shorter ones as each world needs.

    `fixed`: makes the steps; its own step is the length of a frame, and of the longest step [s]."""

    def __init__(self, fixed: Stepper[S], accuracy: Accuracy) -> None:
        self.fixed = fixed
        self.accuracy = accuracy

    @property
    def scene(self) -> Scene:
        return self.fixed.scene

    @property
    def integrator(self) -> Integrator[S]:
        return self.fixed.integrator

    @property
    def step_size(self) -> Tensor:
        """Of a frame."""
        return self.fixed.step_size

    @property
    def dt(self) -> float:
        """Of a frame."""
        return self.fixed.dt

    @property
    def solver(self) -> Solver:
        return self.fixed.solver

    @property
    def halvings(self) -> int:
        return self.fixed.halvings

    def initial_state(self, q: Tensor, v: Tensor, control: Tensor | None) -> S:
        """As that of steps of the frame's length."""
        return self.fixed.initial_state(q, v, control)

    def made(self, state: S, control: Tensor | None) -> tuple[S, Solution, Way]:
        """A frame of all worlds. Its way has the balance of the last step of every world, and no way back: which steps are taken
        depends on everything, but not smoothly."""
        with torch.no_grad():
            frame = _Frame(self, state, control)
            while frame.advance():
                pass
            return frame.finish()

    def objective(self, state: S, control: Tensor | None) -> BalanceObjective:
        """See `Stepper`: of a step as long as the frame."""
        return self.fixed.objective(state, control)

    def take(self, worlds: Worlds) -> Self:
        """See `Stepper`."""
        return self._of(self.fixed.take(worlds))

    def sized(self, step_size: Tensor) -> Self:
        """See `Stepper`: frames of another length."""
        return self._of(self.fixed.sized(step_size))

    def _of(self, fixed: Stepper[S]) -> Self:
        other = copy.copy(self)
        other.fixed = fixed
        return other


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
        self._solution = Solution(
            q=state.q,
            status=none,
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
        held = None if self._control is None else worlds.pick(self._control, 1)
        part, integrator = self._fixed.take(worlds), self._fixed.integrator
        a = part.scene.articulation
        whole, half = part.sized(h), part.sized(0.5 * h)
        coarse, first, _ = whole.made(integrator.resized(a, now, spacing, h), held)
        middle, second, _ = half.made(integrator.resized(a, now, spacing, 0.5 * h), held)
        end, third, _ = half.made(middle, held)
        end = replaced(end, hazards=now.hazards | middle.hazards | end.hazards)

        error, accuracy = apart(a, coarse.q, end.q), self._stepper.accuracy
        broken = third.status == int(Status.NON_FINITE)
        shortest = h <= 1.001 * accuracy.shortest  # not but for rounding
        taken = broken | shortest | ((error <= accuracy.length) & second.solved & third.solved)
        factor = (SAFETY * (accuracy.length / error) ** (1 / ORDER)).nan_to_num(SHRINK).clamp(SHRINK, GROW)
        factor = torch.where(taken, factor, factor.clamp_max(0.5))
        pace = (h * factor).clamp(accuracy.shortest, self._stepper.dt)

        everywhere = torch.ones_like(taken)
        self._elapsed = put(self._elapsed, worlds.rows(self._elapsed) + torch.where(broken, left, h), worlds, taken)
        self._pace = put(self._pace, pace, worlds, everywhere)
        self._spacing = put(self._spacing, 0.5 * h, worlds, taken)
        self._before = put(self._before, middle, worlds, taken)
        self._state = put(self._state, end, worlds, taken)
        self._count(worlds, taken, (first, second, third))
        return True

    def _count(self, worlds: Worlds, taken: Tensor, tries: tuple[Solution, Solution, Solution]) -> None:
        """All that was tried costs; how well the worlds are solved is said by what they keep."""
        total = self._solution
        kept = tries[1:]
        worst = torch.stack([x.status for x in kept]).amax(0)
        error = torch.stack([x.residual_norm for x in kept]).amax(0)
        everywhere = torch.ones_like(taken)

        def added(old: Tensor, values: list[Tensor]) -> Tensor:
            return put(old, worlds.rows(old) + torch.stack(values).sum(0, dtype=old.dtype), worlds, everywhere)

        self._solution = dataclasses.replace(
            total,
            status=put(total.status, torch.maximum(worlds.rows(total.status), worst), worlds, taken),
            residual_norm=put(total.residual_norm, torch.maximum(worlds.rows(total.residual_norm), error), worlds, taken),
            iterations=added(total.iterations, [x.iterations for x in tries]),
            evaluations=added(total.evaluations, [x.evaluations for x in tries]),
            fallbacks=added(total.fallbacks, [x.fallbacks for x in tries]),
            steps=added(torch.zeros_like(total.status) if total.steps is None else total.steps, [2 * taken.to(torch.int32)]),
            lanes=total.lanes + sum(x.lanes for x in tries),
        )

    def finish(self) -> tuple[S, Solution, Way]:
        """The state at the end, how the frame was solved, and its way with the balance of the last step of every world."""
        last = self._fixed.sized(self._spacing)
        objective = last.objective(self._before, self._control)
        a, size = self._fixed.scene.articulation, self._fixed.step_size
        state = self._fixed.integrator.resized(a, self._state, self._spacing, size)
        way = Way(state.q, (), objective)
        return replaced(state, pace=self._pace), dataclasses.replace(self._solution, q=state.q), way


def apart(articulation: Articulation, first: Tensor, second: Tensor) -> Tensor:
    """How far two configurations are apart [m] `[*batch]`: √(tr(D S Dᵀ)/m), D the difference of a body's poses, of the body for
    which it is the largest. Links that are fixed to each other are one body; those without mass do not count."""
    t = articulation.topology
    moved = (place(articulation, first).poses - place(articulation, second).poses)[..., :3, :]
    square = ((moved @ articulation.pseudo_inertia) * moved).sum((-2, -1))
    body = torch.tensor(t.link_node, device=first.device)
    square, mass = (x.new_zeros(*x.shape[:-1], t.njoint + 1).index_add(-1, body, x) for x in (square, articulation.mass))
    heavy = mass > 0
    return torch.where(heavy, square / torch.where(heavy, mass, torch.ones_like(mass)), 0.0).amax(-1).clamp_min(0).sqrt()
