"""Rollouts by the compiled core: many steps in one call, and their record in another."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from pbfd_torch.integrators.integrator import S
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.tensors.shapes import spread

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
    state = stepper.complete(state)
    record = stepper.record(state, count)
    batch = state.q.shape[:-1]
    most = max(1, AT_ONCE // max(1, state.q[..., 0].numel()))
    try:
        while record.steps < count:
            first = record.steps
            part = min(most, count - first)
            held = None if controls is None else spread(controls[first : first + part], batch)
            stretch = stepper.stretch(state, held, part)
            told = _told(progress, first, part)
            record.add(stretch.part(0, told))
            if told < part:
                break
            state = stretch.end
    except KeyboardInterrupt:
        if record.steps == 0:
            raise
    return record.finish()


def _told(progress: Callable[[int], object] | None, first: int, part: int) -> int:
    """Tells of steps that are done, and of how many it could before it was interrupted."""
    if progress is None:
        return part
    for k in range(part):
        try:
            progress(first + k + 1)
        except KeyboardInterrupt:
            return k + 1
    return part
