"""A task that is solved by shooting."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.gradients.trajectory import Trajectory
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.optimize.shooting import Progress, Shooting, Shot
from pbfd_torch.optimize.tasks.task import Outcome, Task


@dataclass(frozen=True)
class ShootingTask(Task):
    """Its file says what moves, where the search sets out, which search it is, and when the goal is reached."""

    @property
    @abstractmethod
    def shooting(self) -> Shooting[Velocities]:
        """What moves, and what is chosen."""

    @property
    @abstractmethod
    def starts(self) -> Tensor:
        """Where the search sets out, `[worlds, n]`."""

    @abstractmethod
    def reached(self, motion: Trajectory[Velocities]) -> Tensor:
        """Whether a motion meets the criterion, `[*batch]` bool."""

    @abstractmethod
    def shot(self, shooting: Shooting[Velocities], x: Tensor, iterations: int, progress: Progress | None) -> Shot[Velocities]:
        """The search from x `[worlds, n]`."""

    def uniform(self, *shape: int) -> Tensor:
        """In 0 … 1, the same for every call."""
        return torch.rand(*shape, dtype=torch.float64, generator=self.generator()).to(self.device, self.dtype)

    def solve(self, iterations: int, progress: Progress | None = None) -> Outcome[Velocities]:
        """See `Task`."""
        shooting, x = self.shooting, self.starts
        shot = self.shot(shooting, x, iterations, progress)
        before, reached = shooting.decision.plan(x), self.reached(shot.trajectory)
        return Outcome(shooting.simulator, before, shot.plan, shot.history, reached, shot.unsolved, shot.doubtful)
