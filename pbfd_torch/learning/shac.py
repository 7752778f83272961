"""A short-horizon actor–critic that follows the simulator's gradients, after Xu et al. (2022).

The actor climbs the return of a few steps plus the critic's value of where they lead, differentiated through the simulation; the
critic learns returns over the same steps, TD(λ), as seen by a slowly following copy of itself. It gives returns as a mean reward,
(1 − γ) times their sum, which is of the size of what a fresh network gives.
"""

from __future__ import annotations

import copy
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.implicit import Doubtful, Gradients
from pbfd_torch.learning import curve
from pbfd_torch.learning.networks import SEEN
from pbfd_torch.learning.settings import Settings
from pbfd_torch.learning.trainer import Progress, Trainer
from pbfd_torch.learning.training_env import location_and_scale, plain, seen_more
from pbfd_torch.solvers.per_world import chosen, mapped


@dataclass(frozen=True, kw_only=True)
class Shac(Settings):
    """Attributes:
    horizon: steps that gradients go through. epochs: of the critic.
    actor_rate, critic_rate: learning rates.
    following: how much of the critic's copy stays in each update. largest: norm that gradients of the actor are cut to.

    See `Settings` for the others.
    """

    horizon: int = 16
    epochs: int = 8
    decay: int = 1_000_000
    gamma: float = 0.99
    actor_rate: float = 2e-3
    critic_rate: float = 2e-3
    following: float = 0.4
    largest: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.env.randomization is not None:
            raise InputError("randomization is given: gradients are followed through the scene as it is, so it must be None")


@dataclass(frozen=True, eq=False)
class _Leg:
    """What the critic learns from, `[horizon, worlds, …]`: what was seen before and after each step, reward, and how it ended."""

    seen: Tensor
    after: Tensor
    reward: Tensor
    terminated: Tensor
    ended: Tensor


