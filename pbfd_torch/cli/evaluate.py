"""`pbfd evaluate`: trained policies on trial in several simulators (Fig. 7)."""

from __future__ import annotations

import enum
import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from pbfd_torch.cli.options import use_threads
from pbfd_torch.cli.outputs import check_folder
from pbfd_torch.cli.ranges import SEED, WORLDS
from pbfd_torch.errors import InputError
from pbfd_torch.files import write_whole

FILES = ("returns.png", "returns.json")


class On(enum.StrEnum):
    PBFD = "pbfd"
    NEWTON_EULER = "newton-euler"
    MUJOCO = "mujoco"


def evaluate(
    checkpoints: Annotated[list[Path], typer.Argument(help="Checkpoints or folders of `pbfd train`.", show_default=False)],
    on: Annotated[list[On] | None, typer.Option(help="Give it several times; default: all.")] = None,
    episodes: Annotated[int, WORLDS.option("Of each policy in each simulator.")] = 64,
    seed: Annotated[int, SEED.option("Of the starts.")] = 1000,
    out: Annotated[Path | None, typer.Option(help="Folder for the picture, the numbers and a rollout of each.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")] = False,
) -> None:
    """Mean return and spread of policies, where they were trained and elsewhere. The engine column says what makes the steps: those
    of pbfd the compiled core where it can, of newton-euler PyTorch, of mujoco itself."""
    from pbfd_torch.learning.evaluation import Policy, Trial, draw, tried

    if out is not None:
        check_folder(out, FILES)
    use_threads(1)
    found: dict[str, list[Trial]] = {}
    numbers: list[dict[str, Any]] = []
    for path in checkpoints:
        policy = Policy.load(path / "checkpoint.pt" if path.is_dir() else path)
        name = path.name if path.is_dir() else path.parent.name
        if name in found:
            raise InputError(f"two checkpoints are called '{name}': their folders must have different names")
        found[name] = []
        for kind in dict.fromkeys(x.value for x in on or On):
            with tqdm(total=1000, unit="step", desc=f"{name} on {kind}", disable=not sys.stderr.isatty(), leave=False) as bar:
                trial = tried(policy, policy.settings, kind, episodes, seed, lambda k, alive: bar.update(k - bar.n))
            found[name].append(trial)
            base = found[name][0].mean
            numbers.append(
                {
                    "policy": name,
                    "env": policy.settings.name,
                    "on": kind,
                    "engine": trial.engine,
                    "dt": trial.dt,
                    "mean_return": trial.mean,
                    "spread": trial.spread,
                    "mean_length": float(trial.lengths.mean()),
                    "unsolved_episodes": trial.unsolved,
                    "kept": trial.mean / base if base else float("nan"),
                }
            )
            if out is not None:
                trial.rollout.save(out / f"{name}-{kind}.npz")
    if out is not None:
        draw(found, out / FILES[0])
        write_whole(out / FILES[1], json.dumps(numbers, indent=1))
    if as_json:
        print(json.dumps({"trials": numbers}))
        return
    table = Table(title=f"{episodes} episodes each", title_justify="left")
    for column in ("policy", "on", "engine", "Δt [s]", "mean return", "spread", "steps", "unsolved", "kept"):
        table.add_column(column)
    for x in numbers:
        table.add_row(
            x["policy"], x["on"], x["engine"], f"{x['dt']:g}", f"{x['mean_return']:.1f}", f"{x['spread']:.1f}",
            f"{x['mean_length']:.0f}", str(x["unsolved_episodes"]), f"{x['kept']:.0%}",
        )  # fmt: skip
    Console(markup=False, emoji=False).print(table)
