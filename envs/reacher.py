"""An arm of two links reaches for a target in its plane."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pbfd_torch.envs.base import PbfdEnv, Step
from pbfd_torch.envs.upright import MODELS
from pbfd_torch.models.robots import file_setup
from pbfd_torch.models.setup import Setup

LINK = 0.25  # [m]


class ReacherEnv(PbfdEnv):
    """Observation `[8]`: cosine and sine of both angles, both speeds, and the way from the hand to the target [m]. Action `[2]`:
    torques from −1 to 1, times .5 N m. Reward: −the distance [m] − .01 ‖action‖². Episodes end after 100 steps only."""

    task_dt = 0.02
    task_steps = 100

    def make_setup(self, dtype: torch.dtype, device: torch.device) -> Setup:
        return file_setup(MODELS / "reacher.xml", 1, dtype, device)

    def start(self, worlds: int, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Any pose of the arm, and any target within its reach, at rest."""
        share = torch.rand(worlds, 4, generator=random, dtype=torch.float64, device=random.device)
        place = (0.05 + 0.4 * share[:, 2].sqrt(), 2 * math.pi * share[:, 3])
        pose = math.pi * torch.stack((2 * share[:, 0] - 1, 1.6 * share[:, 1] - 0.8), -1)
        target = place[0][:, None] * torch.stack((torch.cos(place[1]), torch.sin(place[1])), -1)
        q = torch.cat((pose, target), -1).to(self.setup.q.dtype)
        return q, torch.zeros_like(q)

    def _way(self, q: Tensor) -> Tensor:
        """From the hand to the target [m]."""
        upper, lower = q[:, 0], q[:, 0] + q[:, 1]
        hand = LINK * torch.stack((torch.cos(upper) + torch.cos(lower), torch.sin(upper) + torch.sin(lower)), -1)
        return q[:, 2:] - hand

    def observe(self, q: Tensor, v: Tensor) -> Tensor:
        return torch.cat((torch.cos(q[:, :2]), torch.sin(q[:, :2]), v[:, :2], self._way(q)), -1)

    def reward(self, step: Step) -> Tensor:
        return -torch.linalg.vector_norm(self._way(step.q), dim=-1) - 0.01 * step.action.square().sum(-1)
