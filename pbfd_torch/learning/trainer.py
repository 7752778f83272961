"""What both methods' trainers share: networks, the statistics of what is seen, and the folder that keeps them."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import torch

from pbfd_torch.errors import InputError
from pbfd_torch.learning import curve
from pbfd_torch.learning.checkpoint import checked_statistics, load_moments, load_weights
from pbfd_torch.learning.folder import Folder
from pbfd_torch.learning.networks import make_actor, make_critic
from pbfd_torch.learning.settings import Settings
from pbfd_torch.learning.training_env import plain, statistics

T = TypeVar("T", bound=Settings)

Progress = Callable[[curve.Row], object]
"""Called after every batch."""


class Trainer(Generic[T]):
    """Trains into a folder, see `Folder`.

    A folder that holds a checkpoint is gone on with where `resume` is set, and refused otherwise. What was learnt, the optimisers,
    the statistics and the curve go on where they were; episodes under way begin anew. `worlds`: of the trainer's own `env`."""

    method: ClassVar[str]

    def __init__(self, settings: T, path: Path, resume: bool, worlds: int) -> None:
        torch.manual_seed(settings.env.seed)
        self.folder, self.settings = Folder(path, self.method, settings.env.name, resume), settings
        # other starts than those that have been
        self._seed = settings.env.seed + len(self.folder.rows)
        self.env: Any = settings.env.make(num_envs=worlds, seed=self._seed)
        width = self.env.observation_spec["observation"].shape[-1]
        self.actor = make_actor(width, self.env.action_spec, settings.width)
        self.critic = make_critic(width, settings.width)
        self._memory = tempfile.TemporaryDirectory(prefix="pbfd-statistics-")
        self.shared = statistics(settings.env, Path(self._memory.name))
        self._learners: dict[str, Any] = {"actor": self.actor, "critic": self.critic}

    def _keep(self, **learners: Any) -> None:
        """What checkpoints hold beside both networks; all of it goes on from the folder's checkpoint, where there is one."""
        self._learners |= learners
        if self.folder.saved is not None:
            try:
                self._go_on(self.folder.saved)
            except InputError as error:
                raise InputError(f"'{self.folder.path}' does not hold what this training goes on from: {error}") from error

    def _go_on(self, saved: Mapping[str, Any]) -> None:
        name, width = saved["settings"]["env"]["name"], self.env.observation_spec["observation"].shape[-1]
        if name != self.settings.env.name:
            raise InputError(f"env is '{self.settings.env.name}': must be '{name}', as before")
        for key, learner in self._learners.items():
            load = load_moments if isinstance(learner, torch.optim.Optimizer) else load_weights
            load(key, learner, saved.get(key))
        self.shared.update_(checked_statistics(saved.get("statistics"), width))

    def _save(self, row: curve.Row, progress: Progress | None) -> None:
        """After a batch."""
        self.folder.rows.append(row)
        states = {name: learner.state_dict() for name, learner in self._learners.items()}
        self.folder.write(asdict(self.settings), states | {"statistics": plain(self.shared)})
        if progress is not None:
            progress(row)
