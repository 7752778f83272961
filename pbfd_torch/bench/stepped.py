"""Many steps as the benchmarks take them: all states after them, and no record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.integrators.integrator import S
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import mapped

Step = Callable[[Any, Tensor | None], tuple[Any, Solution]]
"""(state, control) → the state after a step, and how it was solved."""


def stepped(simulator: Simulator[S], state: S, steps: int, controls: Tensor | None = None) -> tuple[S, Solution]:
    """The states after each of so many steps, and how these were solved, `[steps, *batch, ...]`, under controls
    `[steps, *batch, nu]` (None: zero). The core makes them in one call."""
    stepper = simulator.stepper
    if isinstance(stepper, NativeStepper):
        return stepper.run(state, controls, steps)
    return one_by_one(simulator.step, state, steps, controls)


def solved(simulator: Simulator[S], state: S, steps: int, controls: Tensor | None = None) -> Solution:
    """How as many steps are solved, for those who ask for no states: the core's own are not made into ours."""
    stepper = simulator.stepper
    if isinstance(stepper, NativeStepper):
        return stepper.stretch(state, controls, steps).solution
    return stepped(simulator, state, steps, controls)[1]


def one_by_one(step: Step, state: S, steps: int, controls: Tensor | None = None) -> tuple[S, Solution]:
    """The same of whatever makes single steps."""
    states, solutions = [], []
    for k in range(steps):
        state, solution = step(state, None if controls is None else controls[k])
        states.append(state)
        solutions.append(solution)
    return _joined(states), _joined(solutions)


def _joined(each: Sequence[Any]) -> Any:
    return mapped(lambda *parts: torch.stack(parts), *each)
