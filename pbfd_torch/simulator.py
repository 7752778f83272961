"""The simulator: one step, and a rollout, for any batch of worlds at once."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable
from typing import Any, Generic, Protocol, Self, TypeVar, cast

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import bias_force, mass_matrix
from pbfd_torch.balance.objective import BalanceObjective, blank_memory
from pbfd_torch.errors import ContactOverflowError, InputError
from pbfd_torch.gradients.implicit import Attempt, Gradients, Parts
from pbfd_torch.gradients.linearization import Linearization, linearized
from pbfd_torch.gradients.linked import Linked, carries
from pbfd_torch.gradients.trajectory import Trajectory, trajectory
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator, S, State, Trial, calm
from pbfd_torch.records.recording import Recorder
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.fallbacks import Fallbacks, merged
from pbfd_torch.solvers.objective import FALLBACKS, Relaxable, Solution, Status, unsolved_worlds
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.stepping.way import Detour, Way
from pbfd_torch.tensors.structures import in_dtype, tensors_of
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.tree.articulation import Articulation, force_scale

SHORTEST_STEP = 1e-5  # [s]
R = TypeVar("R", bound=State)


class Solver(Protocol):
    """What finds the end of a step."""

    def solve(self, objective: Relaxable, guess: Tensor, retreat: Tensor | None = None) -> Solution:
        """Root of the objective for every world, from `guess`, or from `retreat` where that is the safer start."""
        ...


class Simulator(Generic[S]):
    """Steps a scene.

    `dt`: step [s] > 0, a number, or a scalar tensor where gradients by it are wanted; smaller than 1e-5 is refused because rounding
    would dominate the positions' differences. `halvings`: how often a world's step may be halved (2, 4, 8 … shorter steps) where
    nothing else solves it; 0: never. `gradients`: how steps are differentiated (`implicit`)."""

    def __init__(
        self,
        scene: Scene,
        dt: float | Tensor,
        integrator: Integrator[S] | None = None,
        solver: Solver | None = None,
        halvings: int = 3,
        gradients: Gradients | None = None,
    ) -> None:
        step = float(dt.detach()) if isinstance(dt, Tensor) else dt
        if not (math.isfinite(step) and step >= SHORTEST_STEP):
            raise InputError(f"dt is {step} s: must be a finite number ≥ 1e-5")
        if halvings < 0:
            raise InputError(f"halvings is {halvings}: must be ≥ 0")
        a = scene.articulation
        self.scene = scene
        self.dt = float(step)
        self.integrator: Integrator[S] = integrator or cast(Integrator[S], EnergyMomentum())
        self.solver: Solver = solver or Fallbacks()
        self.halvings = halvings
        self.gradients = gradients or Gradients()
        self.step_size = torch.as_tensor(dt, dtype=a.dtype, device=a.device)
        with torch.no_grad():
            self._terms = self.integrator.adapted(a, scene.terms, self.step_size)
        self._attempt: Attempt = _attempted
        self._scale = force_scale(a, torch.linalg.vector_norm(scene.gravity, dim=-1))

    @property
    def first_solver(self) -> Solver:
        """What a step is given to first: no long detours where there is an easier step."""
        return self.solver.brisk if self.integrator.easier and isinstance(self.solver, Fallbacks) else self.solver

    def initial_state(self, q: Tensor | None = None, v: Tensor | None = None, control: Tensor | None = None) -> S:
        """State at configuration q `[*batch, nq]` (None: the rest configuration) and velocity v `[*batch, nv]` (None: at rest).
        One configuration goes to all worlds where the velocity, gravity or the articulation's parameters have several.

        The start is of second order, or of first order in a world whose trial step is unsolved, if the integrator needs one. Raises
        `InputError` for wrong shapes, dtypes, devices or NaN."""
        q, v = self.scene.placed(q, v)
        linked = self.linked(q, v, control)
        return self.started(q, v, control) if linked is None else linked.initial_state(q, v, control)

    def started(self, q: Tensor, v: Tensor, control: Tensor | None) -> S:
        """`initial_state` of checked values."""
        start = self.integrator.start(self, q, v, control)
        return replaced(start, memory=blank_memory(self.scene.terms, tuple(q.shape[:-1])))

    @property
    def articulation(self) -> Articulation:
        return self.scene.articulation

    def trial(self, q: Tensor, v: Tensor, control: Tensor | None) -> Trial:
        """A step of implicit Euler from q `[*batch, nq]` with v `[*batch, nv]`."""
        a, scheme = self.articulation, ImplicitEuler()
        simulator = self.with_scheme(scheme, self.solver, self.halvings, self.step_size)
        start = scheme.at_rate(a, q, v, torch.zeros_like(v), self.step_size)
        end, solved = self._attempt(simulator, start, control)
        objective = simulator.objective(start, control)
        abrupt, others = objective.forces(end.q)
        others = others - bias_force(a, q, v, self.scene.gravity)
        columns, _ = torch.linalg.solve_ex(mass_matrix(a, q, self.scene.terms), torch.stack((abrupt, others), -1))
        by_abrupt, by_others = columns.unbind(-1)
        # an impact within the step has given nothing before it
        steady = calm(objective, objective.step.previous, self.step_size[..., None] * by_abrupt)
        acceleration = by_others + torch.where(steady[..., None], by_abrupt, 0.0)
        return Trial(end.q, torch.where(solved[..., None], acceleration, 0.0), solved)

    def objective(self, state: S, control: Tensor | None = None) -> BalanceObjective:
        """The balance of forces that the step from `state` solves."""
        articulation = self.scene.articulation
        context = self.integrator.context(articulation, state, self.step_size, self.scene.gravity, control)
        return BalanceObjective.of_step(articulation, self._terms, context, self._scale, state.memory)

    def step(self, state: S, control: Tensor | None = None) -> tuple[S, Solution]:
        """One step of all worlds under `control` `[*batch, nu]` (None: zero). Never raises for one bad world: see the solution's
        status. An unsolved world goes on from the best point found.

        Where the state, the control, the scene's numbers or dt carry derivatives, so does the new state, by the implicit function
        theorem (`implicit`); its values are the same to the bit."""
        linked = self.linked(state, control)
        if linked is not None:
            advanced, made = linked.step(state, control)
            return advanced, made.solution
        advanced, solution, _ = self._step(state, control)
        return advanced, solution

    def linked(self, *values: Any) -> Linked[S] | None:
        """What differentiates the steps from these values; None where nothing carries derivatives."""
        linked = Linked(self)
        return linked if linked.active or any(map(carries, tensors_of(list(values)))) else None

    def _step(self, state: S, control: Tensor | None) -> tuple[S, Solution, BalanceObjective]:
        advanced, solution, objective, _ = self.made(state, control)
        return advanced, solution, objective

    def trajectory(
        self,
        state: S,
        controls: Tensor | None = None,
        steps: int | None = None,
        checkpoint: int = 1,
        progress: Callable[[int], object] | None = None,
    ) -> Trajectory[S]:
        """Steps from `state` and keeps what carries derivatives: configurations, velocities, and how each step was solved.

        controls, steps: as in `rollout`. checkpoint: keep every so many-th state only, for less memory and about twice the time.
        progress: called with the number of steps done. Raises `InputError` where controls and steps do not agree."""
        return trajectory(self, state, controls, steps, checkpoint, progress)

    def linearize(self, state: S, control: Tensor | None = None) -> Linearization[S]:
        """The step from `state` under `control` `[*batch, nu]` as A `[*batch, nx, nx]` and B `[*batch, nx, nu]` in the coordinates
        of `Chart`: exact derivatives, all worlds and all rows in one pass. Raises `GradientError` at unsolved and singular
        steps unless `gradients` says otherwise."""
        return linearized(self, state, control)

    def made(self, state: S, control: Tensor | None) -> tuple[S, Solution, BalanceObjective, Way]:
        """A step without derivatives, its own balance, and how it was made."""
        with torch.no_grad():
            objective = self.objective(state, control)
            solution = self.first_solver.solve(objective, objective.guess, state.q)
            advanced, refusal = self.integrator.advance(objective, state, solution.q)
            refused = None if refusal is None else refusal()
            end, finished, detours = self.finished(state, control, advanced, solution, refused)
            return end, finished, objective, Way(solution.q.detach(), detours)

    def finished(
        self, state: S, control: Tensor | None, advanced: S, solution: Solution, refused: Tensor | None
    ) -> tuple[S, Solution, tuple[Detour, ...]]:
        """The state after a step that the solver has left at `solution`, from which the integrator would go on to `advanced`:
        worlds that are unsolved or refused try easier steps, and those that still are unsolved shorter ones."""
        detours: list[Detour] = []
        if refused is not None:
            status = torch.where(refused & solution.solved, int(Status.STALLED), solution.status)
            solution = dataclasses.replace(solution, status=status.to(torch.int32))
        easier = self.integrator.easier
        index = unsolved_worlds(solution)
        if len(index) and easier and self._may_halve(1):
            index = index[self.integrator.halves(self.objective(state, control), solution.q).reshape(-1)[index]]
            if len(index):
                advanced, solution, detour = self._halved(state, control, advanced, solution, index, 2)
                detours.append(detour)
        for k, scheme in enumerate(easier):
            index = unsolved_worlds(solution)
            if len(index) == 0:
                break
            # detours for the last one only: what comes before is tried for its accuracy
            solver = self.solver if k == len(easier) - 1 else self.first_solver
            advanced, solution, detour = self._eased(state, control, advanced, solution, index, scheme, solver)
            detours.append(detour)
        for halvings in range(1, self.halvings + 1):
            index = unsolved_worlds(solution)
            if len(index) == 0 or not self._may_halve(halvings):
                break
            advanced, solution, detour = self._halved(state, control, advanced, solution, index, 2**halvings)
            detours.append(detour)
        return advanced, solution, tuple(detours)

    def _may_halve(self, times: int) -> bool:
        return times <= self.halvings and self.dt / 2**times >= SHORTEST_STEP

    def take(self, worlds: Worlds) -> Self:
        """The simulator of some worlds."""
        part = copy.copy(self)
        part.scene = self.scene.take(worlds)
        part._terms = [term.take(worlds) for term in self._terms]
        part._scale = worlds.pick(self._scale, 1)
        part.step_size = worlds.pick(self.step_size, 0)
        return part

    def sized(self, step_size: Tensor) -> Simulator[S]:
        """The same simulator with steps [s] of another length, or of one for each world `[*batch]`."""
        return self.with_scheme(self.integrator, self.solver, self.halvings, step_size)

    def with_scheme(self, integrator: Integrator[R], solver: Solver, halvings: int, step_size: Tensor) -> Simulator[R]:
        """The same scene with another integrator and other steps [s] `[]` or `[*batch]`."""
        other = cast(Simulator[R], copy.copy(self))
        other.integrator, other.solver, other.halvings = integrator, solver, halvings
        other.step_size, other.dt = step_size, float(step_size.detach().min())
        other._terms = integrator.adapted(self.articulation, self.scene.terms, step_size)
        return other

    @property
    def parts(self) -> Parts:
        """What the steps depend on besides the state and the control."""
        scene, terms = self.scene, self._terms
        parts = Parts(scene.articulation, scene.terms, scene.gravity, self.step_size, scene.terms)
        if any(map(carries, tensors_of(parts))):
            terms = self.integrator.adapted(scene.articulation, scene.terms, self.step_size)
        return replaced(parts, adapted=terms)

    def of_parts(self, parts: Parts) -> Simulator[S]:
        """The same simulator made of other values of its parts."""
        other = copy.copy(self)
        other.scene = replaced(self.scene, articulation=parts.articulation, terms=parts.terms, gravity=parts.gravity)
        other.step_size, other._terms = parts.step_size, parts.adapted
        return other

    def precise(self) -> Simulator[S]:
        """The same simulator in float64, itself if it is."""
        if self.articulation.dtype == torch.float64:
            return self
        scene = self.scene
        parts = Parts(scene.articulation, scene.terms, scene.gravity, self.step_size, self._terms)
        other = self.of_parts(in_dtype(parts, torch.float64))
        other._scale = self._scale.double()
        return other

    def with_attempt(self, attempt: Attempt) -> Simulator[S]:
        """The same simulator whose trial steps are made by `attempt`."""
        other = copy.copy(self)
        other._attempt = attempt
        return other

    def _eased(
        self,
        state: S,
        control: Tensor | None,
        advanced: S,
        solution: Solution,
        index: Tensor,
        easier: Integrator[S],
        solver: Solver,
    ) -> tuple[S, Solution, Detour]:
        """The step of the worlds at `index` again, as one of another integrator; they keep the result whether it is solved or
        not."""
        worlds = Worlds(state.q.shape[:-1], index)
        part = self.take(worlds)
        other = part.with_scheme(easier, solver, 0, part.step_size)
        before, held = state.take(worlds), None if control is None else worlds.pick(control, 1)
        objective = other.objective(before, held)
        found = other.solver.solve(objective, objective.guess, before.q)
        lost = torch.where(solution.solved, solution.residual_norm, math.inf)
        result = merged(
            dataclasses.replace(solution, residual_norm=lost), index, [found], FALLBACKS.index("easier step"), Status.EASED
        )
        eased, _ = other.integrator.advance(objective, before, found.q)
        kept = torch.isfinite(found.residual_norm)
        return put(advanced, eased, worlds, kept), result, Detour(worlds, kept, easier, (Way(found.q),))

    def _halved(
        self, state: S, control: Tensor | None, advanced: S, solution: Solution, index: Tensor, parts: int
    ) -> tuple[S, Solution, Detour]:
        """The step of the worlds at `index` again, as `parts` shorter ones; a world keeps the result if all of them solve. It then
        goes on with the velocity of the last one."""
        worlds = Worlds(state.q.shape[:-1], index)
        part = self.take(worlds)
        short = part.with_scheme(self.integrator, self.solver, 0, part.step_size / parts)
        now = self.integrator.resized(short.scene.articulation, state.take(worlds), part.step_size, short.step_size)
        held = None if control is None else worlds.pick(control, 1)
        climbs: list[Solution] = []
        legs: list[Way] = []
        hazards = torch.zeros_like(now.hazards)
        for _ in range(parts):
            now, climb, _, leg = short.made(now, held)
            hazards = hazards | now.hazards
            climbs.append(climb)
            legs.append(leg)
        now = replaced(now, hazards=hazards)
        end = self.integrator.resized(short.scene.articulation, now, short.step_size, part.step_size)
        solved = torch.stack([x.solved for x in climbs]).all(0)
        worst = torch.stack([x.residual_norm for x in climbs]).amax(0)
        failed = torch.where(solved, climbs[-1].status, int(Status.STALLED))
        # an unfinished chain of short steps is no better end of the whole step, whatever its own residual
        climbs[-1] = dataclasses.replace(climbs[-1], status=failed, residual_norm=torch.where(solved, worst, math.inf))
        result = merged(solution, index, climbs, FALLBACKS.index("halving"), Status.HALVED)
        return put(advanced, end, worlds, solved), result, Detour(worlds, solved, self.integrator, tuple(legs))

    def rollout(
        self,
        state: S,
        controls: Tensor | None = None,
        steps: int | None = None,
        progress: Callable[[int], object] | None = None,
    ) -> Rollout:
        """Steps from `state` and records everything.

        controls: `[steps, *batch, nu]`, or None for zero control; then `steps` says how many. progress: called after every step
        with the number of steps done; it may raise KeyboardInterrupt, which ends the rollout early and keeps what was computed.
        Raises `ContactOverflowError`, which holds the steps done, where the scene asks for it."""
        count = self.scene.step_count(controls, steps)
        recorder = Recorder(self.scene, self.integrator, self.dt, state)
        try:
            for k in range(count):
                state, solution, objective = self._step(state, None if controls is None else controls[k])
                recorder.record(state, solution, objective)
                if progress is not None:
                    progress(k + 1)
        except KeyboardInterrupt:
            if recorder.steps == 0:
                raise
        except ContactOverflowError as error:
            error.rollout = recorder.finish() if recorder.steps else None
            raise
        return recorder.finish()


def _attempted(simulator: Simulator[Any], state: Any, control: Tensor | None) -> tuple[Any, Tensor]:
    end, solution, *_ = simulator.made(state, control)
    return end, solution.solved


T = TypeVar("T")


def put(whole: T, part: T, worlds: Worlds, kept: Tensor) -> T:
    """Values of a batch with those of some worlds replaced by `part`, where `kept` `[n]`: tensors, or states made of them."""

    def write(old: Tensor, new: Tensor) -> Tensor:
        rows = old.reshape(math.prod(worlds.batch), *old.shape[len(worlds.batch) :])
        before = rows[worlds.index]
        chosen = torch.where(kept.reshape(-1, *(1,) * (rows.ndim - 1)), new.reshape(before.shape), before)
        return rows.index_copy(0, worlds.index, chosen).reshape(old.shape)

    result: T = mapped(write, whole, part)
    return result
