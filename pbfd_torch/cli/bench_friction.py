"""`pbfd bench friction`: Fig. 5 of the paper, measured."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from tqdm import tqdm

from pbfd_torch.cli.benchmarks import environment, new_table, plain, three_digits, write_files
from pbfd_torch.cli.options import EngineChoice, EngineOption, use_threads
from pbfd_torch.cli.outputs import check_folder
from pbfd_torch.native.engine import Engine

FILES = ("friction.json", "fig5.png")
VALUES, QUICK_VALUES = 21, 9


def friction(
    out: Annotated[Path, typer.Option(help=f"Folder for {' and '.join(FILES)}.")] = Path("bench-friction"),
    quick: Annotated[bool, typer.Option("--quick", help="Two time steps and fewer values of each parameter.")] = False,
    engine: EngineOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")] = False,
) -> None:
    """Slides a box to rest under Coulomb's law, PBD and PBFD: distance against μ or C∥ at several time steps (Fig. 5). One thread,
    float64. Exit status 1: some step was left unsolved."""
    from pbfd_torch.bench.figure_5 import QUICK_TIME_STEPS, TIME_STEPS

    check_folder(out, FILES)
    use_threads(1)
    steps, count = (QUICK_TIME_STEPS, QUICK_VALUES) if quick else (TIME_STEPS, VALUES)
    report = measured(steps, count, EngineChoice.engine(engine))
    write(report, out)
    if as_json:
        print(json.dumps(plain(report), allow_nan=False))
    else:
        print_report(report, out)
    raise typer.Exit(min(1, sum(curve["unsolved_steps"] for case in report["curves"].values() for curve in case.values())))


def measured(time_steps: Sequence[float], count: int, engine: Engine | None) -> dict[str, Any]:
    """All curves with `count` values each, as plain data; with a progress bar on a terminal."""
    from pbfd_torch.bench import engines, figure_5

    started = time.perf_counter()
    total = len(figure_5.CASES) * len(time_steps)
    with tqdm(total=total, unit="curve", disable=not sys.stderr.isatty(), leave=False) as bar:
        curves = figure_5.measure(time_steps, count, bar.update, engine)
    made = [(figure_5.CASES[key].title, curve["engine"]) for key, case in curves.items() for curve in case.values()]
    return {
        "wall_s": time.perf_counter() - started,
        "environment": environment(),
        "speed_m_s": figure_5.SPEED,
        "duration_s": figure_5.DURATION,
        "normal_stiffness": float(figure_5.NORMAL_FORCE.stiffness),
        "curves": curves,
        "notes": [*figure_5.NOTES, engines.in_words(made)],
    }


def write(report: dict[str, Any], folder: Path) -> None:
    """The two files. Raises `InputError` where they cannot be written."""
    from pbfd_torch.bench.figure_5 import draw

    write_files(
        folder,
        report,
        FILES[0],
        lambda: draw(report["curves"], folder / FILES[1]),
    )


def print_report(report: dict[str, Any], folder: Path) -> None:
    """Table, notes, and where the files are."""
    from pbfd_torch.bench.figure_5 import CASES

    console = Console(markup=False, emoji=False)
    result = new_table(
        f"Fig. 5: a box that starts at {report['speed_m_s']:g} m/s, C⊥ = {report['normal_stiffness']:.3g} N/m²",
        *("law", "Δt\n[s]", "falls?", "least\n[m]", "at μ\nor C∥", "moving\n/worlds", "error\n[mm]"),
        *("unsolved\n/steps", "trials\n/step", "time\n[µs]"),
    )
    for key, curves in report["curves"].items():
        for dt, curve in curves.items():
            worlds = len(curve["values"])
            result.add_row(
                *(CASES[key].title, dt, "yes" if curve["falls"] else "no"),
                *(f"{curve['least_m']:.4f}", f"{curve['least_at']:.2g}"),
                *(f"{curve['moving']}/{worlds}", f"{1e3 * curve['error_max_m']:.3g}"),
                *(f"{curve['unsolved_steps']}/{curve['steps'] * worlds}", f"{curve['evaluations']:.2f}"),
                three_digits(curve["us_per_step"]),
            )
    console.print(result, "", sep="\n")
    for note in report["notes"]:
        console.print(f"- {note}")
    about = report["environment"]
    console.print(
        f"\n{report['wall_s']:.0f} s; PyTorch {about['torch']}, {about['threads']} thread, {about['dtype']}, {about['processor']}"
    )
    print(f"written: {', '.join(str(folder / name) for name in FILES)}")
