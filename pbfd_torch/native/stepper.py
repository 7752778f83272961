"""Steps by the compiled core. What it leaves unsolved or refuses is led on in PyTorch, by the same detours and easier steps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.energy_momentum import EnergyMomentum, Velocities
from pbfd_torch.native.core import Core, Journey, Terms
from pbfd_torch.native.library import library, reason
from pbfd_torch.native.not_compiled import NotCompiledError
from pbfd_torch.native.plan import Plan, planned
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import chosen, mapped
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.stepping.stepper import Solver
from pbfd_torch.stepping.way import Way
from pbfd_torch.tensors.worlds import Worlds, replaced


class NativeStepper:
    """A `Stepper` whose steps the compiled core makes, of what an `EagerStepper` is made of. `threads`: at most, for batches that
    are worth it; None: as many as PyTorch uses. Raises `InputError` where there is no core, and for a scene that it does not know,
    naming what it lacks (`uncovered`)."""

    def __init__(self, eager: EagerStepper[Velocities], threads: int | None = None) -> None:
        try:
            plan = _planned(eager)
        except NotCompiledError as missing:
            raise InputError(f"no compiled steps: {missing}") from missing
        compiled = library()
        assert compiled is not None
        self.eager = eager
        self.threads = threads or torch.get_num_threads()
        self._core = Core(compiled, plan, self.threads)
        direct = eager.first_solver
        assert isinstance(direct, Descent)
        tolerance = direct.tolerance_for(eager.articulation.dtype)
        self._terms = Terms(eager.dt, tolerance, self.integrator.surplus, direct.max_evaluations)

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process loads the core itself."""
        return NativeStepper, (self.eager, self.threads)

    @property
    def scene(self) -> Scene:
        """See `Stepper`."""
        return self.eager.scene

    @property
    def integrator(self) -> EnergyMomentum:
        """See `Stepper`."""
        scheme = self.eager.integrator
        assert isinstance(scheme, EnergyMomentum)
        return scheme

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

    def initial_state(self, q: Tensor, v: Tensor, control: Tensor | None) -> Velocities:
        """See `Stepper`: in PyTorch."""
        return self.eager.initial_state(q, v, control)

    def made(self, state: Velocities, control: Tensor | None) -> tuple[Velocities, Solution, Way]:
        """See `Stepper`. The way has no balance: records ask for it."""
        states, solution = self.run(state, None if control is None else control[None], 1)
        after, solution = mapped(_first, states), dataclasses.replace(mapped(_first, solution), lanes=solution.lanes)
        return after, solution, Way(solution.q)

    def run(self, state: Velocities, controls: Tensor | None, steps: int) -> tuple[Velocities, Solution]:
        """So many steps of all worlds under controls `[steps, *, nu]`, or `[1, *, nu]` for all of them (None: zero): the states
        after each, `[steps, *batch, ...]`, and how each was solved."""
        batch = state.q.shape[:-1]
        if not batch:
            return mapped(lambda x: x.squeeze(1), self.run(mapped(lambda x: x[None], state), controls, steps))
        if controls is None:
            controls = state.q.new_zeros(1, self.scene.nu)
        controls = spread(controls, batch)
        with torch.no_grad():
            journey = Journey(state, controls, steps, self._core.plan.grip)
            self._core.go(journey, self._terms)
            while len(journey.stopped):
                self._lead_on(journey, state)
                self._core.go(journey, self._terms)
            time = torch.cat((state.time[None], self.step_size.expand(steps, *batch))).cumsum(0)[1:]
            fields = journey.fields | {"time": time, "hazards": journey.counted["hazards"]}
            remembered = tuple(x.expand(steps, *x.shape) for x in state.memory)  # by terms that the core does not know
            return replaced(state, **fields, memory=remembered), journey.solution

    def _lead_on(self, journey: Journey, state: Velocities) -> None:
        """The next step of every stopped world, by what the eager step does after its first solver."""
        worlds = Worlds(tuple(state.q.shape[:-1]), journey.stopped)
        step = worlds.rows(journey.made).long()

        def row(values: Tensor, at: Tensor) -> Tensor:
            return values.flatten(1, len(worlds.batch))[at, worlds.index]

        def write(values: Tensor, new: Tensor) -> None:
            values.flatten(1, len(worlds.batch))[step, worlds.index] = new.to(values.dtype)

        before = state.take(worlds)
        ends = {name: row(x, (step - 1).clamp(min=0)) for name, x in journey.fields.items()}
        before = replaced(before, **{name: chosen(step > 0, x, getattr(before, name)) for name, x in ends.items()})
        control = row(journey.control, step if len(journey.control) > 1 else torch.zeros_like(step))
        left = mapped(lambda x: row(x, step), journey.solution)
        advanced = replaced(before, **{name: row(x, step) for name, x in journey.fields.items()})
        part = self.eager.take(worlds)
        objective = part.objective(before, control)
        refused = row(journey.counted["refused"], step).to(torch.bool)
        end, found, _ = part.finished(objective, before, control, left, advanced, refused)
        end, found = part.arrived(before, end, found)
        for name, values in (journey.counted | {"residual_norm": journey.residual_norm, "fallbacks": journey.fallbacks}).items():
            if name != "refused":
                write(values, end.hazards if name == "hazards" else getattr(found, name))
        for name, values in journey.fields.items():
            write(values, getattr(end, name))
            given = journey.given[name].clone()  # it may be the caller's
            given.view(-1, *given.shape[len(worlds.batch) :])[worlds.index] = getattr(end, name)
            journey.given[name] = given
        journey.made.view(-1)[worlds.index] += 1

    def objective(self, state: Velocities, control: Tensor | None) -> BalanceObjective:
        """See `Stepper`."""
        return self.eager.objective(state, control)

    def take(self, worlds: Worlds) -> NativeStepper:
        """See `Stepper`."""
        return NativeStepper(self.eager.take(worlds), self.threads)

    def sized(self, step_size: Tensor) -> NativeStepper:
        """See `Stepper`."""
        return NativeStepper(self.eager.sized(step_size), self.threads)


def uncovered(eager: EagerStepper[Any]) -> str:
    """Why the compiled core cannot make these steps, in words; nothing where it can."""
    try:
        _planned(eager)
    except NotCompiledError as missing:
        return str(missing)
    return ""


def _planned(eager: EagerStepper[Any]) -> Plan:
    """Raises `NotCompiledError`."""
    if library() is None:
        raise NotCompiledError(reason())
    if not isinstance(eager.solver, Fallbacks) or eager.solver.direct != Fallbacks().direct:
        raise NotCompiledError("the core does not know a solver other than the default one")
    return planned(eager)


def spread(controls: Tensor, batch: Sequence[int]) -> Tensor:
    """Controls `[steps, *, nu]`, given for all worlds or for some dimensions of the batch, as `[steps, *batch, nu]`."""
    missing = len(batch) + 2 - controls.ndim
    return controls.reshape(len(controls), *(1,) * missing, *controls.shape[1:]).expand(len(controls), *batch, controls.shape[-1])


def _first(values: Tensor) -> Tensor:
    return values[0]
