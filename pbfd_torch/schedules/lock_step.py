"""A rollout in lock step: all worlds make their steps together, and everything is recorded."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from pbfd_torch.errors import ContactOverflowError
from pbfd_torch.integrators.integrator import S
from pbfd_torch.records.recording import Recorder
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.stepping.stepper import Stepper


def rolled_out(
    stepper: Stepper[S],
    state: S,
    controls: Tensor | None = None,
    steps: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> Rollout:
    """See `Simulator.rollout`."""
    count = stepper.scene.step_count(controls, steps)
    recorder = Recorder(stepper.scene, stepper.integrator, stepper.dt, stepper.step_size, state)
    try:
        for k in range(count):
            before, control = state, None if controls is None else controls[k]
            state, solution, way = stepper.made(before, control)
            recorder.record(state, solution, way.objective or stepper.objective(before, control))
            if progress is not None:
                progress(k + 1)
    except KeyboardInterrupt:
        if recorder.steps == 0:
            raise
    except ContactOverflowError as error:
        error.rollout = recorder.finish() if recorder.steps else None
        raise
    return recorder.finish()
