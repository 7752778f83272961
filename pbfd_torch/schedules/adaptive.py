"""Steps of their own for every world: a user asks for an accuracy, and each world finds the Δt that gives it.

Every step is made twice, whole and as two halves. The halves are kept; how far both end apart is the error estimate. A world goes
on with the step that its own error asks for and never waits for another one but at the ends of the frames, where its control
changes and its state is recorded.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Generic, Self

import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.errors import InputError
from pbfd_torch.gradients.linked import Linked
from pbfd_torch.integrators.integrator import Integrator, S
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import SHORTEST_STEP, Simulator, Solver, put
from pbfd_torch.solvers.objective import FALLBACKS, Solution, Status
from pbfd_torch.stepping.way import Way
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import place

SAFETY, SHRINK, GROW = 0.9, 0.2, 3.0
ORDER = 3  # of the error of one step


class AdaptiveSimulator(Simulator[S]):
    """A `Simulator` whose steps, the frames, are made of as many shorter ones as each world needs.

    `dt`: length of a frame, and of the longest step [s]. `accuracy`: what a step's end may be off by, as estimated [m] > 0:
    the root mean square over the mass of a link, the largest of all links. `shortest`: a step that is never refused [s]; None:
    dt/4096."""

    def __init__(
        self,
        scene: Scene,
        dt: float,
        accuracy: float,
        integrator: Integrator[S] | None = None,
        solver: Solver | None = None,
        shortest: float | None = None,
    ) -> None:
        super().__init__(scene, dt, integrator, solver, halvings=0)
        if not (math.isfinite(accuracy) and accuracy > 0):
            raise InputError(f"accuracy is {accuracy} m: must be > 0 and finite")
        self.accuracy = float(accuracy)
        self.shortest = max(dt / 4096, 2 * SHORTEST_STEP) if shortest is None else float(shortest)
        if not 2 * SHORTEST_STEP <= self.shortest <= max(dt, 2 * SHORTEST_STEP):
            raise InputError(f"shortest is {shortest} s: must be from {2 * SHORTEST_STEP} s to dt, {dt} s")
        self._fixed = Simulator(scene, dt, self.integrator, self.solver, halvings=0)

    def _step(self, state: S, control: Tensor | None) -> tuple[S, Solution, BalanceObjective]:
        with torch.no_grad():
            frame = _Frame(self, self._fixed, state, control)
            while frame.advance():
                pass
            return frame.finish()

    def initial_state(self, q: Tensor | None = None, v: Tensor | None = None, control: Tensor | None = None) -> S:
        """As that of a simulator with steps of the frame's length."""
        return self._fixed.initial_state(q, v, control)

    def linked(self, *values: Any) -> Linked[S] | None:
        """Raises `InputError` where something carries derivatives: which steps are taken depends on it, but not smoothly."""
        if super().linked(*values) is None:
            return None
        raise InputError("the steps of an AdaptiveSimulator carry no derivatives: detach what requires them, or use a Simulator")

    def made(self, state: S, control: Tensor | None) -> tuple[S, Solution, BalanceObjective, Way]:
        """Steps of no one length are made in no one way: raises `InputError`, as trajectories and linearisations need one."""
        raise InputError("an AdaptiveSimulator has rollouts only: use a Simulator for trajectories and linearisations")

    def take(self, worlds: Worlds) -> Self:
        """The simulator of some worlds."""
        part = super().take(worlds)
        part._fixed = self._fixed.take(worlds)
        return part


class _Frame(Generic[S]):
    """How far every world is in one frame."""

    def __init__(self, simulator: AdaptiveSimulator[S], fixed: Simulator[S], state: S, control: Tensor | None) -> None:
        self._simulator, self._fixed, self._control = simulator, fixed, control
        like = torch.zeros_like(state.time)
        none = like.to(torch.int32)
        self._elapsed = like
        self._pace = like + simulator.dt if state.pace is None else state.pace
        self._state = replaced(state, pace=None, hazards=none)
        self._before = self._state  # at the start of the last step
        self._spacing = like + simulator.dt  # the step that the state's history is for
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
        left = self._simulator.dt - self._elapsed
        index = (left > 1e-9 * self._simulator.dt).reshape(-1).nonzero().squeeze(-1)
        if len(index) == 0:
            return False
        worlds = Worlds(tuple(left.shape), index)
        now, spacing, left = self._state.take(worlds), worlds.rows(self._spacing), worlds.rows(left)
        h = left / torch.ceil(left / torch.minimum(worlds.rows(self._pace), left) - 1e-6)
        held = None if self._control is None else worlds.pick(self._control, 1)
        part, integrator = self._fixed.take(worlds), self._fixed.integrator
        a = part.scene.articulation
        whole, half = part.sized(h), part.sized(0.5 * h)
        coarse, first = whole.step(integrator.resized(a, now, spacing, h), held)
        middle, second = half.step(integrator.resized(a, now, spacing, 0.5 * h), held)
        end, third = half.step(middle, held)
        end = replaced(end, hazards=now.hazards | middle.hazards | end.hazards)

        error = apart(a, coarse.q, end.q)
        broken = third.status == int(Status.NON_FINITE)
        shortest = h <= 1.001 * self._simulator.shortest  # not but for rounding
        taken = broken | shortest | ((error <= self._simulator.accuracy) & second.solved & third.solved)
        factor = (SAFETY * (self._simulator.accuracy / error) ** (1 / ORDER)).nan_to_num(SHRINK).clamp(SHRINK, GROW)
        factor = torch.where(taken, factor, factor.clamp_max(0.5))
        pace = (h * factor).clamp(self._simulator.shortest, self._simulator.dt)

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

    def finish(self) -> tuple[S, Solution, BalanceObjective]:
        """The state at the end, how the frame was solved, and the balance of the last step of every world."""
        last = self._fixed.sized(self._spacing)
        objective = last.objective(self._before, self._control)
        a, size = self._fixed.scene.articulation, self._fixed.step_size
        state = self._fixed.integrator.resized(a, self._state, self._spacing, size)
        return replaced(state, pace=self._pace), dataclasses.replace(self._solution, q=state.q), objective


def apart(articulation: Articulation, first: Tensor, second: Tensor) -> Tensor:
    """How far two configurations are apart [m] `[*batch]`: √(tr(D S Dᵀ)/m), D the difference of a link's poses, of the link for
    which it is the largest. Links without mass do not count."""
    moved = (place(articulation, first).poses - place(articulation, second).poses)[..., :3, :]
    square = ((moved @ articulation.pseudo_inertia) * moved).sum((-2, -1))
    mass = articulation.mass
    heavy = mass > 0
    return torch.where(heavy, square / torch.where(heavy, mass, torch.ones_like(mass)), 0.0).amax(-1).clamp_min(0).sqrt()
