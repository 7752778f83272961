"""An arm pushes a box to a place on a table, over friction."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.envs.base import PbfdEnv, Step
from pbfd_torch.envs.upright import MODELS
from pbfd_torch.models.robots import file_setup
from pbfd_torch.models.setup import Setup

GOAL = (0.45, -0.25)  # [m]
UPPER, LOWER = 0.35, 0.3


class PushBoxEnv(PbfdEnv):
    """Observation `[14]`: cosine and sine of both angles, their speeds, hand, box and way from the box to the goal [m] in the
    plane, and the box's velocity. Action `[2]`: torques from −1 to 1, times 8 N m. Reward: −the box's distance from the goal − .2
    that of the hand from the box [m] − .01 ‖action‖². Healthy: the box on the table, within 1 m."""

    task_dt = 0.02
    task_steps = 150

    def make_setup(self, dtype: torch.dtype, device: torch.device) -> Setup:
        return file_setup(MODELS / "push_box.xml", 1, dtype, device)

    def start(self, worlds: int, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """The arm near its rest, the box anywhere in 10 cm around its own."""
        q, v = (x.expand(worlds, -1).clone() for x in (self.setup.q, self.setup.v))
        share = 2 * torch.rand(worlds, 4, generator=random, dtype=torch.float64, device=random.device).to(q.dtype) - 1
        q[:, :4] += q.new_tensor([0.1, 0.1, 0.05, 0.05]) * share
        return q, v

    def _hand(self, q: Tensor) -> Tensor:
        upper, lower = q[:, 0], q[:, 0] + q[:, 1]
        x = UPPER * torch.cos(upper) + LOWER * torch.cos(lower)
        return torch.stack((x, UPPER * torch.sin(upper) + LOWER * torch.sin(lower)), -1)

    def _left(self, q: Tensor) -> Tensor:
        return q.new_tensor(GOAL) - q[:, 2:4]

    def observe(self, q: Tensor, v: Tensor) -> Tensor:
        angles = q[:, :2]
        return torch.cat((torch.cos(angles), torch.sin(angles), v[:, :2], self._hand(q), q[:, 2:4], self._left(q), v[:, 2:4]), -1)

    def healthy(self, q: Tensor, v: Tensor) -> Tensor:
        return (q[:, 4] > 0) & (q[:, 2:4].abs() < 1.0).all(-1)

    def reward(self, step: Step) -> Tensor:
        left = torch.linalg.vector_norm(self._left(step.q), dim=-1)
        away = torch.linalg.vector_norm(self._hand(step.q) - step.q[:, 2:4], dim=-1)
        return -left - 0.2 * away - 0.01 * step.action.square().sum(-1)
