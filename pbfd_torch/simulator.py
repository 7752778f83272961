"""Scene and simulator: one step, and a rollout, for any batch of worlds at once."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, Self, TypeVar, cast

import torch
from torch import Tensor

from pbfd_torch.articulation import Articulation, force_scale
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Collider
from pbfd_torch.dynamics import bias_force, kinetic_energy, mass_matrix, potential_energy, rotor_energy
from pbfd_torch.errors import ContactOverflowError, InputError, ModelError
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator, S, Trial, calm
from pbfd_torch.kinematics import Motion, Placement, place
from pbfd_torch.objective import BalanceObjective, blank_memory
from pbfd_torch.recording import Recorder
from pbfd_torch.rollout import Rollout
from pbfd_torch.solvers.fallbacks import Fallbacks, merged
from pbfd_torch.solvers.objective import FALLBACKS, Relaxable, Solution, Status, unsolved_worlds
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Conservative, Term
from pbfd_torch.worlds import Worlds, replaced

SHORTEST_STEP = 1e-5  # [s]


class Solver(Protocol):
    """What finds the end of a step."""

    def solve(self, objective: Relaxable, guess: Tensor, retreat: Tensor | None = None) -> Solution:
        """Root of the objective for every world, from `guess`, or from `retreat` where that is the safer start."""
        ...


@dataclass(frozen=True, eq=False)
class Scene:
    """An articulation, everything that acts on it, and where it is. What is not in `terms` costs nothing.

    Attributes:
        articulation: the bodies.
        terms: physical effects; `Inertia()` must be among them.
        gravity: `[3]` or `[*batch, 3]` [m/s²].
        colliders, obstacles: geometry, for pictures and records; the contact terms hold what they need of it.
        name: for records.
    """

    articulation: Articulation
    terms: Sequence[Term]
    gravity: Tensor
    colliders: Sequence[Collider] = ()
    obstacles: Sequence[HalfSpace | Obstacle] = ()
    name: str = "scene"

    def __post_init__(self) -> None:
        a = self.articulation
        if not any(isinstance(term, Inertia) for term in self.terms):
            raise InputError("terms hold no Inertia(): nothing would resist the forces")
        if self.gravity.shape[-1:] != (3,) or not bool(torch.isfinite(self.gravity).all()):
            raise InputError(f"gravity is {self.gravity.tolist()}: must be finite with last dimension 3")
        if self.gravity.dtype != a.dtype or self.gravity.device != a.device:
            raise InputError(f"gravity is {self.gravity.dtype} on {self.gravity.device}: must be {a.dtype} on {a.device}")
        inertia = mass_matrix(a, a.rest, self.terms).detach().diagonal(dim1=-2, dim2=-1).reshape(-1, a.nv).amin(0)
        for i, joint in enumerate(a.topology.dof_joints):
            if not float(inertia[i]) > 0:
                raise ModelError(
                    "nothing that it moves has any inertia about its axis, and it has no armature",
                    element=f"joint '{a.joint_names[joint]}'",
                )

    def potential_energy(self, placement: Placement, time: Tensor) -> Tensor:
        """Stored energy [J] `[*batch]` at a time [s]: gravity, springs, limits and the contacts' normal forces."""
        total = potential_energy(placement, self.gravity)
        for term in self.terms:
            if isinstance(term, Conservative):
                total = total + term.potential(placement, time)
        return total

    def energy(self, q: Tensor, v: Tensor) -> Tensor:
        """Kinetic plus stored energy [J] `[*batch]` at time 0, at q `[*batch, nq]` and velocity v `[*batch, nv]`."""
        placement = place(self.articulation, q)
        rates = Motion(placement, v).rates
        return (
            kinetic_energy(self.articulation, rates)
            + rotor_energy(self.articulation, v, self.terms)
            + self.potential_energy(placement, torch.zeros_like(q[..., 0]))
        )

    @property
    def nu(self) -> int:
        """Length of the control vector."""
        return sum(term.nu for term in self.terms if isinstance(term, Actuators))

    def placed(self, q: Tensor | None, v: Tensor | None) -> tuple[Tensor, Tensor]:
        """Configuration `[*batch, nq]` and velocity `[*batch, nv]` of all worlds, quaternions at unit norm, from those given for
        one or for all; None: the rest configuration, and rest. Raises `InputError` for wrong shapes, dtypes, devices or NaN."""
        a = self.articulation
        q = a.rest if q is None else self._checked(q, a.nq, "q")
        v = q.new_zeros((*q.shape[:-1], a.nv)) if v is None else self._checked(v, a.nv, "v")
        parameters = (self.gravity.shape[:-1], a.pseudo_inertia.shape[:-3], place(a, a.rest).poses.shape[:-3])
        batch = torch.broadcast_shapes(q.shape[:-1], v.shape[:-1], *parameters)
        return a.topology.normalized(q.expand(*batch, a.nq)), v.expand(*batch, a.nv)

    def _checked(self, value: Tensor, length: int, name: str) -> Tensor:
        a = self.articulation
        if value.ndim == 0 or value.shape[-1] != length:
            raise InputError(f"{name} has shape {tuple(value.shape)}: must end in ({length},)")
        if value.dtype != a.dtype or value.device != a.device:
            raise InputError(f"{name} is {value.dtype} on {value.device}: must be {a.dtype} on {a.device}")
        if not bool(torch.isfinite(value).all()):
            raise InputError(f"{name} holds NaN or infinity")
        return value

    def step_count(self, controls: Tensor | None, steps: int | None) -> int:
        """Of a rollout with these controls, or without any; raises `InputError` where the two do not agree."""
        if controls is None:
            if steps is None or steps < 1:
                raise InputError(f"steps is {steps}: must be ≥ 1 where there are no controls")
            return steps
        if controls.ndim < 2 or controls.shape[-1] != self.nu or len(controls) == 0:
            raise InputError(f"controls have shape {tuple(controls.shape)}: must be [steps ≥ 1, *batch, {self.nu}]")
        if steps is not None and steps != len(controls):
            raise InputError(f"steps is {steps} but there are {len(controls)} controls: give one of the two")
        return len(controls)

    def take(self, worlds: Worlds) -> Scene:
        """The same scene with the parameters of some worlds."""
        terms = tuple(term.take(worlds) for term in self.terms)
        return replaced(self, articulation=self.articulation.take(worlds), terms=terms, gravity=worlds.pick(self.gravity, 1))


