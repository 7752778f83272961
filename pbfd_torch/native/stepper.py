"""Steps by the compiled core."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any, Generic, cast

import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective, blank_memory
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.bdf2 import Bdf2
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import Positions
from pbfd_torch.integrators.integrator import Integrator, S, fresh
from pbfd_torch.integrators.runge_kutta import RungeKutta
from pbfd_torch.integrators.variational import Variational
from pbfd_torch.native.carriers import passed
from pbfd_torch.native.core import Core, Journey, Terms
from pbfd_torch.native.library import library, reason
from pbfd_torch.native.not_compiled import NotCompiledError, unknown
from pbfd_torch.native.plan import Plan, planned
from pbfd_torch.native.recording import Record, Writer
from pbfd_torch.native.schemes import SCHEMES, Scheme
from pbfd_torch.native.stretch import Stretch
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.stepping.accuracy import Accuracy
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.stepping.stepper import SHORTEST_STEP, Solver
from pbfd_torch.stepping.way import Way
from pbfd_torch.tensors.worlds import Worlds, replaced


class NativeStepper(Generic[S]):
    """A `Stepper` whose steps the compiled core makes, fallbacks and all, of what an `EagerStepper` is made of. `threads`: at most,
    for batches that are worth it; None: as many as PyTorch uses. `plan`: of these steps, where it is known (`plan_of`). `accuracy`:
    the steps are frames, each of as many shorter ones as a world needs (`AdaptiveStepper`); nothing may move then but the bodies.
    Raises `InputError` where there is no core, and for a scene that it does not know, naming what it lacks (`uncovered`)."""

    def __init__(
        self,
        eager: EagerStepper[S],
        threads: int | None = None,
        plan: Plan | None = None,
        accuracy: Accuracy | None = None,
    ) -> None:
        try:
            plan = plan or plan_of(eager)
        except NotCompiledError as missing:
            raise InputError(f"no compiled steps: {missing}") from missing
        compiled = library()
        assert compiled is not None
        assert isinstance(eager.evaluations, int)
        self.eager = eager
        self._accuracy = accuracy
        self.threads = threads or torch.get_num_threads()
        scheme: object = eager.integrator
        surplus = scheme.surplus if isinstance(scheme, EnergyMomentum) else math.inf
        assert isinstance(eager.solver, Fallbacks)
        tolerance = eager.solver.direct.tolerance_for(eager.articulation.dtype)
        share = scheme.share if isinstance(scheme, Variational) else 1.0
        trust = scheme.trust if isinstance(scheme, RungeKutta) else 0.0
        jump = scheme.jump if isinstance(scheme, Bdf2) else math.inf
        halvings = eager.halvings
        while halvings and eager.dt / 2**halvings < SHORTEST_STEP:
            halvings -= 1
        terms = Terms(eager.step_size.detach(), halvings, tolerance, surplus, share, jump, eager.evaluations, trust)
        self._scheme: Scheme = SCHEMES[type(scheme)]
        self._core = Core(compiled, plan, self._scheme, terms, self.threads)

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process loads the core itself."""
        return NativeStepper, (self.eager, self.threads, self._core.plan, self._accuracy)

    @property
    def scene(self) -> Scene:
        """See `Stepper`."""
        return self.eager.scene

    @property
    def integrator(self) -> Integrator[S]:
        """See `Stepper`."""
        return self.eager.integrator

    @property
    def step_size(self) -> Tensor:
        """See `Stepper`."""
        return self.eager.step_size

    @property
    def dt(self) -> float:
        """See `Stepper`."""
        return self.eager.dt

    @property
    def solver(self) -> Solver:
        """See `Stepper`."""
        return self.eager.solver

    @property
    def halvings(self) -> int:
        """See `Stepper`."""
        return self.eager.halvings

    def initial_state(self, q: Tensor, v: Tensor, control: Tensor | None) -> S:
        """See `Stepper`."""
        batch = q.shape[:-1]
        controls = q.new_zeros(1, self.scene.nu) if control is None else control[None]
        journey, _ = self._core.start(q, v, spread(controls, batch))
        found = self._scheme.restored(journey.found, self._core.plan)
        return cast(S, self._scheme.state(**fresh(q) | found | {"memory": blank_memory(self.scene.terms, tuple(batch))}))

    def made(self, state: S, control: Tensor | None) -> tuple[S, Solution, Way]:
        """See `Stepper`. The way has no balance: records ask for it."""
        journey = self._went(state, None if control is None else control[None], ())
        solution, ways = journey.solution, journey.ways
        way = Way(solution.q) if ways is None else ways.way(self.integrator, solution.q)
        return self._restored(state, journey.found, journey.other(state.time + self.step_size)), solution, way

    def run(self, state: S, controls: Tensor | None, steps: int) -> tuple[S, Solution]:
        """The states after each of so many steps, `[steps, *batch, ...]`, and how each was solved; see `stretch`."""
        stretch = self.stretch(state, controls, steps)
        return stretch.states, stretch.solution

    def stretch(self, state: S, controls: Tensor | None, steps: int) -> Stretch[S]:
        """So many steps of all worlds under controls `[steps, *, nu]`, or `[1, *, nu]` for all of them (None: zero)."""
        journey = self._went(state, controls, (steps,))
        other = journey.other(passed(state.time, self.step_size, steps)[1:])
        make = partial(self._restored, state)
        return Stretch(state.time, journey.given, journey.found, other, journey.solution, journey.frames, make)

    def _went(self, state: S, controls: Tensor | None, steps: tuple[int, ...]) -> Journey:
        """The states after steps, and how these were solved."""
        if controls is None:
            controls = state.q.new_zeros(1, self.scene.nu)
        return self._core.go(self.complete(state), spread(controls, state.q.shape[:-1]), steps, self._accuracy)

    def _restored(self, state: S, found: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> S:
        """The states after steps from a state, of the core's fields and what else they have."""
        plan = self._core.plan
        fields, memory, time = self._scheme.restored(dict(found), plan), state.memory, other["time"]
        if plan.remembered:
            whole = fields["memory"]
            memory = tuple(whole[..., first : first + n * width].unflatten(-1, (n, width)) for first, n, width in plan.memory)
        elif time.ndim > state.time.ndim:  # there is nothing in it
            memory = tuple(x.expand(len(time), *x.shape) for x in memory)
        return replaced(state, **fields | {"pace": None} | dict(other) | {"memory": memory})

    def complete(self, state: S) -> S:
        """With zero for an acceleration that is not known, and anchors where there is nothing in the memory yet."""
        batch = state.q.shape[:-1]
        if self._core.plan.remembered and not state.memory:
            state = replaced(state, memory=blank_memory(self.eager.terms, batch))
        if not isinstance(state, Positions) or state.acceleration is not None:
            return state
        return replaced(state, acceleration=state.q.new_zeros(*batch, self.scene.articulation.nv))

    def record(self, state: S, steps: int) -> Record[S]:
        """An empty record from a state on, with room for so many steps."""
        return Record(self._writer, self.complete(state), steps)

    @cached_property
    def _writer(self) -> Writer[S]:
        compiled = library()
        assert compiled is not None
        return Writer(compiled, self.eager, self._core.plan, self.threads)

    @property
    def moving(self) -> bool:
        """Whether obstacles move."""
        return len(self._core.plan.carriers) > 0

    def framed(self, accuracy: Accuracy) -> NativeStepper[S]:
        """The same whose steps are frames."""
        return NativeStepper(self.eager, self.threads, self._core.plan, accuracy)

    def objective(self, state: S, control: Tensor | None) -> BalanceObjective:
        """See `Stepper`."""
        return self.eager.objective(state, control)

    def take(self, worlds: Worlds) -> NativeStepper[S]:
        """See `Stepper`: to the bit what they do among all."""
        return NativeStepper(self.eager.take(worlds), self.threads, self._core.plan.take(worlds), self._accuracy)

    def sized(self, step_size: Tensor) -> NativeStepper[S]:
        """See `Stepper`."""
        return NativeStepper(self.eager.sized(step_size), self.threads, self._core.plan, self._accuracy)


def uncovered(eager: EagerStepper[Any]) -> str:
    """Why the compiled core cannot make these steps, in words; nothing where it can."""
    try:
        plan_of(eager)
    except NotCompiledError as missing:
        return str(missing)
    return ""


def plan_of(eager: EagerStepper[Any]) -> Plan:
    """The plan of steps that the core can make. Raises `NotCompiledError` for others, and where there is no core."""
    if library() is None:
        raise NotCompiledError(reason())
    solver = eager.solver
    if not isinstance(solver, Fallbacks) or solver != Fallbacks.within(solver.direct.tolerance):
        raise NotCompiledError("the core does not know a solver other than the default one, to any tolerance")
    if type(eager.integrator) not in SCHEMES:
        raise unknown(f"integrator {type(eager.integrator).__name__}")
    return planned(eager)


def spread(controls: Tensor, batch: Sequence[int]) -> Tensor:
    """Controls `[steps, *, nu]`, given for all worlds or for some dimensions of the batch, as `[steps, *batch, nu]`."""
    missing = len(batch) + 2 - controls.ndim
    if missing == 0 and controls.shape[1:-1] == batch:
        return controls
    return controls.reshape(len(controls), *(1,) * missing, *controls.shape[1:]).expand(len(controls), *batch, controls.shape[-1])
