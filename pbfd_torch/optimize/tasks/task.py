"""What a named task is, what all of them share, and what comes out of one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Generic

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.implicit import Doubtful, Gradients
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.integrators.integrator import S
from pbfd_torch.optimize.decision import Plan
from pbfd_torch.optimize.shooting import Progress
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
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


@dataclass(frozen=True)
class Task(ABC):
    """A problem with random starts, one per world. `worlds` ≥ 1; `seed` of the starts. `iterations`: how many suffice.

    Raises `InputError` for no worlds."""

    iterations: ClassVar[int]

    worlds: int = 20
    seed: int = 0
    dtype: torch.dtype = torch.float64
    device: torch.device | str = "cpu"

    def __post_init__(self) -> None:
        if self.worlds < 1:
            raise InputError(f"worlds is {self.worlds}: must be ≥ 1")

    @property
    @abstractmethod
    def criterion(self) -> str:
        """What counts as reached."""

    @abstractmethod
    def solve(self, iterations: int, progress: Progress | None = None) -> Outcome[Any]:
        """Optimises all worlds from their starts."""

    def simulated(self, scene: Scene, dt: float) -> Simulator[Velocities]:
        """The simulator of a scene at steps of `dt` [s]; a step without a derivative ends those of its world, and no other's."""
        return Simulator(scene, dt, gradients=Gradients(doubtful=Doubtful.ZERO))

    def generator(self) -> torch.Generator:
        """Of the random starts, the same for every call."""
        return torch.Generator().manual_seed(self.seed)

    def tensor(self, values: tuple[float, ...]) -> Tensor:
        """`[n]` numbers as the scene has them."""
        return torch.tensor(values, dtype=self.dtype, device=self.device)
