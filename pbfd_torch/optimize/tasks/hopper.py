"""`hopper`: the one-legged hopper jumps to a height, its controls found by gradients through its foot's contact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from pbfd_torch.gradients.trajectory import Trajectory
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.models.robots import hopper
from pbfd_torch.optimize.decision import Controls
from pbfd_torch.optimize.limits import Limits
from pbfd_torch.optimize.shooting import Progress, Shooting, Shot
from pbfd_torch.optimize.tasks.shooting_task import ShootingTask

HIGH = 1.4  # where the torso is to be at the end [m]; with straight joints it stands at 1.25 m
NEAR, UPRIGHT = 0.03, 0.3  # [m], [rad] at the end
BENT = (0.2, 0.3)  # [rad] of the hip and the knee at the start
NOISE = 0.1  # of the control limits, for the random controls of the start
RATE = 0.1  # of Adam, likewise
DT, STEPS, HELD = 0.02, 16, 2


@dataclass(frozen=True)
class Hopper(ShootingTask):
    """Adam from random controls and bent joints: it passes over the jumps that contacts which come and go make in the
    derivatives."""

    iterations: ClassVar[int] = 20
    worlds: int = 8

    @property
    def criterion(self) -> str:
        """See `Task`."""
        return f"the torso within {100 * NEAR:g} cm of {HIGH:g} m high after {STEPS * DT:g} s, its pitch below {UPRIGHT:g} rad"

    @property
    def shooting(self) -> Shooting[Velocities]:
        """What moves: .32 s at steps of 20 ms, controls held for two of them."""
        setup = hopper(self.worlds, self.dtype, self.device)
        least, most = BENT
        q = setup.q.clone()
        q[:, 3:5] -= least + (most - least) * self.uniform(self.worlds, 2)
        limits = Limits.within(q.new_ones(setup.scene.nu))
        simulator = self.simulated(setup.scene, DT)
        return Shooting(simulator, Controls(simulator.initial_state(q), limits, STEPS, HELD))

    @property
    def starts(self) -> Tensor:
        """Random controls `[worlds, n]`."""
        count = len(self.shooting.decision.bounds.scale)
        return NOISE * (2 * self.uniform(self.worlds, count) - 1)

    def cost(self, motion: Trajectory[Velocities], controls: Tensor | None) -> Tensor:
        """Of the torso's height and pitch at the end, ½ Σ of squares in units of the criterion `[*batch]`."""
        return 0.5 * self._away(motion).square().sum(-1)

    def reached(self, motion: Trajectory[Velocities]) -> Tensor:
        """`[*batch]` bool."""
        return (self._away(motion).abs() < 1).all(-1) & motion.solved.all(0)

    def _away(self, motion: Trajectory[Velocities]) -> Tensor:
        _, z, pitch = motion.q[-1, ..., :3].unbind(-1)
        return torch.stack(((z - HIGH) / NEAR, pitch / UPRIGHT), -1)

    def shot(self, shooting: Shooting[Velocities], x: Tensor, iterations: int, progress: Progress | None) -> Shot[Velocities]:
        """See `ShootingTask`."""
        return shooting.descend(self.cost, x, lambda values: torch.optim.Adam(values, lr=RATE), iterations, progress)
