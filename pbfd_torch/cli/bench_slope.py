"""`pbfd bench slope`: Fig. 6 of the paper, measured."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from tqdm import tqdm

from pbfd_torch.cli.benchmarks import environment, new_table, plain, write_files
from pbfd_torch.cli.options import EngineChoice, EngineOption, use_threads
from pbfd_torch.cli.outputs import check_folder
from pbfd_torch.cli.ranges import TRAJECTORY
from pbfd_torch.files import write_whole
from pbfd_torch.native.engine import Engine

if TYPE_CHECKING:
    from pbfd_torch.bench.figure_6 import Effort

FILES = ("slope.json", "slope.md", "figure-6.png")


def slope(
    out: Annotated[Path, typer.Option(help=f"Folder for {', '.join(FILES)}.")] = Path("bench-slope"),
    duration: Annotated[
        float | None, TRAJECTORY.option("Simulated time of a trajectory in seconds; default: 10, or 1 with --quick.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Three time steps, a small batch, a short trajectory.")] = False,
    engine: EngineOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")] = False,
) -> None:
    """Slides a chain off a slope with ours, conventional Newton–Euler and MuJoCo: time against Δt, contacts and friction (Fig. 6),
    and which of the paper's claims hold. One thread, float64; without MuJoCo, the others alone. Exit status 1: ours left some step
    unsolved."""
    from pbfd_torch.bench.figure_6 import FULL, OURS, QUICK

    check_folder(out, FILES)
    use_threads(1)
    effort = QUICK if quick else FULL
    report = measured(effort if duration is None else dataclasses.replace(effort, duration=duration), EngineChoice.engine(engine))
    write(report, out)
    if as_json:
        print(json.dumps(plain(report), allow_nan=False))
    else:
        print_report(report, out)
    rows = [row for panel in ("time_steps", "contacts", "friction") for row in report[panel]]
    raise typer.Exit(min(1, sum(row["unsolved_steps"] for row in rows if row["simulator"] in OURS)))


def measured(effort: Effort, engine: Engine | None) -> dict[str, Any]:
    """Everything as plain data; with a progress bar on a terminal."""
    from pbfd_torch.bench import engines, mujoco_runs
    from pbfd_torch.bench.figure_6 import FORMULATIONS, TITLES, measure, units
    from pbfd_torch.bench.figure_6_claims import NOTES, claims

    started = time.perf_counter()
    version = mujoco_runs.version()
    shortened = (f"at most {effort.most_steps} steps a run; in (b) Newton–Euler takes up to 4 times as many, MuJoCo all",)
    with tqdm(total=units(effort, engine), unit="run", disable=not sys.stderr.isatty(), leave=False) as bar:
        found = measure(effort, bar.update, engine)
    rows = [row for panel in ("time_steps", "contacts", "friction") for row in found[panel]]
    made = engines.in_words((TITLES[row["simulator"]], row["engine"]) for row in rows if row["simulator"] in FORMULATIONS)
    report = {"duration_s": effort.duration, "worlds": effort.worlds, **found}
    return {
        "wall_s": time.perf_counter() - started,
        "environment": environment() | {"mujoco": version},
        "claims": claims(report),
        **report,
        "notes": [*NOTES, made, *shortened, *mujoco_runs.absent("not compared")],
    }


def write(report: dict[str, Any], folder: Path) -> None:
    """The three files. Raises `InputError` where they cannot be written."""
    from pbfd_torch.bench.figure_6_claims import markdown
    from pbfd_torch.bench.figure_6_pictures import draw

    write_files(
        folder,
        report,
        FILES[0],
        lambda: write_whole(folder / FILES[1], markdown(report)),
        lambda: draw(report, folder / FILES[2]),
    )


def print_report(report: dict[str, Any], folder: Path) -> None:
    """The panels, the claims, notes, and where the files are."""
    from pbfd_torch.bench.figure_6_claims import sheets

    console = Console(markup=False, emoji=False)
    for sheet in sheets(report):
        result = new_table(sheet.title, *(header.replace(" ", "\n", 1) for header in sheet.headers))
        result.columns[0].no_wrap = True
        for line in sheet.lines:
            result.add_row(*line)
        console.print(result, "", sep="\n")
    console.print("the paper's claims:")
    for claim in report["claims"]:
        console.print(f"- {claim['paper']}: {claim['verdict'].upper()}. {claim['measured']}")
    console.print("notes:")
    for note in report["notes"]:
        console.print(f"- {note}")
    about = report["environment"]
    peer = f"MuJoCo {about['mujoco']}" if about["mujoco"] else "no MuJoCo"
    console.print(f"\n{report['wall_s']:.0f} s; PyTorch {about['torch']}, {peer}, {about['threads']} thread, {about['processor']}")
    print(f"written: {', '.join(str(folder / name) for name in FILES)}")
