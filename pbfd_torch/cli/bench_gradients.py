"""`pbfd bench gradients`: error of a gradient against the time that it takes, ours and MuJoCo's finite differences."""

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
from pbfd_torch.cli.options import EngineChoice, EngineOption, use_threads
from pbfd_torch.cli.outputs import check_folder
from pbfd_torch.files import write_whole
from pbfd_torch.native.engine import Engine

if TYPE_CHECKING:
    from pbfd_torch.bench.gradients import Effort

FILES = ("gradients.json", "gradients.md", "gradients.png")


def gradients(
    out: Annotated[Path, typer.Option(help=f"Folder for {', '.join(FILES)}.")] = Path("bench-gradients"),
    problems: Annotated[str, typer.Option(help="Problems, toss or box, separated by commas; default: both.")] = "",
    quick: Annotated[bool, typer.Option("--quick", help="One or two time steps each, and coarser references.")] = False,
    engine: EngineOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")] = False,
) -> None:
    """Compares error and time of gradients of whole motions: of a tossed cube and of a box that slides to rest, by our derivatives,
    by our finite differences and by MuJoCo's. One thread, float64; without MuJoCo, ours alone. Exit status 1: ours left some step
    unsolved."""
    from pbfd_torch.bench.gradients import FULL, QUICK
    from pbfd_torch.bench.gradients_scenes import PROBLEMS

    names = chosen("--problems", problems, PROBLEMS, what="names ")
    check_folder(out, FILES)
    use_threads(1)
    report = measured(names, QUICK if quick else FULL, EngineChoice.engine(engine))
    write(report, out)
    if as_json:
        print(json.dumps(plain(report), allow_nan=False))
    else:
        print_report(report, out)
    raise typer.Exit(min(1, sum(row["unsolved_steps"] for problem in report["problems"].values() for row in problem["rows"])))


def measured(names: Sequence[str], effort: Effort, engine: Engine | None) -> dict[str, Any]:
    """Everything as plain data; with a progress bar on a terminal."""
    from pbfd_torch.bench import engines, mujoco_runs
    from pbfd_torch.bench.gradients import NOTES, measure
    from pbfd_torch.bench.gradients_scenes import PROBLEMS
    from pbfd_torch.bench.gradients_table import losses
    from pbfd_torch.bench.precision import OURS

    started = time.perf_counter()
    version = mujoco_runs.version()
    peers = version is not None
    found = {}
    with tqdm(
        total=sum(effort.units(PROBLEMS[name], peers) for name in names), disable=not sys.stderr.isatty(), leave=False
    ) as bar:
        for name in names:
            bar.set_description(name)
            found[name] = measure(PROBLEMS[name], effort, peers, bar.update, engine)
    ours = [row for problem in found.values() for row in problem["rows"] if row["simulator"] == OURS]
    made = engines.in_words((row["scheme"], row["engine"]) for row in ours)
    return {
        "wall_s": time.perf_counter() - started,
        "environment": environment() | {"mujoco": version},
        "problems": found,
        "losses": losses(found),
        "notes": [*NOTES, made, *mujoco_runs.absent("ours alone")],
    }


def write(report: dict[str, Any], folder: Path) -> None:
    """The three files. Raises `InputError` where they cannot be written."""
    from pbfd_torch.bench.gradients_pictures import draw
    from pbfd_torch.bench.gradients_table import markdown

    write_files(
        folder,
        report,
        FILES[0],
        lambda: write_whole(folder / FILES[1], markdown(report)),
        lambda: draw(report, folder / FILES[2]),
    )


def print_report(report: dict[str, Any], folder: Path) -> None:
    """The cheapest way to every error, where ours loses, notes, and where the files are."""
    from pbfd_torch.bench.gradients_table import LEVEL_HEADERS, level_table, reference_text

    console = Console(markup=False, emoji=False)
    result = new_table("Cheapest way to a relative error: scheme, Δt, CPU time of motion and gradient", "problem", *LEVEL_HEADERS)
    for problem in report["problems"].values():
        for k, line in enumerate(level_table(problem)):
            result.add_row("" if k else problem["title"], *(cell.replace(": ", "\n") for cell in line))
    console.print(result, "", sep="\n")
    for problem in report["problems"].values():
        console.print(f"{problem['title']}. {reference_text(problem)}")
    for heading, lines in (("where ours loses:", report["losses"]), ("notes:", report["notes"])):
        console.print(heading)
        for line in lines:
            console.print(f"- {line}")
    about = report["environment"]
    peer = f"MuJoCo {about['mujoco']}" if about["mujoco"] else "no MuJoCo"
    console.print(f"\n{report['wall_s']:.0f} s; PyTorch {about['torch']}, {peer}, {about['threads']} thread, {about['processor']}")
    print(f"written: {', '.join(str(folder / name) for name in FILES)}")
