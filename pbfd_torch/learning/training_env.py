"""An environment ready for training: what is seen is normalised, returns and steps are counted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.transforms import VecNormV2

from pbfd_torch.envs import make_env
from pbfd_torch.learning.networks import SEEN

_DECAY = 0.99995  # of the running mean and variance, per step of all worlds


@dataclass(frozen=True)
class EnvSettings:
    """Which environment, and how: see `PbfdEnv`. dtype: "float64" or "float32"."""

    name: str
    num_envs: int = 1024
    seed: int = 0
    dtype: str = "float64"
    control_dt: float | None = None
    dt: float | None = None

    def make(self, **changes: Any) -> Any:
        """The environment itself."""
        given = {"num_envs": self.num_envs, "seed": self.seed, "control_dt": self.control_dt, "dt": self.dt}
        return make_env(self.name, dtype=getattr(torch, self.dtype), **(given | changes))


def normaliser(shared: TensorDictBase | None = None) -> VecNormV2:
    """Running mean and variance of what is observed, its own or shared ones."""
    return VecNormV2(["observation"], [SEEN], decay=_DECAY, reduce_batch_dims=True, shared_data=shared)


def training_env(
    settings: EnvSettings, worker: int = 0, shared: TensorDictBase | None = None, frozen: bool = False
) -> TransformedEnv:
    """The environment of one worker; its seed follows from the settings' and the worker's number."""
    norm = normaliser(shared)
    if frozen:
        norm.freeze()
    env = settings.make(seed=settings.seed + 1000 * worker)
    return TransformedEnv(env, Compose(norm, RewardSum(), StepCounter()))


def statistics(settings: EnvSettings, steps: int = 8) -> TensorDict:
    """Mean and variance of what is observed in the first steps of random actions, in shared memory."""
    env = TransformedEnv(settings.make(num_envs=min(settings.num_envs, 256)), normaliser())
    env.rollout(steps, break_when_any_done=False)
    norm = env.transform
    found = TensorDict({"loc": norm._loc, "var": norm._var, "count": norm._count})
    return found.clone().share_memory_()
