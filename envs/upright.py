"""What robots with a free base share: how they stand, and what is seen of them."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from pbfd_torch import models
from pbfd_torch.envs.base import PbfdEnv, Step
from pbfd_torch.models.robots import file_setup
from pbfd_torch.models.setup import Setup
from pbfd_torch.tree.rotations import quaternion_matrix

MODELS = Path(models.__file__).parent
FASTEST = 10.0  # of observed velocities [m/s, rad/s]


class UprightEnv(PbfdEnv):
    """A robot whose free base comes first in q. Observation: height and the world's vertical as the torso sees it, joint angles,
    the torso's velocity and spin in its own axes, joint velocities, all clipped to ±10. Reward: forward velocity, at most
    `fastest`, + 1 while healthy − ½ the sideways velocity − 1e-3 ‖action‖². Healthy: height above `lowest`, the torso within 1 rad
    of upright."""

    file = ""
    planar = False
    lowest = 0.8
    fastest = 3.0

    def make_setup(self, dtype: torch.dtype, device: torch.device) -> Setup:
        return file_setup(MODELS / self.file, 1, dtype, device)

    def observe(self, q: Tensor, v: Tensor) -> Tensor:
        turn = quaternion_matrix(torch.nn.functional.normalize(q[:, 3:7], dim=-1))
        along = (turn.mT @ v[:, :3, None]).squeeze(-1)  # the spin is in the torso's axes already
        return torch.cat((q[:, 2:3], turn[:, 2], q[:, 7:], torch.cat((along, v[:, 3:]), -1).clamp(-FASTEST, FASTEST)), -1)

    def healthy(self, q: Tensor, v: Tensor) -> Tensor:
        upright = 1 - 2 * (q[:, 4].square() + q[:, 5].square())  # of the torso's z axis with the world's
        return (q[:, 2] > self.lowest) & (q[:, 2] < 2.0) & (upright > 0.54)

    def reward(self, step: Step) -> Tensor:
        forward, sideways = ((step.q[:, :2] - step.before[:, :2]) / step.time).unbind(-1)
        alive = self.healthy(step.q, step.v).to(forward.dtype)
        return forward.clamp_max(self.fastest) + alive - 0.5 * sideways.abs() - 1e-3 * step.action.square().sum(-1)
