"""The environments by name."""

from __future__ import annotations

from typing import Any

from pbfd_torch.envs.base import PbfdEnv
from pbfd_torch.envs.cart_pole import CartPoleEnv
from pbfd_torch.envs.hopper import HopperEnv
from pbfd_torch.envs.hopper3d import Hopper3dEnv
from pbfd_torch.envs.push_box import PushBoxEnv
from pbfd_torch.envs.reacher import ReacherEnv
from pbfd_torch.envs.walker import WalkerEnv
from pbfd_torch.envs.walker3d import Walker3dEnv
from pbfd_torch.errors import InputError

ENVIRONMENTS: dict[str, type[PbfdEnv]] = {
    "hopper": HopperEnv,
    "walker": WalkerEnv,
    "hopper-3d": Hopper3dEnv,
    "walker-3d": Walker3dEnv,
    "cart-pole": CartPoleEnv,
    "reacher": ReacherEnv,
    "push-box": PushBoxEnv,
}


def make_env(name: str, **arguments: Any) -> PbfdEnv:
    """An environment by name; raises `InputError` for an unknown one. Arguments: see `PbfdEnv`."""
    return env_class(name)(**arguments)


def env_class(name: str) -> type[PbfdEnv]:
    """The class of an environment by name; raises `InputError` for an unknown one."""
    if name not in ENVIRONMENTS:
        raise InputError(f"no environment named '{name}': must be one of {', '.join(ENVIRONMENTS)}")
    return ENVIRONMENTS[name]
