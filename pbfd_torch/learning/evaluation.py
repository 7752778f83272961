"""A policy on trial: mean return and spread over episodes, in the simulator it was trained in and in others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from pbfd_torch.envs import PbfdEnv, Step
from pbfd_torch.errors import InputError
from pbfd_torch.files import write_figure
from pbfd_torch.learning.checkpoint import checked_statistics, load_checkpoint, load_weights
from pbfd_torch.learning.networks import make_actor, mean_action
from pbfd_torch.learning.track import tracked
from pbfd_torch.learning.training_env import EnvSettings, location_and_scale
from pbfd_torch.learning.worlds import trial_worlds
from pbfd_torch.records.rollout import Rollout

SHOWN = 4  # worlds in a saved rollout


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy: what it sees is normalised by the statistics of its training, and it acts without noise."""

    settings: EnvSettings
    actor: Any
    loc: Tensor
    scale: Tensor

    @staticmethod
    def load(path: Path) -> Policy:
        """From a checkpoint of `pbfd train`; raises `InputError` for what is none, naming what is wrong in it."""
        saved = load_checkpoint(path)
        settings = EnvSettings.of(saved["settings"]["env"])
        try:
            probe = settings.make(num_envs=1)
            width = probe.observation_spec["observation"].shape[-1]
            actor = make_actor(width, probe.action_spec, saved["settings"]["width"])
            load_weights("actor", actor, saved.get("actor"))
            statistics = checked_statistics(saved.get("statistics"), width)
        except InputError as error:
            raise InputError(f"'{path}' is not a usable checkpoint: {error}") from error
        return Policy(settings, actor, *location_and_scale(statistics))

    def __call__(self, observation: Tensor) -> Tensor:
        """`[worlds, nobs] → [worlds, nu]`."""
        with torch.no_grad():
            return mean_action(self.actor, (observation.float() - self.loc) / self.scale)


@dataclass(frozen=True, eq=False)
class Trial:
    """What came of it.

    Attributes:
        on: the simulator. engine: that makes its steps: native, torch or mujoco. dt: its step [s].
        returns, lengths: `[episodes]`, lengths in control steps.
        unsolved: episodes that ended because a step had no solution.
        rollout: of the first few worlds, as long as the longest of them lasts.
    """

    on: str
    engine: str
    dt: float
    returns: Tensor
    lengths: Tensor
    unsolved: int
    rollout: Rollout

    @property
    def mean(self) -> float:
        return float(self.returns.mean())

    @property
    def spread(self) -> float:
        """Standard deviation over episodes."""
        return float(self.returns.std()) if len(self.returns) > 1 else 0.0


def tried(
    policy: Callable[[Tensor], Tensor],
    settings: EnvSettings,
    on: str,
    episodes: int = 64,
    seed: int = 1000,
    progress: Callable[[int, int], object] | None = None,
) -> Trial:
    """One episode in each of `episodes` worlds, all from the environment's own starts, until it ends or is truncated. progress:
    called with the control steps done and how many worlds go on."""
    env: PbfdEnv = settings.make(num_envs=episodes, seed=seed)
    worlds = trial_worlds(on, settings.name, env)
    q, v = worlds.start(*env.start(episodes, torch.Generator().manual_seed(seed)))
    alive = torch.ones(episodes, dtype=torch.bool)
    returns, lengths, failed = torch.zeros(episodes), torch.zeros(episodes), torch.zeros(episodes, dtype=torch.bool)
    kept = [(q[:SHOWN], v[:SHOWN])]
    with torch.no_grad():
        for k in range(env.max_episode_steps):
            action = policy(env.observe(q, v)).to(q.dtype).clamp(env.low, env.high)
            before = q
            after, velocity, solved = worlds.step(action)
            q = torch.where((alive & solved)[:, None], after, q)
            v = torch.where((alive & solved)[:, None], velocity, v)
            reward = env.reward(Step(before, q, v, action, env.control_dt)).float()
            returns += torch.where(alive & solved, reward, 0.0)
            lengths += alive
            failed |= alive & ~solved
            alive = alive & solved & env.healthy(q, v)
            if bool(alive[:SHOWN].any()):
                kept.append((q[:SHOWN], v[:SHOWN]))
            if progress is not None:
                progress(k + 1, int(alive.sum()))
            if not bool(alive.any()):
                break
    rollout = tracked(
        env.scene, env.control_dt, torch.stack([x for x, _ in kept]), torch.stack([x for _, x in kept]), f"{settings.name}, {on}"
    )
    return Trial(on, worlds.engine, worlds.dt, returns, lengths, int(failed.sum()), rollout)


def draw(trials: Mapping[str, list[Trial]], path: Path) -> None:
    """Bars of mean return for each policy and simulator, with the spread: the paper's Fig. 7."""
    figure = Figure(figsize=(1.8 + 2.2 * len(trials), 4.2), dpi=130, layout="constrained")
    axis = figure.subplots()
    kinds = list(dict.fromkeys(trial.on for group in trials.values() for trial in group))
    width = 0.8 / len(kinds)
    for k, kind in enumerate(kinds):
        found = [(at, trial) for at, group in enumerate(trials.values()) for trial in group if trial.on == kind]
        axis.bar(
            [at + (k - 0.5 * (len(kinds) - 1)) * width for at, _ in found], [trial.mean for _, trial in found], 0.9 * width,
            yerr=[trial.spread for _, trial in found], capsize=3, color=f"C{k}", label=kind,
        )  # fmt: skip
    axis.set_xticks(range(len(trials)), list(trials))
    axis.set(ylabel="return, mean and standard deviation over episodes")
    axis.grid(axis="y", alpha=0.3)
    axis.legend(title="evaluated on", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    write_figure(path, figure)
