"""An environment ready for training: what is seen is normalised, returns and steps are counted."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.transforms import VecNormV2

from pbfd_torch.envs import ENVIRONMENTS, Randomization, make_env
from pbfd_torch.errors import InputError
from pbfd_torch.learning.networks import SEEN
from pbfd_torch.learning.numbers import require_integer, require_real
from pbfd_torch.stepping.stepper import SHORTEST_STEP

LONGEST_STEP = 1.0  # [s] between actions
_DECAY = 0.99995  # of the running mean and variance, per step of all worlds
_LEAST = 1e-4  # scale


@dataclass(frozen=True)
class EnvSettings:
    """Which environment, and how: see `PbfdEnv`. dtype: "float64" or "float32". randomization: of the worlds in training.

    Raises `InputError` naming the setting that is out of range."""

    name: str
    num_envs: int = 64
    seed: int = 0
    dtype: str = "float64"
    control_dt: float | None = None
    dt: float | None = None
    max_episode_steps: int | None = None
    randomization: Randomization | None = None

    def __post_init__(self) -> None:
        if self.name not in list(ENVIRONMENTS):
            raise InputError(f"no environment named {reprlib.repr(self.name)}: must be one of {', '.join(ENVIRONMENTS)}")
        if self.dtype not in ("float64", "float32"):
            raise InputError(f"dtype is {reprlib.repr(self.dtype)}: must be float64 or float32")
        require_integer("num_envs", self.num_envs, 1, 2**31)
        require_integer("seed", self.seed, 0, 2**64 - 1)
        for name in ("control_dt", "dt"):
            if getattr(self, name) is not None:
                require_real(f"{name} [s]", getattr(self, name), SHORTEST_STEP, LONGEST_STEP)
        if self.max_episode_steps is not None:
            require_integer("max_episode_steps", self.max_episode_steps, 1, 10**6)

    @staticmethod
    def of(saved: Mapping[str, Any]) -> EnvSettings:
        """The settings that `asdict` has made plain. Raises `InputError` for what it has not."""
        if wrong := set(saved) - {x.name for x in fields(EnvSettings)} or {"name"} - set(saved):
            raise InputError(f"the settings of an environment hold or lack {', '.join(sorted(map(str, wrong)))}")
        chances = saved.get("randomization")
        try:
            randomization = None if chances is None else Randomization(**chances)
        except InputError:
            raise
        except (TypeError, ValueError) as error:  # other entries, or of other kinds
            raise InputError(f"randomization is {reprlib.repr(chances)}: {error}") from error
        return EnvSettings(**{**saved, "randomization": randomization})

    def make(self, **changes: Any) -> Any:
        """The environment itself."""
        given = {x.name: getattr(self, x.name) for x in fields(self) if x.name not in ("name", "dtype")}
        return make_env(self.name, dtype=getattr(torch, self.dtype), **(given | changes))


def normaliser(shared: TensorDictBase | None = None) -> VecNormV2:
    """Running mean and variance of what is observed, its own or shared ones."""
    return VecNormV2(["observation"], [SEEN], decay=_DECAY, eps=_LEAST, reduce_batch_dims=True, shared_data=shared)


def location_and_scale(statistics: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
    """What the normaliser subtracts and divides by, `[nobs]` each, from its running sums, which start at zero."""
    loc, var, count = (statistics[name]["observation"] for name in ("loc", "var", "count"))
    weight = 1 - _DECAY ** count.double()
    scale = ((var - loc.square()) / weight).clamp_min(_LEAST**2).sqrt()
    return (loc / weight).float(), scale.float()


def seen_more(statistics: TensorDictBase, observation: Tensor) -> None:
    """Lets the running statistics see `[worlds, nobs]` once more, as the normaliser does at every step."""
    weight = 1 - _DECAY
    statistics["loc"]["observation"].lerp_(observation.mean(0), weight)
    statistics["var"]["observation"].lerp_(observation.square().mean(0), weight)
    statistics["count"]["observation"].add_(1)


def plain(statistics: TensorDictBase) -> dict[str, dict[str, Tensor]]:
    """The statistics as a checkpoint holds them."""
    return {name: {k: v.clone() for k, v in statistics[name].items()} for name in ("loc", "var", "count")}


def training_env(settings: EnvSettings, worker: int = 0, shared: Path | None = None, frozen: bool = False) -> TransformedEnv:
    """The environment of one worker; its seed follows from the settings' and the worker's number. shared: folder of the
    `statistics` that all workers see and add to; frozen: that they only see."""
    norm = normaliser(None if shared is None else TensorDict.load_memmap(shared))
    if frozen:
        norm.freeze()
    env = settings.make(seed=settings.seed + 1000 * worker)
    return TransformedEnv(env, Compose(norm, RewardSum(), StepCounter()))


def statistics(settings: EnvSettings, folder: Path, steps: int = 8) -> TensorDict:
    """Mean and variance of what is observed in the first steps of random actions, as files in a folder that processes share."""
    env = TransformedEnv(settings.make(num_envs=min(settings.num_envs, 256)), normaliser())
    env.rollout(steps, break_when_any_done=False)
    norm = env.transform
    found = TensorDict({"loc": norm._loc, "var": norm._var, "count": norm._count})
    return found.clone().memmap(folder)
