"""The step in PyTorch: the readable reference, and what every other engine is judged by."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, Generic, Self, TypeVar, cast

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import bias_force, kinetic_energy, mass_matrix
from pbfd_torch.balance.objective import BalanceObjective, blank_memory
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator, Leaping, S, State, Trial, calm
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import Fallbacks, doubted, merged
from pbfd_torch.solvers.linear import solved_positive
from pbfd_torch.solvers.objective import FALLBACKS, Solution, Status
from pbfd_torch.stepping.standstill import arrived, departing
from pbfd_torch.stepping.stepper import LONGEST_STEP, SHORTEST_STEP, Solver
from pbfd_torch.stepping.way import Detour, Way
from pbfd_torch.stepping.worlds import put
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.load import Term
from pbfd_torch.tree.articulation import Articulation, force_scale
from pbfd_torch.tree.kinematics import Motion

R = TypeVar("R", bound=State)
MOST_EVALUATIONS, FEWEST_EVALUATIONS = 5000, 200
Attempt = Callable[["EagerStepper[Any]", Any, Tensor | None], tuple[Any, Tensor]]
"""Makes a step and says where it ended and which worlds `[*batch]` it solved."""


class EagerStepper(Generic[S]):
    """A `Stepper` whose every operation is one of PyTorch's.

    `scene`, `integrator` (None: `EnergyMomentum`), `solver` (None: `Fallbacks`): what it is made of. `dt`: step [s] from 1e-5 to
    100, a number or a scalar tensor; rounding would dominate the positions' differences of shorter ones. `halvings` ≥ 0: how often
    a world's step may be halved (2, 4, 8 … shorter steps) where nothing else solves it. `evaluations` ≥ 200: what a world may spend
    on a step, with all that is tried; the solver's own limit is one of each of its attempts. Raises `InputError` for a step,
    halvings or evaluations out of range.

    `terms`: the scene's as they act in a step. `scale`: `[*batch, nv]`, see `force_scale`."""

    def __init__(
        self,
        scene: Scene,
        dt: float | Tensor,
        integrator: Integrator[S] | None = None,
        solver: Solver | None = None,
        halvings: int = 3,
        evaluations: int = MOST_EVALUATIONS,
    ) -> None:
        step = float(dt.detach()) if isinstance(dt, Tensor) else dt
        if not SHORTEST_STEP <= step <= LONGEST_STEP:
            raise InputError(f"dt is {step} s: must be a number ≥ 1e-5 and ≤ {LONGEST_STEP:g}")
        if halvings < 0:
            raise InputError(f"halvings is {halvings}: must be ≥ 0")
        if evaluations < FEWEST_EVALUATIONS:
            raise InputError(f"evaluations is {evaluations}: must be ≥ {FEWEST_EVALUATIONS}")
        a = scene.articulation
        self.scene = scene
        self.integrator: Integrator[S] = integrator or cast(Integrator[S], EnergyMomentum())
        self.solver: Solver = solver or Fallbacks()
        self.halvings = halvings
        self.evaluations: int | Tensor = evaluations
        self._dt: float | None = float(step)
        self.step_size = torch.as_tensor(dt, dtype=a.dtype, device=a.device)
        with torch.no_grad():
            self.terms: Sequence[Term] = self.integrator.adapted(a, scene.terms, self.step_size)
        self.scale = _scale(scene)
        self._attempt: Attempt = _attempted

    @property
    def articulation(self) -> Articulation:
        return self.scene.articulation

    @property
    def dt(self) -> float:
        """See `Stepper`. Read off the tensor where it must be, and only when asked for: a device makes the host wait for it."""
        if self._dt is None:
            self._dt = float(self.step_size.detach().min())
        return self._dt

    # variants -------------------------------------------------------------------------------------------------------------
    def changed(self, **changes: Any) -> Self:
        """The same with other values of some attributes, which are taken as they are."""
        other = copy.copy(self)
        vars(other).update(changes)
        if "step_size" in changes:
            other._dt = None
        return other

    def take(self, worlds: Worlds) -> Self:
        """See `Stepper`."""
        return self.changed(
            scene=self.scene.take(worlds),
            terms=[term.take(worlds) for term in self.terms],
            scale=worlds.pick(self.scale, 1),
            step_size=worlds.pick(self.step_size, 0),
            evaluations=worlds.pick(self.evaluations, 0),
        )

    def sized(self, step_size: Tensor) -> EagerStepper[S]:
        """See `Stepper`."""
        return self.with_scheme(self.integrator, self.solver, self.halvings, step_size)

    def with_scheme(self, integrator: Integrator[R], solver: Solver, halvings: int, step_size: Tensor) -> EagerStepper[R]:
        """The same scene with another integrator and other steps [s] `[]` or `[*batch]`."""
        terms = integrator.adapted(self.articulation, self.scene.terms, step_size)
        other = self.changed(integrator=integrator, solver=solver, halvings=halvings, step_size=step_size, terms=terms)
        return cast(EagerStepper[R], other)

    def with_scene(self, scene: Scene) -> Self:
        """The same steps of the same scene with other numbers."""
        terms = self.integrator.adapted(scene.articulation, scene.terms, self.step_size)
        return self.changed(scene=scene, terms=terms, scale=_scale(scene))

    def with_attempt(self, attempt: Attempt) -> Self:
        """The same whose trial steps are made by `attempt`."""
        return self.changed(_attempt=attempt)

    # the start ------------------------------------------------------------------------------------------------------------
    def initial_state(self, q: Tensor, v: Tensor, control: Tensor | None) -> S:
        """See `Stepper`. Of second order; of first order in a world whose trial step is unsolved, if the integrator needs one."""
        start = self.integrator.start(self, q, v, control)
        return replaced(start, memory=blank_memory(self.scene.terms, tuple(q.shape[:-1])))

    def trial(self, q: Tensor, v: Tensor, control: Tensor | None) -> Trial:
        """A step of implicit Euler from q `[*batch, nq]` with v `[*batch, nv]`."""
        a, scheme = self.articulation, ImplicitEuler()
        stepper = self.with_scheme(scheme, self.solver, self.halvings, self.step_size)
        start = scheme.at_rate(a, q, v, torch.zeros_like(v), self.step_size)
        end, solved = self._attempt(stepper, start, control)
        objective = stepper.objective(start, control)
        abrupt, others = objective.forces(end.q)
        others = others - bias_force(a, q, v, self.scene.gravity)
        columns = solved_positive(mass_matrix(a, q, self.scene.terms), torch.stack((abrupt, others), -1))
        by_abrupt, by_others = columns.unbind(-1)
        # an impact within the step has given nothing before it; what holds the others back has, however hard they press
        now, h = objective.step.previous, self.step_size[..., None]
        alone, together = (kinetic_energy(a, Motion(now, h * x).rates) for x in (by_others, by_others + by_abrupt))
        steady = calm(objective, now, h * by_abrupt) | (together <= alone)
        acceleration = by_others + torch.where(steady[..., None], by_abrupt, 0.0)
        return Trial(end.q, torch.where(solved[..., None], acceleration, 0.0), solved)

    # the step -------------------------------------------------------------------------------------------------------------
    def objective(self, state: S, control: Tensor | None = None) -> BalanceObjective:
        """The balance of forces that the step from `state` solves."""
        a = self.articulation
        context = self.integrator.context(a, state, self.step_size, self.scene.gravity, control)
        return BalanceObjective.of_step(a, self.terms, context, self.scale, state.memory)

    @property
    def first_solver(self) -> Solver:
        """What a step is given to first. Where there is an easier step, it is given up soon; detours come later, if at all."""
        if not isinstance(self.solver, Fallbacks):
            return self.solver
        return self.solver.brisk if self.integrator.easier else self.solver.direct

    def made(self, state: S, control: Tensor | None) -> tuple[S, Solution, Way]:
        """See `Stepper`."""
        with torch.no_grad():
            start = self.departing(state, control)
            objective = self.objective(start, control)
            if isinstance(self.integrator, Leaping):
                advanced, solution, way = self._leapt(self.integrator, objective, start, control)
                return *self.arrived(state, advanced, solution), way
            solution = self.first_solver.solve(objective, objective.guess, start.q)
            advanced, refusal = self.integrator.advance(objective, start, solution.q)
            refused = None if refusal is None else refusal()
            advanced, solution, way = self.finished(objective, start, control, solution, advanced, refused)
            return *self.arrived(state, advanced, solution), way

    def _leapt(
        self, integrator: Leaping[S], objective: BalanceObjective, state: S, control: Tensor | None
    ) -> tuple[S, Solution, Way]:
        """The explicit step, and that of the other scheme in the worlds that may not make it."""
        leap = integrator.leap(self.scene.terms, objective, state)
        none = torch.zeros_like(leap.error)
        count = leap.evaluations
        advanced, q = leap.end, leap.end.q
        solution = Solution(
            q=q,
            status=torch.full_like(count, int(Status.EXPLICIT)),
            residual_norm=none,
            iterations=torch.zeros_like(count),
            evaluations=count,
            fallbacks=count.new_zeros((*count.shape, len(FALLBACKS))),
            estimate=leap.error,
            strike=leap.strike,
        )
        index = (~leap.kept).reshape(-1).nonzero().squeeze(-1)
        if len(index) == 0:
            return advanced, solution, Way(q, (), objective, explicit=True)
        worlds, other = Worlds(tuple(count.shape), index), integrator.otherwise
        everywhere = torch.ones_like(index, dtype=torch.bool)
        part = self.take(worlds).changed(integrator=other)
        end, found, leg = part.made(state.take(worlds), None if control is None else worlds.pick(control, 1))
        found = dataclasses.replace(
            found,
            evaluations=found.evaluations + worlds.rows(count),
            estimate=torch.zeros_like(end.time),
            strike=worlds.rows(leap.strike),
        )
        whole = put(dataclasses.replace(solution, lanes=0), dataclasses.replace(found, lanes=0), worlds, everywhere)
        solution = dataclasses.replace(whole, lanes=leap.stages * count.numel() + found.lanes)
        detour = Detour(worlds, everywhere, other, (leg.kept(),))
        return put(advanced, end, worlds, everywhere), solution, Way(q, (detour,), objective, explicit=True)

    def departing(self, state: S, control: Tensor | None) -> S:
        """The state with NaN for the configuration of worlds that are to stand still in its step; see `stepping.standstill`."""
        return departing(self.articulation, self.integrator, state, self.step_size, control)

    def arrived(self, state: S, advanced: S, solution: Solution) -> tuple[S, Solution]:
        """The end of the step from a state, with worlds that got lost back in that state; see `stepping.standstill`."""
        return arrived(self.articulation, self.integrator, state, self.step_size, advanced, solution)

    def finished(
        self,
        objective: BalanceObjective,
        state: S,
        control: Tensor | None,
        solution: Solution,
        advanced: S,
        refused: Tensor | None,
    ) -> tuple[S, Solution, Way]:
        """The rest of a step that the first solver has left at `solution`, from which the integrator would go on to `advanced` but
        for the worlds that it has refused `[*batch]`: these and the unsolved ones are led along detours or try easier steps, and
        those that still are unsolved shorter ones."""
        if isinstance(self.solver, Fallbacks):
            solution = doubted(objective, solution)
        arrived = solution.solved
        if refused is not None:
            solution = solution.marked(refused & solution.solved, Status.STALLED)
        index = solution.unsolved  # the only question of a step that is solved: a device makes the host wait for it
        if len(index) == 0:
            return advanced, solution, Way(solution.q, (), objective)
        easier = self.integrator.easier
        if not easier and isinstance(self.solver, Fallbacks):
            solution = self.solver.rescued(objective, solution, objective.guess, state.q, self.evaluations)
            advanced, _ = self.integrator.advance(objective, state, solution.q)  # what is refused still has found nothing better
        q = solution.q
        detours: list[Detour] = []
        wanted = self.integrator.halves(objective, advanced, arrived).reshape(-1) if easier else None
        for halvings in range(1, self.halvings + 1):
            if wanted is None or not self._may_halve(halvings):
                break
            index = self._halvable(solution, solution.unsolved[wanted[solution.unsolved] >= halvings], 2**halvings)
            if len(index) == 0:
                break
            # as long as still shorter steps are to be tried, none of these may be an easier one
            easy = wanted[index] == halvings
            advanced, solution, detour = self._halved(state, control, advanced, solution, index, 2**halvings, easy)
            detours.append(detour)
        for k, scheme in enumerate(easier):
            # detours for the last one only: what comes before is tried for its accuracy
            solver = self.solver if k == len(easier) - 1 else self.first_solver
            index = solution.within(self.evaluations, _attempt_of(solver))
            if len(index) == 0:
                break
            advanced, solution, detour = self._eased(state, control, advanced, solution, index, scheme, solver)
            detours.append(detour)
        for halvings in range(1, self.halvings + 1):
            if not self._may_halve(halvings):
                break
            index = self._halvable(solution, solution.unsolved, 2**halvings)
            if len(index) == 0:
                break
            advanced, solution, detour = self._halved(state, control, advanced, solution, index, 2**halvings)
            detours.append(detour)
        if not easier and isinstance(self.solver, Fallbacks):
            solution = self.solver.accepted(solution)
        return advanced, solution, Way(q, tuple(detours), objective)

    def _halvable(self, solution: Solution, index: Tensor, parts: int) -> Tensor:
        """Which of these worlds can afford the first attempt at each of so many shorter steps."""
        return solution.within(self.evaluations, parts * _attempt_of(self.first_solver), index)

    def _left(self, solution: Solution, worlds: Worlds) -> Tensor:
        """Evaluations that these worlds may spend yet."""
        return worlds.rows(self.evaluations - solution.evaluations)

    def _may_halve(self, times: int) -> bool:
        return times <= self.halvings and self.dt / 2**times >= SHORTEST_STEP

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
        budgeted = {"budget": self._left(solution, worlds)} if isinstance(solver, Fallbacks) else {}
        found = solver.solve(objective, objective.guess, before.q, **budgeted)
        lost = torch.where(solution.solved, solution.residual_norm, math.inf)
        result = merged(
            dataclasses.replace(solution, residual_norm=lost), index, [found], FALLBACKS.index("easier step"), Status.EASED
        )
        eased, _ = other.integrator.advance(objective, before, found.q)
        kept = torch.isfinite(found.residual_norm)
        return put(advanced, eased, worlds, kept), result, Detour(worlds, kept, easier, (Way(found.q),))

    def _halved(
        self,
        state: S,
        control: Tensor | None,
        advanced: S,
        solution: Solution,
        index: Tensor,
        parts: int,
        easy: Tensor | None = None,
    ) -> tuple[S, Solution, Detour]:
        """The step of the worlds at `index` again, as `parts` shorter ones; a world keeps the result if all of them solve. It then
        goes on with the velocity of the last one. easy: `[n]` bool, in which worlds these may be steps of another integrator; None:
        in all."""
        worlds = Worlds(state.q.shape[:-1], index)
        part = self.take(worlds)
        left = (self._left(solution, worlds) // parts).to(torch.int32)
        short = part.with_scheme(self.integrator, self.solver, 0, part.step_size / parts).changed(evaluations=left)
        now = self.integrator.resized(short.articulation, state.take(worlds), part.step_size, short.step_size)
        held = None if control is None else worlds.pick(control, 1)
        climbs: list[Solution] = []
        legs: list[Way] = []
        hazards = torch.zeros_like(now.hazards)
        for _ in range(parts):
            now, climb, leg = short.made(now, held)
            hazards = hazards | now.hazards
            climbs.append(climb)
            legs.append(leg.kept())
        now = replaced(now, hazards=hazards)
        end = self.integrator.resized(short.articulation, now, short.step_size, part.step_size)
        solved = torch.stack([x.solved for x in climbs]).all(0)
        if easy is not None:
            solved = solved & (easy | torch.stack([x.status != int(Status.EASED) for x in climbs]).all(0))
        worst = torch.stack([x.residual_norm for x in climbs]).amax(0)
        failed = torch.where(solved, climbs[-1].status, int(Status.STALLED))
        # an unfinished chain of short steps is no better end of the whole step, whatever its own residual
        climbs[-1] = dataclasses.replace(climbs[-1], status=failed, residual_norm=torch.where(solved, worst, math.inf))
        result = merged(solution, index, climbs, FALLBACKS.index("halving"), Status.HALVED)
        return put(advanced, end, worlds, solved), result, Detour(worlds, solved, self.integrator, tuple(legs))


def _attempt_of(solver: Solver) -> int:
    """Evaluations that the first attempt of a solver may take."""
    direct = solver.direct if isinstance(solver, Fallbacks) else solver
    return direct.max_evaluations if isinstance(direct, Descent) else 0


def _scale(scene: Scene) -> Tensor:
    return force_scale(scene.articulation, torch.linalg.vector_norm(scene.gravity, dim=-1))


def _attempted(stepper: EagerStepper[Any], state: Any, control: Tensor | None) -> tuple[Any, Tensor]:
    end, solution, _ = stepper.made(state, control)
    return end, solution.solved
