"""Rollouts by the compiled core: many steps in one call, and their record in one go."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pbfd_torch.integrators.integrator import S
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.records.recording import Recorder
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.solvers.per_world import mapped

AT_ONCE = 4096  # steps of worlds: what is recorded in one go is in the processor's cache, and an interruption need not wait


def rolled_out(
    stepper: NativeStepper[S],
    state: S,
    controls: Tensor | None = None,
    steps: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> Rollout:
    """See `Simulator.rollout`. Progress is told of each step when a few of them are done."""
    count = stepper.scene.step_count(controls, steps)
    recorder = Recorder(stepper.scene, stepper.integrator, stepper.dt, state)
    most = max(1, AT_ONCE // max(1, state.q[..., 0].numel()))
    try:
        while recorder.steps < count:
            first = recorder.steps
            part = min(most, count - first)
            held = None if controls is None else controls[first : first + part]
            states, solution = stepper.run(state, held, part)
            starts = mapped(_shifted, state, states)
            recorder.record_several(states, solution, stepper.objective(starts, held))
            state = mapped(_last, states)
            for k in range(part):
                if progress is not None:
                    progress(first + k + 1)
    except KeyboardInterrupt:
        if recorder.steps == 0:
            raise
    return recorder.finish()


def _shifted(start: Tensor, ends: Tensor) -> Tensor:
    """The states that steps set out from, of the first one and of those after each."""
    return torch.cat((start[None], ends[:-1]))


def _last(ends: Tensor) -> Tensor:
    return ends[-1]
