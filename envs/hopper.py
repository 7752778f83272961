"""A one-legged hopper in the plane, as Gymnasium's Hopper-v5 has it."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.envs.base import PbfdEnv, Step
from pbfd_torch.models.robots import hopper
from pbfd_torch.models.setup import Setup

FASTEST = 10.0  # of observed velocities [m/s, rad/s]


class HopperEnv(PbfdEnv):
    """Observation `[11]`: height and pitch of the torso, three joint angles, all six velocities, clipped to ±10. Action `[3]`:
    torques from −1 to 1, times 200 N m. Reward: forward velocity over the step + 1 while healthy − 1e-3 ‖action‖². Healthy: height
    above .7, |pitch| < .2, everything but x within ±100."""

    def make_setup(self, dtype: torch.dtype, device: torch.device) -> Setup:
        return hopper(1, dtype, device)

    def observe(self, q: Tensor, v: Tensor) -> Tensor:
        return torch.cat((q[:, 1:], v.clamp(-FASTEST, FASTEST)), -1)

    def healthy(self, q: Tensor, v: Tensor) -> Tensor:
        within = (torch.cat((q[:, 2:], v), -1).abs() < 100).all(-1)
        return within & (q[:, 1] > 0.7) & (q[:, 2].abs() < 0.2)

    def reward(self, step: Step) -> Tensor:
        forward = (step.q[:, 0] - step.before[:, 0]) / step.time
        return forward + self.healthy(step.q, step.v).to(forward.dtype) - 1e-3 * step.action.square().sum(-1)
