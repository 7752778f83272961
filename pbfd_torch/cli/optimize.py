"""`pbfd optimize`: runs a named task of trajectory optimisation from random starts and says how many reached their goal."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from pbfd_torch.cli.benchmarks import plain
from pbfd_torch.cli.options import use_threads
from pbfd_torch.cli.outputs import check_folder
from pbfd_torch.cli.ranges import ITERATIONS, SEED, THREADS, WORLDS
from pbfd_torch.errors import InputError
from pbfd_torch.files import write_figure

if TYPE_CHECKING:
    from pbfd_torch.optimize.tasks import Outcome, Task

FILES = ("before.npz", "after.npz", "cost.png")


def optimize(
    task: Annotated[str, typer.Argument(help="box-throw, arm-swing-up or hopper.", show_default=False)],
    iterations: Annotated[int | None, ITERATIONS.option("At most so many; default: what the task needs.")] = None,
    worlds: Annotated[int, WORLDS.option("Random starts, optimised as one batch.")] = 8,
    seed: Annotated[int, SEED.option("Of the random starts.")] = 0,
    threads: Annotated[int, THREADS.option("PyTorch's threads inside an operation.")] = 1,
    out: Annotated[Path | None, typer.Option(help=f"Folder for {', '.join(FILES)}.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")] = False,
) -> None:
    """Optimises controls, or a throw, by exact gradients. Exit status: 0 all worlds reached the goal, 1 some not, 2 bad input."""
    from pbfd_torch.optimize.tasks import TASKS

    use_threads(threads)
    if task not in TASKS:
        raise InputError(f"no task named '{task}': the tasks are {', '.join(TASKS)}")
    if out is not None:
        check_folder(out, FILES)
    raise typer.Exit(run(task, TASKS[task](worlds, seed), iterations, out, as_json))


def run(name: str, task: Task, iterations: int | None, out: Path | None, as_json: bool) -> int:
    """Optimises, reports and writes; the exit status."""
    most = task.iterations if iterations is None else iterations
    started = time.perf_counter()
    with tqdm(total=most, unit="iteration", disable=not sys.stderr.isatty(), leave=False) as bar:

        def show(done: int, least: float) -> None:
            bar.set_postfix(cost=f"{least:.4g}")
            bar.update()

        outcome = task.solve(most, show)
    summary = _summary(name, task, outcome, time.perf_counter() - started)
    if out is not None:
        outcome.rollout(outcome.before).save(out / "before.npz")
        outcome.rollout(outcome.after).save(out / "after.npz")
        draw(name, outcome, out / "cost.png")
    if as_json:
        print(json.dumps(plain(summary), allow_nan=False))
    else:
        _print(summary, out)
    return 0 if bool(outcome.reached.all()) else 1


def _summary(name: str, task: Task, outcome: Outcome[Any], wall: float) -> dict[str, Any]:
    return {
        "task": name,
        "criterion": task.criterion,
        "worlds": len(outcome.reached),
        "reached": int(outcome.reached.sum()),
        "iterations": len(outcome.history) - 1,
        "wall_s": wall,
        "cost_before_median": float(outcome.history[0].median()),
        "cost_after_median": float(outcome.history[-1].median()),
        "worlds_not_reached": (~outcome.reached).nonzero().flatten().tolist(),
        "unsolved_steps": int(outcome.unsolved.sum()),
        "doubtful_steps": int(outcome.doubtful.sum()),
    }


def _print(summary: dict[str, Any], out: Path | None) -> None:
    table = Table(title=f"pbfd optimize {summary['task']}", show_header=False, title_justify="left")
    table.add_column(style="cyan")
    table.add_column()
    for key, value in summary.items():
        if key != "task":
            table.add_row(key, f"{value:.6g}" if isinstance(value, float) else str(value))
    Console(markup=False, emoji=False).print(table)
    if out is not None:
        print(f"{', '.join(FILES)} written to {out}")


def draw(name: str, outcome: Outcome[Any], path: Path) -> None:
    """Writes a PNG of the costs of all worlds over the iterations."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.5), dpi=130, layout="constrained")
    history = outcome.history.cpu().numpy()
    for world, reached in enumerate(outcome.reached.tolist()):
        axes.plot(history[:, world], color="tab:blue" if reached else "tab:red", alpha=0.6, linewidth=1.2)
    axes.set_yscale("log")
    axes.set_xlabel("iteration")
    axes.set_ylabel("cost")
    axes.set_title(f"{name}: {int(outcome.reached.sum())} of {len(outcome.reached)} reached the goal (red: not)")
    axes.grid(alpha=0.3)
    write_figure(path, figure)
    plt.close(figure)
