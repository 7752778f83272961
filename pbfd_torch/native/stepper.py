"""Steps by the compiled core. What it leaves unsolved or refuses is led on in PyTorch, by the same detours and easier steps."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.integrators.energy_momentum import EnergyMomentum, Velocities
from pbfd_torch.native.core import Core, Terms
from pbfd_torch.native.library import library, reason
from pbfd_torch.native.not_compiled import NotCompiledError
from pbfd_torch.native.plan import planned
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.stepping.stepper import Solver
from pbfd_torch.stepping.way import Way
from pbfd_torch.stepping.worlds import put
from pbfd_torch.tensors.worlds import Worlds


class NativeStepper:
    """A `Stepper` whose steps the compiled core makes, of what an `EagerStepper` is made of. Raises `InputError` where there is no
    core, and for a scene that it does not know, naming what it lacks (`uncovered`)."""

    def __init__(self, eager: EagerStepper[Velocities]) -> None:
        try:
            self._core = _core(eager)
        except NotCompiledError as missing:
            raise InputError(f"no compiled steps: {missing}") from missing
        self.eager = eager
        direct = eager.first_solver
        assert isinstance(direct, Descent)
        tolerance = direct.tolerance_for(eager.articulation.dtype)
        self._terms = Terms(eager.dt, tolerance, self.integrator.surplus, direct.max_evaluations)

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
        with torch.no_grad():
            start = self.eager.departing(state, control)
            advanced, solution, refused = self._core.energy_momentum(start, control, self._terms)
            open_ = torch.where(solution.solved, refused, solution.status != int(Status.NON_FINITE))
            index = open_.reshape(-1).nonzero().squeeze(-1)
            if len(index):
                advanced, solution = self._led_on(start, control, advanced, solution, refused, index)
            return *self.eager.arrived(state, advanced, solution), Way(solution.q)

    def _led_on(
        self, state: Velocities, control: Tensor | None, advanced: Velocities, solution: Solution, refused: Tensor, index: Tensor
    ) -> tuple[Velocities, Solution]:
        """The worlds at `index` by what the eager step does after its first solver."""
        worlds = Worlds(tuple(state.q.shape[:-1]), index)
        part, before = self.eager.take(worlds), state.take(worlds)
        held = None if control is None else worlds.pick(control, 1)
        objective = part.objective(before, held)
        left = dataclasses.replace(solution, **{name: worlds.rows(getattr(solution, name)) for name in _PER_WORLD}, lanes=0)
        end, found, _ = part.finished(objective, before, held, left, advanced.take(worlds), worlds.rows(refused))
        kept = torch.ones_like(index, dtype=torch.bool)
        changed = {name: put(getattr(solution, name), getattr(found, name), worlds, kept) for name in _PER_WORLD}
        return put(advanced, end, worlds, kept), dataclasses.replace(solution, **changed, lanes=solution.lanes + found.lanes)

    def take(self, worlds: Worlds) -> NativeStepper:
        """See `Stepper`."""
        return NativeStepper(self.eager.take(worlds))

    def sized(self, step_size: Tensor) -> NativeStepper:
        """See `Stepper`."""
        return NativeStepper(self.eager.sized(step_size))


_PER_WORLD = ("q", "status", "residual_norm", "iterations", "evaluations", "fallbacks")


def uncovered(eager: EagerStepper[Velocities]) -> str:
    """Why the compiled core cannot make these steps, in words; nothing where it can."""
    try:
        _core(eager)
    except NotCompiledError as missing:
        return str(missing)
    return ""


def _core(eager: EagerStepper[Velocities]) -> Core:
    """Raises `NotCompiledError`."""
    compiled = library()
    if compiled is None:
        raise NotCompiledError(reason())
    if not isinstance(eager.solver, Fallbacks) or eager.solver.direct != Fallbacks().direct:
        raise NotCompiledError("the core does not know a solver other than the default one")
    return Core(compiled, planned(eager))
