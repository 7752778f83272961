"""MuJoCo as `pbfd bench speed` times it: `mujoco.rollout`, all in C."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from pbfd_torch.bench.mujoco_runs import diverged, loaded
from pbfd_torch.bench.precision import peer_motion
from pbfd_torch.bench.precision_scenes import Case
from pbfd_torch.bench.precision_tracks import Track
from pbfd_torch.bench.speed_ours import Call
from pbfd_torch.bench.speed_scenes import Course, Work
from pbfd_torch.solvers.objective import Solution

INTEGRATORS = {"mujoco-implicitfast": "implicitfast", "mujoco-discrete": "discrete", "mujoco-rk4": "RK4"}
SUBSTEPS = (1, 2, 4, 5, 10, 20, 25, 50, 100)


@dataclass(frozen=True)
class Peer:
    """One of MuJoCo's integrators on one scene, so many steps in a control step. unfit: why none would do, if so."""

    course: Course
    engine: str
    substeps: int
    dtype: str = "float64"
    unfit: str = ""

    def missing(self) -> str:
        """Why it is not timed; nothing where it is."""
        return self.unfit

    def ready(self, works: Sequence[Work], threads: int) -> Call:
        """What makes these rollouts, one after another; its outputs are reused."""
        from mujoco import MjData, rollout

        model = self._model()
        datas = [MjData(model) for _ in range(threads)]
        arguments = [self._arguments(model, datas[0], work) for work in works]

        def call() -> Sequence[Solution]:
            for start, controls, states in arguments:
                rollout.rollout(model, datas, start, controls, nstep=states.shape[1], state=states, persistent_pool=threads > 1)
            return ()

        return call

    def motion(self, case: Case, duration: float) -> Track:
        """The case's, from the scene's own start."""
        return peer_motion(case, INTEGRATORS[self.engine], self.course.dt / self.substeps, duration)[0]

    def lost(self, work: Work) -> bool:
        """Whether it diverges in these rollouts."""
        from mujoco import MjData, rollout

        model = self._model()
        data = MjData(model)
        start, controls, states = self._arguments(model, data, work)
        rollout.rollout(model, data, start, controls, nstep=states.shape[1], state=states)
        return diverged(data) or not bool(np.isfinite(states).all())

    def wrong(self) -> bool:
        """Whether its motion ends further off than the course allows."""
        case = self.course.case
        if case.exact is None or math.isinf(self.course.bound):
            return False
        error = case.error(self.motion(case, case.duration), case.exact())
        return not error <= self.course.bound

    def _model(self) -> Any:
        return loaded(self.course.scene, self.course.dt / self.substeps, INTEGRATORS[self.engine])

    def _arguments(self, model: Any, data: Any, work: Work) -> tuple[Any, Any, Any]:
        """Starts `[worlds, nstate]`, controls of every step, and room for the states `[worlds, steps, nstate]`."""
        import mujoco

        whole = mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.zeros((len(work.q), mujoco.mj_stateSize(model, whole)))
        for row, q, v in zip(start, work.q.numpy(), work.v.numpy(), strict=True):
            data.qpos[:], data.qvel[:] = q, v
            mujoco.mj_getState(model, data, row, whole)
        controls = torch.repeat_interleave(work.controls.transpose(0, 1), self.substeps, 1).contiguous().numpy()
        return start, controls if model.nu else None, np.zeros((len(start), self.substeps * len(work.controls), start.shape[1]))


def fewest(course: Course, engine: str, work: Work) -> tuple[Peer, str]:
    """That integrator with the fewest steps in a control step with which it neither diverges in the work nor ends further off than
    the course allows, and what there is to say about it."""
    least = course.shipped if engine == "mujoco-rk4" else 1
    fails = f"diverges or ends over {course.bound:g} m off" if math.isfinite(course.bound) else "diverges"
    for count in [count for count in SUBSTEPS if count >= least]:
        peer = Peer(course, engine, count)
        if not peer.wrong() and not peer.lost(work):
            return peer, "" if count == least else f"{fails} with fewer than {count} steps of {course.dt / count:g} s"
    return Peer(course, engine, count, unfit=f"{fails} at every step from {course.dt:g} to {course.dt / count:g} s"), ""
