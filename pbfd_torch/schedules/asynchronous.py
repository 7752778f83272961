"""The asynchronous schedule (Fig. 3): a world whose step has converged moves on to its own next step at once.

One call evaluates every world once. Worlds are at different steps, each under the control of its own step, and none waits for
another one's iterations; only at the end of the rollout are lanes without work left, and those are compacted away.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.integrators.integrator import Leaping, State
from pbfd_torch.records.recording import Recorder
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.solvers.descent import Descent, renewed
from pbfd_torch.solvers.lock_step import FEWEST_LANES, solution
from pbfd_torch.solvers.objective import FALLBACKS, Solution
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.stepping.standstill import arrived
from pbfd_torch.tensors.worlds import Worlds


class Policy(Protocol):
    """A batched policy: the control of every world from its own step and state."""

    def __call__(self, step: Tensor, q: Tensor, v: Tensor) -> Tensor:
        """step `[n]` int, q `[n, nq]`, v `[n, nv]` → control `[n, nu]`; must treat every row alike and on its own."""
        ...


class Simulated(Protocol):
    """What steps a scene by PyTorch: a `Simulator`."""

    @property
    def eager(self) -> EagerStepper[Any]: ...


class AsynchronousRollout:
    """A rollout of `steps` steps from `state` `[worlds, nq]`.

    control: `[steps, worlds, nu]`, a `Policy`, or None for zero control. The simulator's solver must be a `Descent` or `Fallbacks`;
    stuck worlds take their detours and halvings while the others wait. Raises `InputError` for another solver, for a batch that
    is not one-dimensional, and for controls of another shape."""

    def __init__(self, simulator: Simulated, state: State, steps: int, control: Tensor | Policy | None = None) -> None:
        stepper = simulator.eager
        solver = stepper.first_solver
        if not isinstance(solver, Descent):
            raise InputError(f"the solver is a {type(solver).__name__}: must be a Descent or Fallbacks")
        if isinstance(stepper.integrator, Leaping):
            name = type(stepper.integrator).__name__
            raise InputError(f"the integrator is {name}, whose explicit steps wait for nobody: leave out the asynchronous schedule")
        self._direct = solver
        if state.q.ndim != 2:
            raise InputError(f"q has shape {tuple(state.q.shape)}: must be [worlds, nq]")
        if steps < 1:
            raise InputError(f"steps is {steps}: must be ≥ 1")
        worlds, nu = len(state.q), stepper.scene.nu
        if isinstance(control, Tensor) and control.shape != (steps, worlds, nu):
            raise InputError(f"controls have shape {tuple(control.shape)}: must be {(steps, worlds, nu)}")
        self._whole, self._steps, self._control = stepper, steps, control
        device = state.q.device

        def counts(*event: int) -> Tensor:
            return torch.zeros((steps, worlds, *event), dtype=torch.int32, device=device)

        # every world's own history; entry 0 is the start
        self._states = mapped(lambda x: x.new_zeros((steps + 1, *x.shape)).index_copy(0, _first(device), x[None]), state)
        self._ends = Solution(
            q=state.q.new_zeros((steps, *state.q.shape)),
            status=counts(),
            residual_norm=state.q.new_zeros((steps, worlds)),
            iterations=counts(),
            evaluations=counts(),
            fallbacks=counts(len(FALLBACKS)),
        )
        self._controls = state.q.new_zeros((steps, worlds, nu))
        self._made = torch.zeros(worlds, dtype=torch.long, device=device)  # steps that each world has made
        self.rounds = 0
        self.lanes = 0
        # the lanes still in use: which worlds they are, and where those stand
        self._stepper, self._state = stepper, state
        self._world = torch.arange(worlds, device=device)
        self._step = torch.zeros(worlds, dtype=torch.long, device=device)
        with torch.no_grad():
            self._held = self._controlled()
            begun = self._begun()
            self._progress = self._direct.begin(self._objective, self._objective.guess, begun.q)

    @property
    def steps_made(self) -> Tensor:
        """`[worlds]` how many steps each world has made."""
        return self._made

    @property
    def done(self) -> bool:
        """Whether every world has made all its steps."""
        return len(self._world) == 0

    def advance(self) -> int:
        """One evaluation for every world; worlds that arrive start their next step. Returns how many arrived."""
        with torch.no_grad():
            self._progress = self._direct.advance(self._objective, self._progress)
            self.rounds += 1
            self.lanes += len(self._world)
            ended = (self._step < self._steps) & ~self._progress.running
            index = ended.nonzero().squeeze(-1)
            if len(index):
                self._move_on(ended, index)
            return len(index)

    def _begun(self) -> State:
        """Sets the problem of every lane's present step; the state that it is made from."""
        begun: State = self._stepper.departing(self._state, self._held)
        self._objective = self._stepper.objective(begun, self._held)
        return begun

    def _controlled(self) -> Tensor | None:
        """The control of every lane's present step; past the end, that of the last one."""
        if self._control is None:
            return None
        step = self._step.clamp_max(self._steps - 1)
        if isinstance(self._control, Tensor):
            return self._control[step, self._world]
        whole = self._whole
        v = whole.integrator.velocity(self._stepper.articulation, self._state, whole.step_size)
        return self._control(step, self._state.q, v)

    def _move_on(self, ended: Tensor, index: Tensor) -> None:
        lanes = Worlds(ended.shape, index)
        ended_there = mapped(lambda x: x[index], self._progress)
        found = solution(ended_there, ended_there.q, 0)
        state, held = self._state.take(lanes), None if self._held is None else self._held[index]
        # for all lanes, although most are not at the end: those that are, are not worth a scene of their own
        integrator = self._stepper.integrator
        advanced, refusal = integrator.advance(self._objective, self._state, self._progress.q)
        advanced = mapped(lambda x: x[index], advanced)
        refused = None if refusal is None else refusal()[index]
        if len(found.unsolved) or (refused is not None and bool(refused.any())):
            part = self._stepper.take(lanes)
            objective = self._objective.take(index)
            advanced, found, _ = part.finished(objective, state, held, found, advanced, refused)
            self.lanes += found.lanes
        dt = lanes.pick(self._stepper.step_size, 0)
        advanced, found = arrived(self._stepper.articulation, integrator, state, dt, advanced, found)
        self._record(index, advanced, held, found)
        self._state = mapped(lambda old, new: old.index_copy(0, index, new), self._state, advanced)
        self._step = self._step + ended
        self._made.index_copy_(0, self._world, self._step)
        left = int((self._step < self._steps).sum())
        if left == 0 or (left <= len(ended) // 2 and len(ended) > FEWEST_LANES):
            ended = self._compact(ended)
        if left:
            # a policy may look at the state of every lane; the lanes in mid-step keep the control they set out with
            fresh = self._controlled()
            self._held = fresh if fresh is None or self._held is None else torch.where(ended[:, None], fresh, self._held)
            self._renew(ended & (self._step < self._steps), self._begun())

    def _renew(self, where: Tensor, begun: State) -> None:
        memory = self._direct.search.begin(self._progress.error)
        self._progress = renewed(self._progress, where, self._objective.guess, begun.q, memory)

    def _record(self, index: Tensor, advanced: State, held: Tensor | None, found: Solution) -> None:
        step, world = self._step[index], self._world[index]
        mapped(lambda all_, new: _put(all_, (step + 1, world), new), self._states, advanced)
        for name in ("q", "status", "residual_norm", "iterations", "evaluations", "fallbacks"):
            _put(getattr(self._ends, name), (step, world), getattr(found, name))
        if held is not None:
            _put(self._controls, (step, world), held)

    def _compact(self, ended: Tensor) -> Tensor:
        """Drops the lanes whose worlds are done; `ended` of those that stay."""
        inside = (self._step < self._steps).nonzero().squeeze(-1)
        lanes = Worlds(ended.shape, inside)
        self._stepper = self._stepper.take(lanes)
        self._progress = mapped(lambda x: x[inside], self._progress)
        self._state = self._state.take(lanes)
        self._world, self._step = self._world[inside], self._step[inside]
        self._held = None if self._held is None else self._held[inside]
        return ended[inside]

    def finish(self, progress: Callable[[int], object] | None = None) -> Rollout:
        """Runs to the end and returns the record, as `Simulator.rollout` would. progress: called after every round with the number
        of steps that were finished in it; it may raise KeyboardInterrupt, which keeps the steps that all worlds have made."""
        try:
            while not self.done:
                arrived = self.advance()
                if progress is not None:
                    progress(arrived)
        except KeyboardInterrupt:
            if int(self._made.min()) == 0:
                raise
        whole = self._whole
        recorder = Recorder(whole.scene, whole.integrator, whole.dt, whole.step_size, self._state_at(0))
        with torch.no_grad():
            for k in range(int(self._made.min())):
                objective = whole.objective(self._state_at(k), None if self._control is None else self._controls[k])
                end = mapped(lambda x: x[k], self._ends)  # noqa: B023
                recorder.record(self._state_at(k + 1), end, objective)
        return recorder.finish(self.lanes)

    def _state_at(self, k: int) -> State:
        state: State = mapped(lambda x: x[k], self._states)
        return state


def _first(device: torch.device) -> Tensor:
    return torch.zeros(1, dtype=torch.long, device=device)


def _put(whole: Tensor, place: tuple[Tensor, Tensor], values: Tensor) -> Tensor:
    """Writes values at places that are all different; in place."""
    return whole.index_put_(place, values)
