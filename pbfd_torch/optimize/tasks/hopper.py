"""`hopper`: the one-legged hopper jumps from standing to a point in front of it, by gradients through its foot's contact."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.identify.levenberg_marquardt import Stopping
from pbfd_torch.implicit import Doubtful, Gradients
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.models.robots import hopper
from pbfd_torch.optimize.decision import Controls
from pbfd_torch.optimize.limits import Limits
from pbfd_torch.optimize.shooting import Progress, Shooting
from pbfd_torch.optimize.tasks.task import Outcome
from pbfd_torch.simulator import Simulator
from pbfd_torch.trajectory import Trajectory

FORWARD, HIGH = 0.3, 1.5  # where the torso is to be at the end [m]; standing it is at 1.25 m
NEAR, UPRIGHT = 0.02, 0.2  # [m], [rad] at the end
BENT = 0.1  # [rad] of the joints at the start, at most
NOISE = 0.1  # of the control limits, for the random controls of the start
DT, STEPS, HELD = 0.02, 30, 3


@dataclass(frozen=True)
class Hopper:
    """Gauss–Newton from random controls and slightly bent joints. `worlds` ≥ 1; `seed` of the starts."""

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
        goal = f"({FORWARD:g}, {HIGH:g}) m after {STEPS * DT:g} s"
        return f"the torso's x and z within {100 * NEAR:g} cm of {goal}, its pitch below {UPRIGHT:g} rad"

    @property
    def iterations(self) -> int:
        """See `Task`."""
        return 30

    def random(self, *shape: int) -> Tensor:
        """Uniform in 0 … 1, the same for every call."""
        generator = torch.Generator().manual_seed(self.seed)
        return torch.rand(*shape, dtype=torch.float64, generator=generator).to(self.device, self.dtype)

    @property
    def shooting(self) -> Shooting[Velocities]:
        """What moves: .6 s at steps of 20 ms, controls held for three of them."""
        setup = hopper(self.worlds, self.dtype, self.device)
        simulator: Simulator[Velocities] = Simulator(setup.scene, DT, gradients=Gradients(doubtful=Doubtful.ZERO))
        q = setup.q.clone()
        q[:, 3:5] -= BENT * self.random(self.worlds, 2)
        most = q.new_ones(setup.scene.nu)
        return Shooting(simulator, Controls(simulator.initial_state(q), Limits.within(most), STEPS, HELD))

    def residual(self, motion: Trajectory[Velocities], controls: Tensor | None) -> Tensor:
        """Of the torso at the end, in units of the criterion `[*batch, 3]`: forward, upward, pitch."""
        goal = motion.q.new_tensor([FORWARD, HIGH, 0.0])
        return (motion.q[-1, ..., :3] - goal) / motion.q.new_tensor([NEAR, NEAR, UPRIGHT])

    def reached(self, motion: Trajectory[Velocities]) -> Tensor:
        """`[*batch]` bool."""
        return (self.residual(motion, None).abs() < 1).all(-1) & motion.solved.all(0)

    def solve(self, iterations: int, progress: Progress | None = None) -> Outcome[Velocities]:
        """See `Task`."""
        shooting = self.shooting
        x = NOISE * (2 * self.random(self.worlds, len(shooting.decision.bounds.scale)) - 1)
        shot = shooting.gauss_newton(self.residual, x, Stopping(iterations), progress)
        before, reached = shooting.decision.plan(x), self.reached(shot.trajectory)
        return Outcome(shooting.simulator, before, shot.plan, shot.history, reached, shot.unsolved, shot.doubtful)
