"""`pbfd bench soak`: random robots, dropped and pushed for a long time."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from tqdm import tqdm

from pbfd_torch.cli.benchmarks import environment, new_table, plain, write_files
from pbfd_torch.cli.options import EngineChoice, EngineOption, use_threads
from pbfd_torch.cli.outputs import check_folder
from pbfd_torch.cli.ranges import MEASURED_STEP, SOAKED, SOAKED_SEED
from pbfd_torch.native.engine import Engine

FILES = ("soak.json",)


def soak(
    world_steps: Annotated[int, SOAKED.option("Steps of single worlds to make, at least.")] = 200_000,
    seed: Annotated[int, SOAKED_SEED.option("Seed of the first robot; the next ones follow.")] = 0,
    dt: Annotated[float, MEASURED_STEP.option("Time step in seconds.")] = 0.01,
    out: Annotated[Path, typer.Option(help=f"Folder for {FILES[0]}.")] = Path("bench-soak"),
    engine: EngineOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")] = False,
) -> None:
    """Drops and pushes random robots with all kinds of joints and shapes, and counts what ought not to happen: unsolved steps,
    states that are not finite, energy beyond the integrator's account, steps over their budget, memory that grows. One thread,
    float64.
    Exit status 1: a state was not finite and no status said so, or a step was over its budget."""
    check_folder(out, FILES)
    use_threads(1)
    report = measured(world_steps, seed, dt, EngineChoice.engine(engine))
    write_files(out, report, FILES[0])
    if as_json:
        print(json.dumps(plain(report), allow_nan=False))
    else:
        print_report(report, out)
    raise typer.Exit(int(report["not_finite_unsaid"] > 0 or report["over_budget"] > 0))


def measured(world_steps: int, seed: int, dt: float, engine: Engine | None) -> dict[str, Any]:
    """Everything as plain data; with a progress bar on a terminal."""
    from pbfd_torch.bench import soak as bench

    started = time.perf_counter()
    with tqdm(total=world_steps, unit="step", disable=not sys.stderr.isatty(), leave=False) as bar:
        found = bench.soak(world_steps, seed, dt, bar.update, engine)
    asked = {"seed": seed, "dt_s": dt, "worlds": bench.WORLDS, "steps": bench.STEPS}
    return {"wall_s": time.perf_counter() - started, "environment": environment(), **asked, **found.plain()}


def print_report(report: dict[str, Any], folder: Path) -> None:
    """What was counted, and where the file is."""
    shown = new_table("Soak", "", "count")
    for name in ("seeds", "world_steps", "unsolved", "not_finite_unsaid", "energy_rises", "over_budget", "hazards", "evaluations"):
        shown.add_row(name.replace("_", " "), str(report[name]))
    for name, count in [
        *((f"robots by {engine}", count) for engine, count in report["engines"].items()),
        *report["status"].items(),
    ]:
        shown.add_row(name, str(count))
    console = Console(markup=False, emoji=False)
    console.print(shown, "", sep="\n")
    growth = report["memory_growth"]
    memory = "not known" if growth is None else f"{100 * growth:+.2f} % after the first tenth"
    console.print(f"slowest step {report['slowest_s']:.2f} s; memory {memory}; {report['wall_s']:.0f} s")
    print(f"written: {folder / FILES[0]}")
