"""Proximal policy optimisation from torchrl's own parts: collector, GAE, clipped loss."""

from __future__ import annotations

import functools
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from pbfd_torch.errors import InputError
from pbfd_torch.learning import curve
from pbfd_torch.learning.networks import SEEN, make_actor, make_critic
from pbfd_torch.learning.training_env import EnvSettings, statistics, training_env

FORMAT = "pbfd_torch policy 1"
CHECKPOINT, CURVE, PICTURE = "checkpoint.pt", "curve.csv", "curve.png"


@dataclass(frozen=True)
class Ppo:
    """Attributes:
    env: where.
    horizon: steps of each world per batch. epochs, minibatch: of the updates.
    learning_rate, gamma, lmbda, clip, entropy, width: the usual ones; width: of both networks' two hidden layers.
    workers: processes that collect, each with `env.num_envs` worlds. ray: remote collectors instead, on one machine or many.
    """

    env: EnvSettings
    horizon: int = 16
    epochs: int = 6
    minibatch: int = 4096
    learning_rate: float = 5e-4
    gamma: float = 0.99
    lmbda: float = 0.95
    clip: float = 0.2
    entropy: float = 1e-3
    width: int = 64
    workers: int = 1
    ray: int = 0

    def __post_init__(self) -> None:
        for name in ("horizon", "epochs", "minibatch", "width", "workers"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}: must be ≥ 1")
        if self.ray < 0 or (self.ray and self.workers > 1):
            raise InputError(f"ray is {self.ray} and workers {self.workers}: give one of the two")

    @property
    def frames_per_batch(self) -> int:
        return self.env.num_envs * self.horizon * max(self.workers, self.ray)


