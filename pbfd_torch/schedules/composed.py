"""Steppers whose steps are made of those of another one."""

from __future__ import annotations

import copy
from typing import Generic, Self

from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.integrators.integrator import Integrator, S
from pbfd_torch.scene import Scene
from pbfd_torch.stepping.stepper import Solver, Stepper
from pbfd_torch.tensors.worlds import Worlds


class Composed(Generic[S]):
    """What such a `Stepper` has of the other one, `fixed`: all but how a step is made."""

    def __init__(self, fixed: Stepper[S]) -> None:
        self.fixed = fixed

    @property
    def scene(self) -> Scene:
        return self.fixed.scene

    @property
    def integrator(self) -> Integrator[S]:
        return self.fixed.integrator

    @property
    def step_size(self) -> Tensor:
        """Of a whole step."""
        return self.fixed.step_size

    @property
    def dt(self) -> float:
        """Of a whole step."""
        return self.fixed.dt

    @property
    def solver(self) -> Solver:
        return self.fixed.solver

    @property
    def halvings(self) -> int:
        return self.fixed.halvings

    def initial_state(self, q: Tensor, v: Tensor, control: Tensor | None) -> S:
        """As that of whole steps."""
        return self.fixed.initial_state(q, v, control)

    def objective(self, state: S, control: Tensor | None) -> BalanceObjective:
        """See `Stepper`: of a whole step."""
        return self.fixed.objective(state, control)

    def take(self, worlds: Worlds) -> Self:
        """See `Stepper`."""
        return self._of(self.fixed.take(worlds))

    def sized(self, step_size: Tensor) -> Self:
        """See `Stepper`: whole steps of another length."""
        return self._of(self.fixed.sized(step_size))

    def _of(self, fixed: Stepper[S]) -> Self:
        other = copy.copy(self)
        other.fixed = fixed
        return other
