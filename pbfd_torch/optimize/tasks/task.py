"""What a named task is, and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, Protocol

from torch import Tensor

from pbfd_torch.integrators.integrator import S
from pbfd_torch.optimize.decision import Plan
from pbfd_torch.optimize.shooting import Progress
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.simulator import Simulator


@dataclass(frozen=True, eq=False)
class Outcome(Generic[S]):
    """Attributes:
    simulator: what the plans are for.
    before, after: plans of all worlds, as they started and the best ones found.
    history: `[k + 1, worlds]` cost at the start and after every iteration.
    reached: `[worlds]` bool, by the task's criterion.
    unsolved: `[worlds]` how many steps of the best motion are unsolved; doubtful: how many have doubtful derivatives.
    """

    simulator: Simulator[S]
    before: Plan[S]
    after: Plan[S]
    history: Tensor
    reached: Tensor
    unsolved: Tensor
    doubtful: Tensor

    def rollout(self, plan: Plan[S]) -> Rollout:
        """The record of a plan's motion."""
        return self.simulator.rollout(plan.start, plan.controls, None if plan.controls is not None else plan.steps)


class Task(Protocol):
    """A problem with random starts, one per world.

    `criterion`: what counts as reached. `iterations`: how many suffice."""

    @property
    def criterion(self) -> str: ...

    @property
    def iterations(self) -> int: ...

    def solve(self, iterations: int, progress: Progress | None = None) -> Outcome[Any]:
        """Optimises all worlds from their starts."""
        ...