class Trainer:
    """Trains into a folder: checkpoint, curve and picture, written after every batch as a whole or not at all.

    A folder that holds a checkpoint is gone on with where `resume` is set, and refused otherwise. What was learnt, the optimiser, the
    statistics and the curve go on where they were; episodes under way begin anew."""

    def __init__(self, settings: Ppo, folder: Path, resume: bool = False) -> None:
        self.folder, self.settings = folder, settings
        saved = folder / CHECKPOINT
        if saved.exists() and not resume:
            raise InputError(f"'{folder}' holds a training already: resume it, or choose another folder")
        folder.mkdir(parents=True, exist_ok=True)
        torch.manual_seed(settings.env.seed)
        probe = settings.env.make(num_envs=1)
        width = probe.observation_spec["observation"].shape[-1]
        self.actor = make_actor(width, probe.action_spec, settings.width)
        self.critic = make_critic(width, settings.width)
        self.advantage = GAE(gamma=settings.gamma, lmbda=settings.lmbda, value_network=self.critic, average_gae=False)
        self.loss = ClipPPOLoss(
            self.actor, self.critic, clip_epsilon=settings.clip, entropy_coeff=settings.entropy, normalize_advantage=True
        )
        self.optimiser = torch.optim.Adam(self.loss.parameters(), settings.learning_rate, eps=1e-5)
        self.rows: list[curve.Row] = []
        self.seconds = 0.0
        self.shared = statistics(settings.env)
        if saved.exists():
            self._restore(load_checkpoint(saved))

    def _restore(self, saved: dict[str, Any]) -> None:
        self.actor.load_state_dict(saved["actor"])
        self.critic.load_state_dict(saved["critic"])
        self.optimiser.load_state_dict(saved["optimiser"])
        self.shared.update_(saved["statistics"])
        self.rows = [curve.Row(**row) for row in saved["rows"]]
        self.seconds = saved["seconds"]
        torch.set_rng_state(saved["random"])
        self.settings = replace(self.settings, env=replace(self.settings.env, seed=self.settings.env.seed + len(self.rows)))

    @property
    def frames(self) -> int:
        """Environment steps so far."""
        return self.rows[-1].frames if self.rows else 0

    def _collector(self) -> Any:
        s = self.settings
        makers = [functools.partial(training_env, s.env, k, self.shared, bool(s.ray)) for k in range(max(s.workers, s.ray))]
        common: dict[str, Any] = {"frames_per_batch": s.frames_per_batch, "total_frames": -1}
        if s.ray:
            from torchrl.collectors.distributed import RayCollector

            return RayCollector(makers, self.actor, sync=True, num_collectors=s.ray, update_after_each_batch=True, **common)
        if s.workers > 1:
            return MultiSyncCollector(makers, self.actor, cat_results=0, update_at_each_batch=True, num_threads=1, **common)
        return Collector(makers[0](), self.actor, **common)

    def run(self, frames: int, minutes: float = math.inf, progress: Callable[[curve.Row], object] | None = None) -> list[curve.Row]:
        """Trains until so many environment steps, or minutes in all, are reached. Interrupted, it keeps what the last batch left."""
        collector = self._collector()
        started = time.perf_counter() - self.seconds
        try:
            for batch in collector:
                loss = self._learn(batch)
                self.seconds = time.perf_counter() - started
                self.rows.append(_row(batch, self.frames, self.seconds, loss))
                self.save()
                if self.settings.workers > 1 or self.settings.ray:
                    collector.update_policy_weights_()
                if progress is not None:
                    progress(self.rows[-1])
                if self.frames >= frames or self.seconds >= 60 * minutes:
                    break
        finally:
            collector.shutdown()
        return self.rows

    def _learn(self, batch: TensorDictBase) -> float:
        """Some epochs over a batch `[worlds, steps]`; the last loss."""
        s = self.settings
        last = math.nan
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

    def save(self) -> None:
        """Checkpoint, curve and picture."""
        part = self.folder / f"{CHECKPOINT}.part"
        torch.save(
            {
                "format": FORMAT,
                "settings": asdict(self.settings),
                "actor": self.actor.state_dict(),
                "critic": self.critic.state_dict(),
                "optimiser": self.optimiser.state_dict(),
                "statistics": {name: {k: v.clone() for k, v in self.shared[name].items()} for name in ("loc", "var", "count")},
                "rows": [asdict(row) for row in self.rows],
                "seconds": self.seconds,
                "random": torch.get_rng_state(),
            },
            part,
        )
        os.replace(part, self.folder / CHECKPOINT)
        curve.save(self.rows, self.folder / CURVE)
        curve.draw({"PPO": self.rows}, self.folder / PICTURE, self.settings.env.name)


def load_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's contents, without unpickling anything but plain data; raises `InputError` for what is none."""
    try:
        saved = torch.load(path, weights_only=True)
        if saved.get("format") != FORMAT:
            raise InputError(f"'{path}' has format {saved.get('format')!r}: must be {FORMAT!r}")
    except FileNotFoundError:
        raise InputError(f"no checkpoint at '{path}'") from None
    except InputError:
        raise
    except Exception as error:  # pickle, zipfile and torch raise whatever they like on damaged files
        raise InputError(f"'{path}' is not a readable checkpoint: {error}") from error
    return dict(saved)


def _row(batch: TensorDictBase, frames: int, seconds: float, loss: float) -> curve.Row:
    end = batch["next", "done"].squeeze(-1)
    returns = batch["next", "episode_reward"].squeeze(-1)[end]
    lengths = batch["next", "step_count"].squeeze(-1)[end].float()
    some = len(returns) > 0
    return curve.Row(
        frames=frames + batch.numel(),
        seconds=seconds,
        episodes=len(returns),
        mean_return=float(returns.mean()) if some else math.nan,
        lowest_return=float(returns.min()) if some else math.nan,
        highest_return=float(returns.max()) if some else math.nan,
        mean_length=float(lengths.mean()) if some else math.nan,
        reward=float(batch["next", "reward"].mean()),
        unsolved=float(batch["next", "unsolved"].float().mean()),
        loss=loss,
    )
