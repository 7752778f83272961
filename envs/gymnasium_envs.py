"""The environments as Gymnasium knows them: one world, or a vector of them, on numpy arrays."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

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
        """`seed`: starts the sequence of starts anew."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        self._now = self.env.reset()
        return self._now["observation"][0].numpy(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """See `PbfdEnv`."""
        self._now["action"] = torch.as_tensor(np.asarray(action, np.float32)).reshape(1, -1)
        after = self.env.step(self._now)["next"]
        self._now = after.select("observation", "state", "done", "terminated", "truncated")
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
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """All worlds; `seed`: one number for all of them together."""
        if isinstance(seed, int):
            self.env.set_seed(seed)
        self._now = self.env.reset()
        self._ended = torch.zeros_like(self._ended)
        return self._now["observation"].numpy(), {}

    def step(self, actions: Array) -> tuple[Array, Any, Any, Any, dict[str, Any]]:
        """See `PbfdEnv`."""
        self._now["action"] = torch.as_tensor(np.asarray(actions, np.float32))
        after = self.env.step(self._now)["next"]
        if bool(self._ended.any()):
            fresh = self.env._reset(after.empty().set("_reset", self._ended))
            again = self._ended.squeeze(-1)
            after = torch.where(again, fresh.set("reward", torch.zeros_like(after["reward"])), after)
        self._now = after.select("observation", "state", "done", "terminated", "truncated")
        self._ended = after["terminated"] | after["truncated"]
        columns = (after[name].squeeze(-1).numpy() for name in ("reward", "terminated", "truncated", "unsolved"))
        reward, terminated, truncated, unsolved = columns
        return after["observation"].numpy(), reward, terminated, truncated, {"unsolved": unsolved}
