"""`pbfd bench speed`: control steps a second of our engines and of MuJoCo."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from tqdm import tqdm

from pbfd_torch.cli.benchmarks import chosen, environment, new_table, plain, write_files
from pbfd_torch.cli.options import use_threads
from pbfd_torch.cli.outputs import check_folder
from pbfd_torch.files import write_whole

if TYPE_CHECKING:
    from pbfd_torch.bench.speed import Effort

FILES = ("speed.json", "speed.md", "speed.png")


def speed(
    out: Annotated[Path, typer.Option(help=f"Folder for {', '.join(FILES)}.")] = Path("bench-speed"),
    scenes: Annotated[str, typer.Option(help="Scenes, separated by commas; default: all that are compared.")] = "",
    quick: Annotated[
        bool, typer.Option("--quick", help="Short rollouts, few rounds, coarse references, and two scenes by default.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")] = False,
) -> None:
    """Compares how many control steps a second the compiled core, PyTorch and MuJoCo make of the same scenes, in double and single
    precision, by one world and by many, with one thread and with all; the error of each stands beside it. Without MuJoCo, ours
    alone. Exit status 1: some step of ours was left unsolved."""
    from pbfd_torch.bench.speed import FULL, QUICK
    from pbfd_torch.bench.speed_scenes import COURSES

    effort = QUICK if quick else FULL
    names = chosen("--scenes", scenes, COURSES, what="names ") if scenes else effort.scenes
    check_folder(out, FILES)
    use_threads(1)
    report = measured(names, effort)
    write(report, out)
    if as_json:
        print(json.dumps(plain(report), allow_nan=False))
    else:
        print_report(report, out)
    raise typer.Exit(int(any(row["solved_share"] < 1 for row in report["rows"])))


def measured(scenes: Sequence[str], effort: Effort) -> dict[str, Any]:
    """Everything as plain data; with a progress bar on a terminal."""
    from pbfd_torch.bench import mujoco_runs
    from pbfd_torch.bench.speed import NOTES, all_threads, measure_scene
    from pbfd_torch.bench.speed_scenes import COURSES
    from pbfd_torch.bench.speed_table import ratios
    from pbfd_torch.native.library import library

    started = time.perf_counter()
    version, core, threads = mujoco_runs.version(), library(), all_threads()
    found, rows = {}, []
    total = sum(effort.units(COURSES[name], threads, version is not None) for name in scenes)
    with tqdm(total=total, unit="run", disable=not sys.stderr.isatty(), leave=False) as bar:
        for name in scenes:
            bar.set_description(name)
            scene = measure_scene(COURSES[name], effort, threads, version is not None, bar.update)
            rows += scene.pop("rows")
            found[name] = scene
    return {
        "wall_s": time.perf_counter() - started,
        "environment": environment() | {"mujoco": version, "native": core and core.target, "threads": list(threads)},
        "scenes": found,
        "rows": rows,
        "ratios": ratios(rows),
        "notes": [*NOTES, *mujoco_runs.absent("ours alone")],
    }


def write(report: dict[str, Any], folder: Path) -> None:
    """The three files. Raises `InputError` where they cannot be written."""
    from pbfd_torch.bench.speed_pictures import draw
    from pbfd_torch.bench.speed_table import markdown

    write_files(
        folder,
        report,
        FILES[0],
        lambda: write_whole(folder / FILES[1], markdown(report)),
        lambda: draw(report, folder / FILES[2]),
    )


def print_report(report: dict[str, Any], folder: Path) -> None:
    """A table for each scene, the ratios, notes, and where the files are."""
    from pbfd_torch.bench.speed_table import (
        RATIO_HEADERS,
        batches,
        contestant_headers,
        contestant_lines,
        heading,
        ratio_lines,
        remarks,
    )

    console = Console(markup=False, emoji=False)
    for name, scene in report["scenes"].items():
        rows = [row for row in report["rows"] if row["scene"] == name]
        shown = batches(rows)
        table = new_table(f"{heading(name, scene)}; thousands of control steps a second", *contestant_headers(shown))
        for line in contestant_lines(rows, shown):
            table.add_row(*line)
        console.print(table, *(f"- {remark}" for remark in remarks(rows)), "", sep="\n")
    summary = new_table("The core's control steps a second over those of …, same worlds, one thread", *RATIO_HEADERS)
    for line in ratio_lines(report["ratios"]):
        summary.add_row(*line)
    console.print(summary, "", "notes:", *(f"- {note}" for note in report["notes"]), sep="\n")
    about = report["environment"]
    peer = f"MuJoCo {about['mujoco']}" if about["mujoco"] else "no MuJoCo"
    core = f"native core {about['native']}" if about["native"] else "no native core"
    console.print(f"\n{report['wall_s']:.0f} s; PyTorch {about['torch']}, {peer}, {core}, {about['processor']}")
    print(f"written: {', '.join(str(folder / name) for name in FILES)}")
