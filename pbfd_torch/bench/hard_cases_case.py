"""A hard case: a law, the steps at which it is tried, and what is checked of a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models.setup import Setup
from pbfd_torch.native.engine import Engine, Torch
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.stepping.stepper import Solver

ALL = tuple(INTEGRATORS)
FIRST_ORDER = ("implicit-euler",)
SECOND_ORDER = tuple(name for name in ALL if name not in FIRST_ORDER)
CONSERVING = ("variational", "energy-momentum")  # the angular momentum, exactly
HIGH_ORDER = ("runge-kutta",)
EXACT = tuple(name for name in ALL if name not in HIGH_ORDER)  # linear momentum of what flies: not just to an order
ONE_STEP = tuple(name for name in ALL if name != "bdf2")  # no memory of contact forces before the last step's
MEAN_VELOCITY = ("implicit-euler", "variational")  # their velocity is the average over the last step
BEST = ("energy-momentum",)
TIME_STEPS = (1 / 1000, 1 / 250, 1 / 100, 1 / 50, 1 / 20, 1 / 10)  # [s]


@dataclass(frozen=True)
class Check:
    """A number that must not exceed a limit.

    Attributes:
        name: what it is, with its unit.
        value: NaN where the run gave none; that does not hold.
        limit: inclusive.
        must: whether the integrator has to keep the limit at this step; if not, the number is reported.
    """

    name: str
    value: float
    limit: float
    must: bool = True

    @property
    def holds(self) -> bool:
        return self.value <= self.limit

    @property
    def fails(self) -> bool:
        return self.must and not self.holds

    @property
    def verdict(self) -> str:
        """One of pass, fail, and reported, where a limit is exceeded that need not be kept."""
        return "fail" if self.fails else "pass" if self.holds else "reported"

    @property
    def strain(self) -> float:
        """Share of the limit that is used up; infinite for NaN."""
        if math.isnan(self.value):
            return math.inf
        return self.value / self.limit if self.limit > 0 else (math.inf if self.value > self.limit else 0.0)


@dataclass(frozen=True, eq=False)
class Run:
    """One integrator at one step, and the rollouts made with it.

    Attributes:
        integrator: its name.
        dt: step [s].
        brief: whether long simulations are cut short.
        engine: what makes the steps; None: the core where it can.
        engines: the names of those that have made them.
    """

    integrator: str
    dt: float
    brief: bool = False
    engine: Engine | None = None
    rollouts: list[Rollout] = field(default_factory=list)
    engines: set[str] = field(default_factory=set)

    def among(self, names: Collection[str], largest: float = math.inf) -> bool:
        """Whether the integrator is one of these and the step at most `largest` [s]."""
        return self.integrator in names and self.dt <= largest * (1 + 1e-12)

    def seconds(self, full: float, brief: float) -> float:
        """How long to simulate [s]."""
        return brief if self.brief else full

    def simulator(self, scene: Scene, parts: int = 1, solver: Solver | None = None) -> Simulator:
        """Of the scene, with steps of dt/parts; those of a solver that is not the default one are made in PyTorch."""
        engine = self.engine if solver is None else Torch()
        made = Simulator(scene, self.dt / parts, INTEGRATORS[self.integrator](), solver, engine=engine)
        self.engines.add(made.engine)
        return made

    def roll(
        self, scene: Scene, duration: float, q: Tensor | None = None, v: Tensor | None = None, parts: int = 1,
        controls: Callable[[int], Tensor] | None = None,
    ) -> Rollout:  # fmt: skip
        """A rollout that lasts `duration` [s], or up to a step longer; controls: steps → `[steps, *batch, nu]`."""
        simulator = self.simulator(scene, parts)
        steps = math.ceil(duration / simulator.dt - 1e-9)
        held = None if controls is None else controls(steps)
        state = simulator.initial_state(q, v, None if held is None else held[0])
        rollout = simulator.rollout(state, held, None if held is not None else steps)
        self.rollouts.append(rollout)
        return rollout

    def roll_setup(self, setup: Setup, duration: float) -> Rollout:
        """A rollout of a named scene from its own start."""
        return self.roll(setup.scene, duration, setup.q, setup.v)

    def energy(self, rollout: Rollout) -> Tensor:
        """Kinetic plus potential energy [J] at one and the same time, `[T, *batch]`: at t_n, or, where the velocity is the average
        over a step, in its middle, with the mean of the potential energies at its ends."""
        stored = rollout.potential_energy
        at = 0.5 * (stored[1:] + stored[:-1]) if self.integrator in MEAN_VELOCITY else stored[1:]
        return rollout.kinetic_energy[1:] + at

    def gained(self, rollout: Rollout, start: Tensor | float) -> float:
        """How far that energy is ever above what it was at the start [J]; < 0: never."""
        return float((self.energy(rollout) - start).amax())

    def solved(self, must: Collection[str] = ALL, largest: float = math.inf) -> Check:
        """Every step so far is solved."""
        return Check("unsolved steps", float(sum(int((~x.solved).sum()) for x in self.rollouts)), 0.0, self.among(must, largest))


@dataclass(frozen=True)
class Case:
    """Attributes:
    measure: run → checks; its docstring states the law.
    steps: the steps [s] at which the case is tried, from `TIME_STEPS`.
    brief: those of the quick run.
    integrators: those whose law it is.
    """

    measure: Callable[[Run], Sequence[Check]]
    steps: Sequence[float]
    brief: Sequence[float]
    integrators: Sequence[str] = ALL

    @property
    def name(self) -> str:
        return self.measure.__name__.replace("_", "-")

    @property
    def law(self) -> str:
        """In one line."""
        return " ".join((self.measure.__doc__ or "").split())


def most(values: Tensor) -> float:
    """The largest absolute value; NaN if there is one."""
    return float(values.detach().abs().amax())


def drift(vectors: Tensor) -> float:
    """Largest change of `[T, *batch, 3]` from its start, relative to the norm there."""
    size = torch.linalg.vector_norm(vectors[0], dim=-1)
    return most(torch.linalg.vector_norm(vectors - vectors[:1], dim=-1) / size)


def rise(rollout: Rollout) -> float:
    """Largest rise over one step of the energy that implicit Euler never lets rise: of the step's average velocity, and stored at
    its end [J]. The virtual step before the start does not count."""
    return float(rollout.energy[1:].diff(dim=0).clamp_min(0).amax())
