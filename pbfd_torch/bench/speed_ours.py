"""Our engines as `pbfd bench speed` times them: rollouts that record nothing, and the motion that their error is read off."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.bench.precision import step_count
from pbfd_torch.bench.precision_tracks import Track
from pbfd_torch.bench.speed_scenes import Course, Work
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.native.stepper import NativeStepper, uncovered
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.objective import Solution

ENGINES = ("native", "torch")
DTYPES = {"float64": torch.float64, "float32": torch.float32}


@dataclass(frozen=True)
class Outcome:
    """How the steps of a call went, over all of them: evaluations a step, the share solved, the share with a fallback; NaN: not
    known."""

    evaluations: float = math.nan
    solved: float = math.nan
    fallbacks: float = math.nan


Call = Callable[[], Outcome]


@dataclass(frozen=True)
class Ours:
    """One of our engines on one scene, in one dtype."""

    course: Course
    engine: str
    dtype: str

    @property
    def substeps(self) -> int:
        """Steps in a control step."""
        return 1

    def missing(self, threads: int) -> str:
        """Why it cannot run; nothing where it can."""
        if self.engine == "torch":
            return ""
        if threads > 1:
            return "the core has one thread"
        return uncovered(self._simulator(1).eager)

    def ready(self, works: Sequence[Work], threads: int) -> Call:
        """What makes these rollouts, one after another."""
        simulator = self._simulator(len(works[0].q))
        kind = DTYPES[self.dtype]
        begun = []
        for work in works:
            controls = work.controls.to(kind)
            state = simulator.initial_state(work.q.to(kind), work.v.to(kind), controls[0])
            begun.append((simulator.step(state, controls[0])[0] if work.under_way else state, controls))
        return lambda: _outcome([solution for state, controls in begun for _, solution in _steps(simulator, state, controls)])

    def motion(self, case: Any, duration: float, worlds: int = 1) -> Track:
        """The case's, from the scene's own start."""
        setup = self.course.setup(worlds)
        steps, dt = step_count(duration, self.course.dt), self.course.dt
        controls = case.controls(dt, dt * torch.arange(steps, dtype=torch.float64)[:, None].expand(-1, worlds))
        drive = setup.controls(steps) if controls is None else controls
        return self.path(Work(setup.q, setup.v, drive))

    def path(self, work: Work) -> Track:
        """Of all worlds of a work, in float64."""
        simulator, kind = self._simulator(len(work.q)), DTYPES[self.dtype]
        controls = work.controls.to(kind)
        start = simulator.initial_state(work.q.to(kind), work.v.to(kind), controls[0])
        states = [state for state, _ in _steps(simulator, start, controls)]
        q = torch.stack([work.q, *(state.q.double() for state in states)])
        v = torch.stack([work.v, *(state.v.double() for state in states)])
        return Track.of_states(self.course.setup(len(work.q)).scene, self.course.dt * torch.arange(len(q), dtype=q.dtype), q, v)

    def _simulator(self, worlds: int) -> Simulator[Velocities]:
        simulator: Simulator[Velocities] = Simulator(self.course.setup(worlds, DTYPES[self.dtype]).scene, self.course.dt)
        if self.engine == "native":
            simulator.stepper = NativeStepper(simulator.eager)
        return simulator


def definition(course: Course) -> Ours:
    """What makes long motions of a scene in double precision: the core where it can, which is judged by PyTorch; else PyTorch."""
    native = Ours(course, "native", "float64")
    return Ours(course, "torch", "float64") if native.missing(1) else native


def _steps(simulator: Simulator[Velocities], state: Velocities, controls: Tensor) -> Iterator[tuple[Velocities, Solution]]:
    for control in controls:
        state, solution, _ = simulator.stepper.made(state, control)
        yield state, solution


def _outcome(solutions: Sequence[Solution]) -> Outcome:
    def mean(of: Callable[[Solution], Tensor]) -> float:
        return float(torch.stack([of(x).double().mean() for x in solutions]).mean())

    return Outcome(mean(lambda x: x.evaluations), mean(lambda x: x.solved), mean(lambda x: x.fallbacks.sum(-1) > 0))
