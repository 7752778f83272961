"""Environments for torchrl, and for Gymnasium through its registry. Importing this package imports torchrl. Built on the simulator
and the named scenes; `learning` trains in them."""

from __future__ import annotations

from pbfd_torch.envs.base import Outcome, PbfdEnv, Step
from pbfd_torch.envs.cart_pole import CartPoleEnv
from pbfd_torch.envs.gymnasium_envs import register
from pbfd_torch.envs.hopper import HopperEnv
from pbfd_torch.envs.hopper3d import Hopper3dEnv
from pbfd_torch.envs.named import ENVIRONMENTS, make_env
from pbfd_torch.envs.push_box import PushBoxEnv
from pbfd_torch.envs.randomization import Randomization
from pbfd_torch.envs.reacher import ReacherEnv
from pbfd_torch.envs.walker import WalkerEnv
from pbfd_torch.envs.walker3d import Walker3dEnv

__all__ = [
    "ENVIRONMENTS",
    "CartPoleEnv",
    "Hopper3dEnv",
    "HopperEnv",
    "Outcome",
    "PbfdEnv",
    "PushBoxEnv",
    "Randomization",
    "ReacherEnv",
    "Step",
    "Walker3dEnv",
    "WalkerEnv",
    "make_env",
    "register",
]

register()
