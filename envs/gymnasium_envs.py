"""The environments as Gymnasium knows them: one world, or a vector of them, on numpy arrays."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from pbfd_torch.envs.seeds import checked_seed, checked_seeds
from pbfd_torch.errors import InputError

PREFIX = "pbfd"
IDS = {
    "Hopper-v0": "hopper",
    "Walker-v0": "walker",
    "Hopper3d-v0": "hopper-3d",
    "Walker3d-v0": "walker-3d",
    "CartPole-v0": "cart-pole",
    "Reacher-v0": "reacher",
    "PushBox-v0": "push-box",
}
Array = NDArray[np.float32]
_KEPT = ("observation", "state", "done", "terminated", "truncated")  # of a step, to go on from


def register() -> None:
    """Makes `gymnasium.make("pbfd/Hopper-v0")` and `gymnasium.make_vec` work, and torchrl's `GymEnv`; twice is no error."""
    for name, env in IDS.items():
        if f"{PREFIX}/{name}" not in gymnasium.registry:
            gymnasium.register(
                f"{PREFIX}/{name}",
                entry_point="pbfd_torch.envs.gymnasium_envs:PbfdGymEnv",
                vector_entry_point="pbfd_torch.envs.gymnasium_envs:PbfdVectorEnv",
                kwargs={"name": env},
            )


def _spaces(env: Any) -> tuple[Box, Box]:
    spec = env.action_spec.space
    low, high = (x[0].numpy() for x in (spec.low, spec.high))
    width = env.observation_spec["observation"].shape[-1]
    return Box(-np.inf, np.inf, (width,), np.float32), Box(low, high, dtype=np.float32)


def _checked(action: Any, now: Any, shape: Any) -> torch.Tensor:
    """An action as float32, for a step from `now`."""
    if now is None:
        raise InputError("step before the first reset: call reset, then step")
    try:
        found = np.asarray(action)
    except (TypeError, ValueError) as error:  # rows of different lengths
        raise InputError(f"action is {reprlib.repr(action)}: must be an array of shape {shape}") from error
    if found.dtype.kind not in "fiu":
        raise InputError(f"action is of {found.dtype}: must be of numbers")
    if found.shape != shape:
        raise InputError(f"action has shape {found.shape}: must be {shape}")
    with np.errstate(over="ignore"):  # infinite, and clipped
        return torch.from_numpy(found.astype(np.float32))


class PbfdGymEnv(gymnasium.Env[Array, Array]):
    """One world of a named environment; arguments as of `PbfdEnv` but num_envs. `info` says whether a step was "unsolved"."""

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(self, name: str, render_mode: None = None, **arguments: Any) -> None:
        from pbfd_torch.envs.named import make_env

        self.env = make_env(name, num_envs=1, **arguments)
        self.observation_space: Any
        self.action_space: Any
        self.observation_space, self.action_space = _spaces(self.env)
        self.render_mode = render_mode
        self._now: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """`seed`: starts the sequence of starts anew. Raises `InputError` for what is no seed."""
        if seed is not None:
            seed = checked_seed(seed)
            self.env.set_seed(seed)
        super().reset(seed=seed)
        self._now = self.env.reset()
        return self._now["observation"][0].numpy(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """See `PbfdEnv`. Raises `InputError` before the first reset, and for actions of another shape or kind."""
        self._now["action"] = _checked(action, self._now, self.action_space.shape)[None]
        after = self.env.step(self._now)["next"]
        self._now = after.select(*_KEPT)
        ended = bool(after["terminated"]), bool(after["truncated"])
        return after["observation"][0].numpy(), float(after["reward"]), *ended, {"unsolved": bool(after["unsolved"])}


class PbfdVectorEnv(VectorEnv[Array, Array, Array]):
    """Many worlds as one batch. A world whose episode has ended is reset with its next step, whose action it ignores."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(self, name: str, num_envs: int = 1, render_mode: None = None, **arguments: Any) -> None:
        from pbfd_torch.envs.named import make_env

        self.env = make_env(name, num_envs=num_envs, **arguments)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = _spaces(self.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._now: Any = None
        self._ended = torch.zeros(num_envs, 1, dtype=torch.bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """`seed`: one number for all worlds together, or one for each (`PbfdEnv.set_seeds`). `options["reset_mask"]`: `[num_envs]`
        bool, which worlds; the others go on where they are. Raises `InputError` for wrong ones."""
        mask = self._mask((options or {}).get("reset_mask"))
        seeds = checked_seeds(seed, self.num_envs)
        if isinstance(seeds, list):
            self.env.set_seeds(seeds)
        elif seeds is not None:
            self.env.set_seed(seeds)
        if self._now is None or bool(mask.all()):
            self._now = self.env.reset().select(*_KEPT)
        elif bool(mask.any()):
            self._now = self._restarted(mask, self._now)
        self._ended = self._ended & ~mask
        return self._now["observation"].numpy(), {}

    def _mask(self, given: Any) -> torch.Tensor:
        if given is None:
            return torch.ones_like(self._ended)
        mask = np.asarray(given)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise InputError(
                f"reset_mask is of {mask.dtype} with shape {mask.shape}: must be of bool with shape ({self.num_envs},)"
            )
        if self._now is None and not mask.all():
            raise InputError(f"reset_mask names {mask.sum()} of {self.num_envs} worlds: all of them must be reset first")
        return torch.from_numpy(mask.copy())[:, None]

    def _restarted(self, mask: torch.Tensor, now: Any) -> Any:
        """The tensordict in which the worlds of a mask `[num_envs, 1]` begin anew."""
        fresh = self.env._reset(now.empty().set("_reset", mask))
        return torch.where(mask.squeeze(-1), fresh.select(*now.keys()), now)

    def step(self, actions: Array) -> tuple[Array, Any, Any, Any, dict[str, Any]]:
        """See `PbfdEnv`. Raises `InputError` before the first reset, and for actions of another shape or kind."""
        self._now["action"] = _checked(actions, self._now, self.action_space.shape)
        after = self.env.step(self._now)["next"]
        if bool(self._ended.any()):
            none = torch.where(self._ended, 0.0, after["reward"])
            after = self._restarted(self._ended, after.exclude("reward")).set("reward", none)
        self._now = after.select(*_KEPT)
        self._ended = after["terminated"] | after["truncated"]
        columns = (after[name].squeeze(-1).numpy() for name in ("reward", "terminated", "truncated", "unsolved"))
        reward, terminated, truncated, unsolved = columns
        return after["observation"].numpy(), reward, terminated, truncated, {"unsolved": unsolved}
