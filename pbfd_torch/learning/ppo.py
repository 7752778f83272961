"""Proximal policy optimisation from torchrl's own parts: collector, GAE, clipped loss."""

from __future__ import annotations

import functools
import importlib.util
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from pbfd_torch.errors import InputError
from pbfd_torch.learning import curve
from pbfd_torch.learning.networks import SEEN
from pbfd_torch.learning.settings import Settings
from pbfd_torch.learning.trainer import Progress, Trainer
from pbfd_torch.learning.training_env import training_env


@dataclass(frozen=True, kw_only=True)
class Ppo(Settings):
    """Attributes:
    minibatch, learning_rate, clip, entropy: the usual ones.
    workers: processes that collect, each with `env.num_envs` worlds. ray: remote collectors instead, on one machine or many.

    See `Settings` for the others.
    """

    counts: ClassVar[tuple[str, ...]] = (*Settings.counts, "minibatch", "workers")

    horizon: int = 32
    epochs: int = 10
    decay: int = 400_000
    gamma: float = 0.995
    minibatch: int = 64
    learning_rate: float = 3e-4
    clip: float = 0.2
    entropy: float = 0.0
    workers: int = 1
    ray: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ray < 0 or (self.ray and self.workers > 1):
            raise InputError(f"ray is {self.ray} and workers {self.workers}: give one of the two")
        if self.ray and importlib.util.find_spec("ray") is None:
            raise InputError(f"ray is {self.ray}, but the package ray is not installed: pip install 'pbfd_torch[ray]'")

    @property
    def frames_per_batch(self) -> int:
        return self.env.num_envs * self.horizon * max(self.workers, self.ray)


class PpoTrainer(Trainer[Ppo]):
    """See `Trainer`. Its own world is a probe: what collects has others."""

    method = "PPO"

    def __init__(self, settings: Ppo, path: Path, resume: bool = False) -> None:
        super().__init__(settings, path, resume, worlds=1)
        self.advantage = GAE(gamma=settings.gamma, lmbda=settings.lmbda, value_network=self.critic, average_gae=False)
        self.loss = ClipPPOLoss(
            self.actor, self.critic, clip_epsilon=settings.clip, entropy_coeff=settings.entropy, normalize_advantage=True
        )
        self.optimiser = torch.optim.Adam(self.loss.parameters(), settings.learning_rate, eps=1e-5)
        self._keep(optimiser=self.optimiser)
        self.settings = replace(settings, env=replace(settings.env, seed=self._seed))

    def _collector(self) -> Any:
        s = self.settings
        makers = [
            functools.partial(training_env, s.env, k, Path(self._memory.name), bool(s.ray)) for k in range(max(s.workers, s.ray))
        ]
        common: dict[str, Any] = {"frames_per_batch": s.frames_per_batch, "total_frames": -1}
        if s.ray:
            from torchrl.collectors.distributed import RayCollector

            common["total_frames"] = 10**12  # it knows no endless collecting
            return RayCollector(makers, self.actor, sync=True, num_collectors=s.ray, update_after_each_batch=True, **common)
        if s.workers > 1:
            return MultiSyncCollector(makers, self.actor, cat_results=0, update_at_each_batch=True, num_threads=1, **common)
        return Collector(makers[0](), self.actor, **common)

    def run(self, frames: int, minutes: float = math.inf, progress: Progress | None = None) -> list[curve.Row]:
        """Trains until so many environment steps, or minutes in all, are reached. Interrupted, it keeps what the last batch
        left."""
        collector = self._collector()
        started = time.perf_counter() - self.folder.seconds
        try:
            for batch in collector:
                loss = self._learn(batch)
                self.folder.seconds = time.perf_counter() - started
                self._save(_row(batch, self.folder.frames, self.folder.seconds, loss), progress)
                if self.settings.workers > 1 or self.settings.ray:
                    collector.update_policy_weights_()
                if self.folder.frames >= frames or self.folder.seconds >= 60 * minutes:
                    break
        finally:
            collector.shutdown()
            self.folder.draw()
        return self.folder.rows

    def _learn(self, batch: TensorDictBase) -> float:
        """Some epochs over a batch `[worlds, steps]`; the last loss."""
        s = self.settings
        self.optimiser.param_groups[0]["lr"] = s.learning_rate * self.folder.fall(s.decay)
        last = math.nan
        # the critic learns a mean reward, not a sum of 1 / (1 − γ) of them: numbers that a fresh network gives
        batch = batch.clone(recurse=False)
        batch["next", "reward"] = (1 - s.gamma) * batch["next", "reward"]
        keys = [SEEN, "action", "action_log_prob", "loc", "scale", "reward", "done", "terminated"]
        for _ in range(s.epochs):
            with torch.no_grad():
                self.advantage(batch)
            flat = batch.select(*keys, "advantage", "value_target", "state_value", strict=False).reshape(-1)
            for part in flat[torch.randperm(len(flat))].split(s.minibatch):
                losses = self.loss(part)
                total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
                self.optimiser.zero_grad()
                total.backward()
                torch.nn.utils.clip_grad_norm_(self.loss.parameters(), 0.5)
                self.optimiser.step()
                last = float(total.detach())
        return last


def _row(batch: TensorDictBase, frames: int, seconds: float, loss: float) -> curve.Row:
    end = batch["next", "done"].squeeze(-1)
    returns = batch["next", "episode_reward"].squeeze(-1)[end]
    lengths = batch["next", "step_count"].squeeze(-1)[end].float()
    return curve.Row(
        frames=frames + batch.numel(),
        seconds=seconds,
        reward=float(batch["next", "reward"].mean()),
        unsolved=float(batch["next", "unsolved"].float().mean()),
        loss=loss,
        **curve.of_episodes(returns, lengths),
    )