class ShacTrainer(Trainer[Shac]):
    """See `Trainer`."""

    method = "SHAC"

    def __init__(self, settings: Shac, path: Path, resume: bool = False) -> None:
        worlds = settings.env.num_envs
        super().__init__(settings, path, resume, worlds)
        # a step without a derivative ends those of its world, and no other's
        self.env.simulator.gradients = Gradients(Doubtful.ZERO)
        self.target = copy.deepcopy(self.critic)
        self.actor_optimiser = torch.optim.Adam(self.actor.parameters(), settings.actor_rate, betas=(0.7, 0.95))
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), settings.critic_rate, betas=(0.7, 0.95))
        self._keep(target=self.target, actor_optimiser=self.actor_optimiser, critic_optimiser=self.critic_optimiser)
        self._state, self._observation = self.env.starts(worlds)
        self._steps, self._return = torch.zeros(worlds, dtype=torch.int64), torch.zeros(worlds)

    def run(self, frames: int, minutes: float = math.inf, progress: Progress | None = None) -> list[curve.Row]:
        """See `PpoTrainer.run`."""
        started = time.perf_counter() - self.folder.seconds
        try:
            while self.folder.frames < frames and self.folder.seconds < 60 * minutes:
                fall = self.folder.fall(self.settings.decay)
                for optimiser, rate in (
                    (self.actor_optimiser, self.settings.actor_rate),
                    (self.critic_optimiser, self.settings.critic_rate),
                ):
                    optimiser.param_groups[0]["lr"] = fall * rate
                leg, row = self._act()
                loss = self._judge(leg)
                self.folder.seconds = time.perf_counter() - started
                self._save(curve.Row(seconds=self.folder.seconds, loss=loss, **row), progress)
        finally:
            self.folder.draw()
        return self.folder.rows

    def _value(self, critic: Any, seen: Tensor) -> Tensor:
        return critic(TensorDict({SEEN: seen}, seen.shape[:-1]))["state_value"].squeeze(-1)

    def _act(self) -> tuple[_Leg, dict[str, Any]]:
        """Some steps, and one of the actor along their gradient."""
        s, env = self.settings, self.env
        loc, scale = location_and_scale(plain(self.shared))
        state, observation = self._state, self._observation
        worlds = s.env.num_envs
        gain, discount = torch.zeros(worlds), torch.ones(worlds)
        parts: list[tuple[Tensor, ...]] = []
        returns, lengths, unsolved = [], [], 0
        for k in range(s.horizon):
            seen_more(self.shared, observation.detach().float())
            seen = (observation.float() - loc) / scale
            action = self.actor.get_dist(TensorDict({SEEN: seen}, [worlds])).rsample()
            outcome = env.advanced(state, action)
            self._steps = self._steps + 1
            truncated = (self._steps >= env.max_episode_steps) & ~outcome.terminated
            ended = outcome.terminated | truncated
            after = (outcome.observation.float() - loc) / scale
            reward = outcome.reward.float()
            gain = gain + discount * reward
            last = torch.full_like(ended, k == s.horizon - 1)
            ahead = torch.where(outcome.terminated, 0.0, self._value(self.target, after)) / (1 - s.gamma)
            gain = gain + torch.where(ended | last, discount * s.gamma * ahead, 0.0)
            discount = torch.where(ended, 1.0, discount * s.gamma)
            parts.append((seen.detach(), after.detach(), reward.detach(), outcome.terminated, ended))
            self._return += reward.detach()
            unsolved += int(outcome.unsolved.sum())
            returns.append(self._return[ended].clone())
            lengths.append(self._steps[ended].float())
            state, observation = outcome.state, outcome.observation
            if bool(ended.any()):
                fresh, begun = env.starts(worlds)
                state = chosen(ended, fresh, state)
                observation = torch.where(ended[:, None], begun, observation)
                self._steps = torch.where(ended, 0, self._steps)
                self._return = torch.where(ended, 0.0, self._return)
        self._state, self._observation = mapped(lambda x: x.detach(), state), observation.detach()
        self.actor_optimiser.zero_grad()
        (-gain.mean() / s.horizon).backward()
        for parameter in self.actor.parameters():  # a step at the edge of being singular must not undo what was learnt
            if parameter.grad is not None:
                parameter.grad.nan_to_num_(0.0, 0.0, 0.0)
        torch.nn.utils.clip_grad_norm_(self.actor.parameters(), s.largest)
        self.actor_optimiser.step()
        leg = _Leg(*(torch.stack(x) for x in zip(*parts, strict=True)))
        return leg, {
            "frames": self.folder.frames + worlds * s.horizon,
            "reward": float(leg.reward.mean()),
            "unsolved": unsolved / (worlds * s.horizon),
            **curve.of_episodes(torch.cat(returns), torch.cat(lengths)),
        }

    def _judge(self, leg: _Leg) -> float:
        """The critic learns TD(λ) returns; its copy follows. The last loss."""
        s = self.settings
        with torch.no_grad():
            ahead = torch.where(leg.terminated, 0.0, self._value(self.target, leg.after))
            goals = [ahead[-1]]
            for k in reversed(range(s.horizon)):
                carried = torch.where(leg.ended[k], ahead[k], (1 - s.lmbda) * ahead[k] + s.lmbda * goals[-1])
                goals.append((1 - s.gamma) * leg.reward[k] + s.gamma * carried)
            goal = torch.stack(goals[:0:-1]).flatten()
        seen = leg.seen.flatten(0, 1)
        last = math.nan
        for _ in range(s.epochs):
            for part in torch.randperm(len(goal)).chunk(4):
                loss = torch.nn.functional.mse_loss(self._value(self.critic, seen[part]), goal[part])
                self.critic_optimiser.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.critic.parameters(), s.largest)
                self.critic_optimiser.step()
                last = float(loss.detach())
        with torch.no_grad():
            for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                slow.lerp_(fast, 1 - s.following)
        return last
