"""Steps by the compiled core."""

from __future__ import annotations

import math
from collections.abc import Mapping
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
from pbfd_torch.native.descent import Back, Path
from pbfd_torch.native.library import library, reason
from pbfd_torch.native.not_compiled import NotCompiledError, unknown
from pbfd_torch.native.plan import Plan, planned, planned_with_derivatives
from pbfd_torch.native.recording import Record, Writer
from pbfd_torch.native.schemes import SCHEMES, Scheme
from pbfd_torch.native.stretch import Stretch
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.stepping.accuracy import Accuracy
from pbfd_torch.stepping.descending import Numbers, Pulled, Walked
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.stepping.stepper import SHORTEST_STEP, Solver
from pbfd_torch.stepping.way import Way
from pbfd_torch.tensors.plain import primal
from pbfd_torch.tensors.shapes import spread
from pbfd_torch.tensors.worlds import Worlds, replaced

KEPT_AT_ONCE = 16384  # steps of worlds: of how many it is kept for a moment how they were made, with all that it takes


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
        self._trust = trust
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
        return self.restored(state, journey.found, journey.other(state.time + self.step_size)), solution, way

    def run(self, state: S, controls: Tensor | None, steps: int) -> tuple[S, Solution]:
        """The states after each of so many steps, `[steps, *batch, ...]`, and how each was solved; see `stretch`."""
        stretch = self.stretch(state, controls, steps)
        return stretch.states, stretch.solution

    def stretch(self, state: S, controls: Tensor | None, steps: int) -> Stretch[S]:
        """So many steps of all worlds under controls `[steps, *, nu]`, or `[1, *, nu]` for all of them (None: zero)."""
        journey = self._went(state, controls, (steps,))
        other = journey.other(passed(state.time, self.step_size, steps)[1:])
        make = partial(self.restored, state)
        return Stretch(state.time, journey.given, journey.found, other, journey.solution, journey.frames, make)

    # followed back ----------------------------------------------------------------------------------------------------------
    @property
    def descends(self) -> bool:
        """See `Descending`: where bodies touch each other, what they touch with follows them in a way that the core does not write
        down, and explicit steps it follows nowhere."""
        return not self._core.plan.bodies.rows and self._trust == 0 and self._accuracy is None

    def fields(self, state: S) -> dict[str, Tensor]:
        """See `Descending`."""
        return self._scheme.fields(self.complete(state), self._core.plan)

    def precise(self, stepper: EagerStepper[S], plain: EagerStepper[S]) -> tuple[NativeStepper[S], Numbers] | None:
        """See `Descending`."""
        plan = planned_with_derivatives(stepper)
        if plan is None:
            return None
        numbers = Numbers(plan.real, plan.own, stepper.step_size)
        return NativeStepper(plain, self.threads, replaced(plan, real=primal(plan.real), own=primal(plan.own))), numbers

    def walk(self, state: S, controls: Tensor | None, steps: int) -> Walked:
        """See `Descending`."""
        start, journeys, worlds = state, list[Journey](), max(1, state.q[..., 0].numel())
        part = max(1, KEPT_AT_ONCE // worlds)
        one = controls is None or len(controls) == 1
        for first in range(0, steps, part):
            count = min(part, steps - first)
            held = controls if one or controls is None else controls[first : first + count]
            if journeys:
                found = {name: x[-1] for name, x in journeys[-1].found.items()}
                other = {name: x[-1] for name, x in journeys[-1].other(passed(state.time, self.step_size, part)[1:]).items()}
                state = self.restored(state, found, other)
            journeys.append(self._went(state, held, (count,), led=True))
        path = self._core.path(journeys, one)
        times = passed(start.time, self.step_size, steps)[1:]
        hazards = torch.cat([x.counted["hazards"] for x in journeys])
        solution = mapped(lambda *x: torch.cat(x), *(x.solution for x in journeys))
        return Walked(path.found, {"time": times, "hazards": hazards}, solution, path)

    def back(
        self,
        path: Path,
        seen: Mapping[str, Tensor | None],
        last: Mapping[str, Tensor] | None = None,
        constant: Tensor | None = None,
        dropped: bool = False,
        numbers: bool = False,
    ) -> Pulled:
        """See `Descending`."""
        plan, path = self._core.plan, path.precise()
        back = Back(path, last, len(plan.real) if numbers else 0)
        self._core.back(path, back, seen, constant, dropped)
        found = None
        if numbers:
            assert back.numbers is not None
            assert back.step_size is not None
            every, which = back.numbers.reshape(-1, len(plan.real)), plan.which.long()
            shared = every.sum(0).index_fill(0, which, 0.0)
            own = _summed(back.numbers[..., which], plan.own)
            found = Numbers(shared, own, _summed(back.step_size, self.step_size))
        return Pulled(back.by, back.control, found, back.singular > 0)

    def ahead(
        self,
        path: Path,
        start: Mapping[str, Tensor],
        control: Tensor,
        numbers: Numbers | None,
        constant: Tensor | None,
        dropped: bool,
    ) -> tuple[dict[str, Tensor], Tensor]:
        """See `Descending`."""
        plan, path = self._core.plan, path.precise()
        back = Back(path, {name: x[None] for name, x in start.items()}, len(plan.real) if numbers else 0)
        back.control[0] = control
        if numbers is not None:
            assert back.numbers is not None
            assert back.step_size is not None
            back.numbers[...] = numbers.shared
            back.numbers[..., plan.which.long()] = numbers.own
            back.step_size[...] = numbers.step_size
        found = {name: torch.zeros_like(x) for name, x in path.found.items()}
        self._core.ahead(path, back, found, constant, dropped)
        return found, back.singular > 0

    def _went(self, state: S, controls: Tensor | None, steps: tuple[int, ...], led: bool = False) -> Journey:
        """The states after steps, and how these were solved; led: and how each was made."""
        if controls is None:
            controls = state.q.new_zeros(1, self.scene.nu)
        return self._core.go(self.complete(state), spread(controls, state.q.shape[:-1]), steps, self._accuracy, led)

    def restored(self, state: S, found: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> S:
        """See `Descending`: of the core's fields and what else states have."""
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


def _summed(values: Tensor, like: Tensor) -> Tensor:
    """Values of each world, for what may be the same for several."""
    return values.sum_to_size(like.shape) if values.shape != like.shape else values


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
