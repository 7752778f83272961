"""Our engines as `pbfd bench speed` times them: rollouts that record nothing, and the motion that their error is read off."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.bench.precision import step_count
from pbfd_torch.bench.precision_scenes import Case
from pbfd_torch.bench.precision_tracks import Track
from pbfd_torch.bench.speed_scenes import Course, Work
from pbfd_torch.bench.stepped import solved, stepped
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.native.engine import Native, Torch
from pbfd_torch.native.stepper import uncovered
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.tensors.structures import in_dtype

ENGINES = ("native", "torch")
DTYPES = {"float64": torch.float64, "float32": torch.float32}


Call = Callable[[], Sequence[Solution]]
"""Makes rollouts and says how their steps were solved, as far as that is known."""


@dataclass(frozen=True, eq=False)
class Record:
    """The states of rollouts after each step `[steps, worlds, ...]`, and their controls."""

    states: Velocities
    controls: Tensor

    def spread(self, worlds: int, group: int, groups: int, steps: int) -> tuple[Velocities, Tensor]:
        """Of one of `groups` groups: states at times that are, of all groups together, spread evenly, and controls for so many
        steps."""
        count, tracked = self.states.q.shape[:2]
        world = torch.arange(worlds)
        row, copy = (group + groups * world) * count // (groups * worlds), (group + groups * world) % tracked
        return mapped(lambda x: x[row, copy], self.states), self.controls[:steps, copy]


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

    def missing(self) -> str:
        """Why it cannot run; nothing where it can."""
        return uncovered(Simulator(self._scene(1), self.course.dt).eager) if self.engine == "native" else ""

    def ready(self, works: Sequence[Work], threads: int) -> Call:
        """What makes these rollouts, one after another."""
        simulator = self._simulator(len(works[0].q), threads)
        begun = [self._begun(simulator, work) for work in works]
        return lambda: [solved(simulator, state, len(controls), controls) for state, controls in begun]

    def ready_under_way(self, record: Record, worlds: int, groups: int, steps: int, threads: int) -> Call:
        """What stands for rollouts that would take too long: a few steps of so many groups of worlds, one after another, each world
        from a state of the record at another time, spread evenly over it."""
        simulator, kind = self._simulator(worlds, threads), DTYPES[self.dtype]
        begun = [in_dtype(record.spread(worlds, group, groups, steps), kind) for group in range(groups)]
        return lambda: [solved(simulator, state, len(controls), controls) for state, controls in begun]

    def motion(self, case: Case, duration: float) -> Track:
        """The case's, from the scene's own start."""
        setup = self.course.setup(1)
        steps, dt = step_count(duration, self.course.dt), self.course.dt
        controls = case.controls(dt, dt * torch.arange(steps, dtype=torch.float64)[:, None])
        return self.path(Work(setup.q, setup.v, setup.controls(steps) if controls is None else controls))

    def path(self, work: Work) -> Track:
        """Of all worlds of a work, in float64."""
        states = self.record(work).states
        simulator = self._simulator(len(work.q), 1)
        speed = simulator.integrator.velocity(simulator.articulation, states, simulator.step_size)
        q, v = (torch.cat((start[None], rest.double())) for start, rest in ((work.q, states.q), (work.v, speed)))
        return Track.of_states(self.course.setup(len(work.q)).scene, self.course.dt * torch.arange(len(q), dtype=q.dtype), q, v)

    def record(self, work: Work) -> Record:
        """All states of a work."""
        simulator = self._simulator(len(work.q), 1)
        state, controls = self._begun(simulator, work)
        return Record(stepped(simulator, state, len(controls), controls)[0], controls)

    def _begun(self, simulator: Simulator[Velocities], work: Work) -> tuple[Velocities, Tensor]:
        q, v, controls = (x.to(DTYPES[self.dtype]) for x in (work.q, work.v, work.controls))
        return simulator.initial_state(q, v, controls[0]), controls

    def _scene(self, worlds: int) -> Scene:
        return self.course.setup(worlds, DTYPES[self.dtype]).scene

    def _simulator(self, worlds: int, threads: int) -> Simulator[Velocities]:
        engine = Native(threads) if self.engine == "native" else Torch()
        return Simulator(self._scene(worlds), self.course.dt, engine=engine)


def definition(course: Course) -> Ours:
    """What makes long motions of a scene in double precision: the core where it can, which is judged by PyTorch; else PyTorch."""
    native = Ours(course, "native", "float64")
    return Ours(course, "torch", "float64") if native.missing() else native
