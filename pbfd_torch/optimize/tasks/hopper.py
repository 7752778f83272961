"""`hopper`: the one-legged hopper jumps to a height, its controls found by gradients through its foot's contact."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.implicit import Doubtful, Gradients
from pbfd_torch.gradients.trajectory import Trajectory
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.models.robots import hopper
from pbfd_torch.optimize.decision import Controls
from pbfd_torch.optimize.limits import Limits
from pbfd_torch.optimize.shooting import Progress, Shooting
from pbfd_torch.optimize.tasks.task import Outcome
from pbfd_torch.simulator import Simulator

HIGH = 1.4  # where the torso is to be at the end [m]; with straight joints it stands at 1.25 m
NEAR, UPRIGHT = 0.03, 0.3  # [m], [rad] at the end
BENT = (0.2, 0.3)  # [rad] of the hip and the knee at the start
NOISE = 0.1  # of the control limits, for the random controls of the start
RATE = 0.1  # of Adam, likewise
DT, STEPS, HELD = 0.02, 16, 2


@dataclass(frozen=True)
class Hopper:
    """Adam from random controls and bent joints: it passes over the jumps that contacts which come and go make in the derivatives.
    `worlds` ≥ 1; `seed` of the starts."""

    worlds: int = 8
    seed: int = 0
    dtype: torch.dtype = torch.float64
    device: torch.device | str = "cpu"

    def __post_init__(self) -> None:
        if self.worlds < 1:
            raise InputError(f"worlds is {self.worlds}: must be ≥ 1")

    @property
    def criterion(self) -> str:
        """See `Task`."""
        return f"the torso within {100 * NEAR:g} cm of {HIGH:g} m high after {STEPS * DT:g} s, its pitch below {UPRIGHT:g} rad"

    @property
    def iterations(self) -> int:
        """See `Task`."""
        return 20

    def _random(self, *shape: int) -> Tensor:
        """Uniform in 0 … 1, the same for every call."""
        generator = torch.Generator().manual_seed(self.seed)
        return torch.rand(*shape, dtype=torch.float64, generator=generator).to(self.device, self.dtype)

    @property
    def shooting(self) -> Shooting[Velocities]:
        """What moves: .32 s at steps of 20 ms, controls held for two of them."""
        setup = hopper(self.worlds, self.dtype, self.device)
        simulator: Simulator[Velocities] = Simulator(setup.scene, DT, gradients=Gradients(doubtful=Doubtful.ZERO))
        least, most = BENT
        q = setup.q.clone()
        q[:, 3:5] -= least + (most - least) * self._random(self.worlds, 2)
        limits = Limits.within(q.new_ones(setup.scene.nu))
        return Shooting(simulator, Controls(simulator.initial_state(q), limits, STEPS, HELD))

    @property
    def starts(self) -> Tensor:
        """Random controls `[worlds, n]`."""
        count = len(self.shooting.decision.bounds.scale)
        return NOISE * (2 * self._random(self.worlds, count) - 1)

    def cost(self, motion: Trajectory[Velocities], controls: Tensor | None) -> Tensor:
        """Of the torso's height and pitch at the end, ½ Σ of squares in units of the criterion `[*batch]`."""
        return 0.5 * self._away(motion).square().sum(-1)

    def reached(self, motion: Trajectory[Velocities]) -> Tensor:
        """`[*batch]` bool."""
        return (self._away(motion).abs() < 1).all(-1) & motion.solved.all(0)

    def _away(self, motion: Trajectory[Velocities]) -> Tensor:
        _, z, pitch = motion.q[-1, ..., :3].unbind(-1)
        return torch.stack(((z - HIGH) / NEAR, pitch / UPRIGHT), -1)

    def solve(self, iterations: int, progress: Progress | None = None) -> Outcome[Velocities]:
        """See `Task`."""
        shooting, x = self.shooting, self.starts
        shot = shooting.descend(self.cost, x, lambda values: torch.optim.Adam(values, lr=RATE), iterations, progress)
        before, reached = shooting.decision.plan(x), self.reached(shot.trajectory)
        return Outcome(shooting.simulator, before, shot.plan, shot.history, reached, shot.unsolved, shot.doubtful)
