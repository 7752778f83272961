"""How live mode moves on: by a few steps at once, of which the last is recorded, to be drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.records.recording import Recorder
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import mapped


@dataclass(frozen=True, eq=False)
class Stride:
    """Steps that were made: the states before and after the last one, and how each was solved `[steps, *batch]`."""

    before: Any
    after: Any
    solution: Solution

    @property
    def steps(self) -> int:
        """How many."""
        return len(self.solution.status)


def strode(simulator: Simulator[Any], state: Any, control: Tensor, steps: int) -> Stride:
    """From a state on under a control `[*batch, nu]`: so many steps in one call of the core, or a single one in PyTorch, which
    takes longer than a picture."""
    stepper = simulator.stepper
    if not isinstance(stepper, NativeStepper):
        after, solution, _ = stepper.made(state, control)
        return Stride(state, after, mapped(_alone, solution))
    state = stepper.complete(state)
    states, solution = stepper.run(state, control[None], steps)
    before = state if steps == 1 else mapped(lambda x: x[-2], states)
    return Stride(before, mapped(lambda x: x[-1], states), solution)


def recorded(simulator: Simulator[Any], stride: Stride, control: Tensor) -> Rollout:
    """The record of its last step."""
    stepper, last = simulator.stepper, mapped(lambda x: x[-1:], stride.solution)
    if isinstance(stepper, NativeStepper):
        record = stepper.record(stride.before, 1)
        record.add(stride.before, mapped(_alone, stride.after), last)
        return record.finish()
    recorder = Recorder(simulator.scene, simulator.integrator, simulator.dt, stride.before)
    recorder.record(stride.after, mapped(lambda x: x[0], last), simulator.objective(stride.before, control))
    return recorder.finish()


def _alone(x: Tensor) -> Tensor:
    return x[None]