class Simulator(Generic[S]):
    """Steps a scene.

    `dt`: step [s] > 0; smaller than 1e-5 is refused because rounding would dominate the positions' differences. `halvings`: how
    often a world's step may be halved (2, 4, 8 … shorter steps) where nothing else solves it; 0: never."""

    def __init__(
        self,
        scene: Scene,
        dt: float,
        integrator: Integrator[S] | None = None,
        solver: Solver | None = None,
        halvings: int = 3,
    ) -> None:
        if not (math.isfinite(dt) and dt >= SHORTEST_STEP):
            raise InputError(f"dt is {dt} s: must be a finite number ≥ 1e-5")
        if halvings < 0:
            raise InputError(f"halvings is {halvings}: must be ≥ 0")
        a = scene.articulation
        self.scene = scene
        self.dt = float(dt)
        self.integrator: Integrator[S] = integrator or cast(Integrator[S], EnergyMomentum())
        self.solver: Solver = solver or Fallbacks()
        self.halvings = halvings
        self.step_size = torch.tensor(dt, dtype=a.dtype, device=a.device)
        self._terms = self.integrator.adapted(a, scene.terms, self.step_size)
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
        start = self.integrator.start(self, q, v, control)
        return replaced(start, memory=blank_memory(self.scene.terms, tuple(q.shape[:-1])))

    @property
    def articulation(self) -> Articulation:
        return self.scene.articulation

    def trial(self, q: Tensor, v: Tensor, control: Tensor | None) -> Trial:
        """A step of implicit Euler from q `[*batch, nq]` with v `[*batch, nv]`."""
        a, scheme = self.articulation, ImplicitEuler()
        simulator = Simulator(self.scene, self.dt, scheme, self.solver, self.halvings)
        start = scheme.at_rate(a, q, v, torch.zeros_like(v), self.step_size)
        end, solution = simulator.step(start, control)
        objective = simulator.objective(start, control)
        abrupt, others = objective.forces(end.q)
        others = others - bias_force(a, q, v, self.scene.gravity)
        columns, _ = torch.linalg.solve_ex(mass_matrix(a, q, self.scene.terms), torch.stack((abrupt, others), -1))
        by_abrupt, by_others = columns.unbind(-1)
        # an impact within the step has given nothing before it
        steady = calm(objective, objective.step.previous, self.step_size[..., None] * by_abrupt)
        acceleration = by_others + torch.where(steady[..., None], by_abrupt, 0.0)
        solved = solution.solved
        return Trial(end.q, torch.where(solved[..., None], acceleration, 0.0), solved)

    def objective(self, state: S, control: Tensor | None = None) -> BalanceObjective:
        """The balance of forces that the step from `state` solves."""
        articulation = self.scene.articulation
        context = self.integrator.context(articulation, state, self.step_size, self.scene.gravity, control)
        return BalanceObjective.of_step(articulation, self._terms, context, self._scale, state.memory)

    def step(self, state: S, control: Tensor | None = None) -> tuple[S, Solution]:
        """One step of all worlds under `control` `[*batch, nu]` (None: zero). Never raises for one bad world: see the solution's
        status. An unsolved world goes on from the best point found."""
        advanced, solution, _ = self._step(state, control)
        return advanced, solution

    def _step(self, state: S, control: Tensor | None) -> tuple[S, Solution, BalanceObjective]:
        with torch.no_grad():
            objective = self.objective(state, control)
            solution = self.first_solver.solve(objective, objective.guess, state.q)
            advanced, refused = self.integrator.advance(objective, state, solution.q)
            return *self.finished(state, control, advanced, solution, refused), objective

    def finished(
        self, state: S, control: Tensor | None, advanced: S, solution: Solution, refused: Tensor | None
    ) -> tuple[S, Solution]:
        """The state after a step that the solver has left at `solution`, from which the integrator would go on to `advanced`:
        worlds that are unsolved or refused try easier steps, and those that still are unsolved shorter ones."""
        if refused is not None:
            status = torch.where(refused & solution.solved, int(Status.STALLED), solution.status)
            solution = dataclasses.replace(solution, status=status.to(torch.int32))
        easier = self.integrator.easier
        index = unsolved_worlds(solution)
        if len(index) and easier and self._may_halve(1):
            index = index[self.integrator.halves(self.objective(state, control), solution.q).reshape(-1)[index]]
            if len(index):
                advanced, solution = self._halved(state, control, advanced, solution, index, 2)
        for k, scheme in enumerate(easier):
            index = unsolved_worlds(solution)
            if len(index) == 0:
                break
            # detours for the last one only: what comes before is tried for its accuracy
            solver = self.solver if k == len(easier) - 1 else self.first_solver
            advanced, solution = self._eased(state, control, advanced, solution, index, scheme, solver)
        for halvings in range(1, self.halvings + 1):
            index = unsolved_worlds(solution)
            if len(index) == 0 or not self._may_halve(halvings):
                break
            advanced, solution = self._halved(state, control, advanced, solution, index, 2**halvings)
        return advanced, solution

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
        return self._as(self.integrator, self.solver, self.halvings, step_size)

    def _as(self, integrator: Integrator[S], solver: Solver, halvings: int, step_size: Tensor) -> Simulator[S]:
        other = copy.copy(self)
        other.integrator, other.solver, other.halvings = integrator, solver, halvings
        other.step_size, other.dt = step_size, float(step_size.min())
        other._terms = integrator.adapted(self.articulation, self.scene.terms, step_size)
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
    ) -> tuple[S, Solution]:
        """The step of the worlds at `index` again, as one of another integrator; they keep the result whether it is solved or
        not."""
        worlds = Worlds(state.q.shape[:-1], index)
        part = self.take(worlds)
        other = part._as(easier, solver, 0, part.step_size)
        before, held = state.take(worlds), None if control is None else worlds.pick(control, 1)
        objective = other.objective(before, held)
        found = other.solver.solve(objective, objective.guess, before.q)
        lost = torch.where(solution.solved, solution.residual_norm, math.inf)
        result = merged(
            dataclasses.replace(solution, residual_norm=lost), index, [found], FALLBACKS.index("easier step"), Status.EASED
        )
        eased, _ = other.integrator.advance(objective, before, found.q)
        return put(advanced, eased, worlds, torch.isfinite(found.residual_norm)), result

    def _halved(
        self, state: S, control: Tensor | None, advanced: S, solution: Solution, index: Tensor, parts: int
    ) -> tuple[S, Solution]:
        """The step of the worlds at `index` again, as `parts` shorter ones; a world keeps the result if all of them solve. It then
        goes on with the velocity of the last one."""
        worlds = Worlds(state.q.shape[:-1], index)
        part = self.take(worlds)
        short = part._as(self.integrator, self.solver, 0, part.step_size / parts)
        now = self.integrator.resized(short.scene.articulation, state.take(worlds), part.step_size, short.step_size)
        held = None if control is None else worlds.pick(control, 1)
        climbs: list[Solution] = []
        hazards = torch.zeros_like(now.hazards)
        for _ in range(parts):
            now, climb = short.step(now, held)
            hazards = hazards | now.hazards
            climbs.append(climb)
        now = replaced(now, hazards=hazards)
        end = self.integrator.resized(short.scene.articulation, now, short.step_size, part.step_size)
        solved = torch.stack([x.solved for x in climbs]).all(0)
        worst = torch.stack([x.residual_norm for x in climbs]).amax(0)
        failed = torch.where(solved, climbs[-1].status, int(Status.STALLED))
        # an unfinished chain of short steps is no better end of the whole step, whatever its own residual
        climbs[-1] = dataclasses.replace(climbs[-1], status=failed, residual_norm=torch.where(solved, worst, math.inf))
        result = merged(solution, index, climbs, FALLBACKS.index("halving"), Status.HALVED)
        return put(advanced, end, worlds, solved), result

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
