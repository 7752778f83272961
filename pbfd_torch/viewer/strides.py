"""How live mode moves on: by a few steps at once, of which the last is recorded, to be drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor

from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.native.stretch import Stretch
from pbfd_torch.records.recording import Recorder
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import mapped


@dataclass(frozen=True, eq=False)
class Stride:
    """Steps that were made: the state after the last one, how each was solved `[steps, *batch]`, and what makes the record of the
    last."""

    after: Any
    solution: Solution
    record: Callable[[], Rollout]

    @property
    def steps(self) -> int:
        """How many."""
        return len(self.solution.status)


def strode(simulator: Simulator[Any], state: Any, control: Tensor, steps: int) -> Stride:
    """From a state on under a control `[*batch, nu]`: so many steps in one call of the core, or a single one in PyTorch, which
    takes longer than a picture."""
    stepper = simulator.stepper
    if isinstance(stepper, NativeStepper):
        stretch = stepper.stretch(state, control[None], steps)
        return Stride(stretch.end, stretch.solution, partial(_written, stepper, state, stretch))
    after, solution, _ = stepper.made(state, control)
    return Stride(after, mapped(lambda x: x[None], solution), partial(_defined, simulator, state, control, after, solution))


def _written(stepper: NativeStepper[Any], start: Any, stretch: Stretch[Any]) -> Rollout:
    """By the core."""
    count = len(stretch)
    record = stepper.record(stretch.part(0, count - 1).end if count > 1 else start, 1)
    record.add(stretch.part(count - 1, count))
    return record.finish()


def _defined(simulator: Simulator[Any], before: Any, control: Tensor, after: Any, solution: Solution) -> Rollout:
    """By PyTorch."""
    recorder = Recorder(simulator.scene, simulator.integrator, simulator.dt, simulator.step_size, before)
    recorder.record(after, solution, simulator.objective(before, control))
    return recorder.finish()
