"""A two-legged walker in the plane, as Gymnasium's Walker2d-v5 has it."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.envs.base import PbfdEnv, Step
from pbfd_torch.envs.hopper import FASTEST
from pbfd_torch.models.robots import walker
from pbfd_torch.models.setup import Setup


class WalkerEnv(PbfdEnv):
    """Observation `[17]`: height and pitch of the torso, six joint angles, all nine velocities, clipped to ±10. Action `[6]`:
    torques from −1 to 1, times 100 N m. Reward: forward velocity over the step + 1 while healthy − 1e-3 ‖action‖². Healthy: height
    from .8 to 2, |pitch| < 1."""

    def make_setup(self, dtype: torch.dtype, device: torch.device) -> Setup:
        return walker(1, dtype, device)

    def observe(self, q: Tensor, v: Tensor) -> Tensor:
        return torch.cat((q[:, 1:], v.clamp(-FASTEST, FASTEST)), -1)

    def healthy(self, q: Tensor, v: Tensor) -> Tensor:
        return (q[:, 1] > 0.8) & (q[:, 1] < 2.0) & (q[:, 2].abs() < 1.0)

    def reward(self, step: Step) -> Tensor:
        forward = (step.q[:, 0] - step.before[:, 0]) / step.time
        return forward + self.healthy(step.q, step.v).to(forward.dtype) - 1e-3 * step.action.square().sum(-1)
