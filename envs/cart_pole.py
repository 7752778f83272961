"""A pole balanced on a cart."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.envs.base import PbfdEnv, Step
from pbfd_torch.envs.upright import MODELS
from pbfd_torch.models.robots import file_setup
from pbfd_torch.models.setup import Setup


class CartPoleEnv(PbfdEnv):
    """Observation `[4]`: place, angle from upright, and their velocities. Action `[1]`: force from −1 to 1, times 10 N. Reward: 1 a
    step. Healthy: within 2.3 m of the middle, and .3 rad of upright."""

    task_dt = 0.02
    task_steps = 500
    noise = 0.05

    def make_setup(self, dtype: torch.dtype, device: torch.device) -> Setup:
        return file_setup(MODELS / "cart_pole.xml", 1, dtype, device)

    def observe(self, q: Tensor, v: Tensor) -> Tensor:
        return torch.cat((q, v), -1)

    def healthy(self, q: Tensor, v: Tensor) -> Tensor:
        return (q[:, 0].abs() < 2.3) & (q[:, 1].abs() < 0.3)

    def reward(self, step: Step) -> Tensor:
        return torch.ones_like(step.q[:, 0])
