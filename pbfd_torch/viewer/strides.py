"""How live mode moves on: by a few steps at once, of which the last is recorded, to be drawn."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.native.stretch import Stretch
from pbfd_torch.records.recording import Recorder
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.per_world import mapped


def strode(simulator: Simulator[Any], state: Any, control: Tensor, steps: int) -> Stretch[Any]:
    """From a state on under a control `[*batch, nu]`: so many steps in one call of the core, or a single one in PyTorch, which
    takes longer than a picture."""
    stepper = simulator.stepper
    if isinstance(stepper, NativeStepper):
        return stepper.stretch(state, control[None], steps)
    after, solution, _ = stepper.made(state, control)
    return Stretch(state, *(mapped(lambda x: x[None], one) for one in (after, solution)))


def recorded(simulator: Simulator[Any], stride: Stretch[Any], control: Tensor) -> Rollout:
    """The record of its last step."""
    stepper, last = simulator.stepper, stride.part(len(stride) - 1, len(stride))
    if isinstance(stepper, NativeStepper):
        record = stepper.record(last.before, 1)
        record.add(last)
        return record.finish()
    recorder = Recorder(simulator.scene, simulator.integrator, simulator.dt, simulator.step_size, last.before)
    recorder.record(last.end, mapped(lambda x: x[0], last.solution), simulator.objective(last.before, control))
    return recorder.finish()
