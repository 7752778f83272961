"""`pbfd bench precision`: error against time spent, our integrators and MuJoCo's."""

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
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.native.engine import Engine

if TYPE_CHECKING:
    from pbfd_torch.bench.precision import Effort

FILES = ("precision.json", "precision.md", "precision-errors.png", "precision-steps.png")


def precision(
    out: Annotated[Path, typer.Option(help=f"Folder for {', '.join(FILES)}.")] = Path("bench-precision"),
    scenes: Annotated[str, typer.Option(help="Scenes, separated by commas; default: all that are compared.")] = "",
    integrators: Annotated[
        str, typer.Option(help=f"Our integrators, separated by commas, from {', '.join(INTEGRATORS)}; default: all.")
    ] = "",
    quick: Annotated[
        bool, typer.Option("--quick", help="Two time steps, a small batch, short timings, and two scenes by default.")
    ] = False,
    engine: EngineOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")] = False,
) -> None:
    """Compares error and wall time of our integrators and MuJoCo's on the same scenes over a range of time steps. One thread,
    float64; without MuJoCo, ours alone. Exit status 1: ours left some step unsolved."""
    from pbfd_torch.bench.precision import FULL, QUICK
    from pbfd_torch.bench.precision_scenes import CASES

    effort = QUICK if quick else FULL
    chosen_scenes = chosen("--scenes", scenes, CASES, what="names ") if scenes else effort.scenes
    chosen_integrators = chosen("--integrators", integrators, INTEGRATORS, what="names ")
    check_folder(out, FILES)
    use_threads(1)
    report = measured(chosen_scenes, chosen_integrators, effort, EngineChoice.engine(engine))
    write(report, out)
    if as_json:
        print(json.dumps(plain(report), allow_nan=False))
    else:
        print_report(report, out)
    raise typer.Exit(min(1, sum(row["unsolved_steps"] for scene in report["scenes"].values() for row in scene["rows"])))


def measured(scenes: Sequence[str], integrators: Sequence[str], effort: Effort, engine: Engine | None) -> dict[str, Any]:
    """Everything as plain data; with a progress bar on a terminal."""
    from pbfd_torch.bench import engines, mujoco_runs
    from pbfd_torch.bench.precision import NOTES, PEER, measure_scene
    from pbfd_torch.bench.precision_levels import losses
    from pbfd_torch.bench.precision_scenes import CASES

    started = time.perf_counter()
    version = mujoco_runs.version()
    peers = mujoco_runs.INTEGRATORS if version else ()
    total = sum(effort.units(CASES[name], integrators, peers) for name in scenes)
    found = {}
    with tqdm(total=total, unit="run", disable=not sys.stderr.isatty(), leave=False) as bar:
        for name in scenes:
            bar.set_description(name)
            found[name] = measure_scene(CASES[name], integrators, peers, effort, bar.update, engine)
    ours = [row for scene in found.values() for row in scene["rows"] if row["simulator"] != PEER]
    made = engines.in_words((row["integrator"], row["engine"]) for row in ours)
    return {
        "wall_s": time.perf_counter() - started,
        "environment": environment() | {"mujoco": version},
        "worlds": effort.worlds,
        "integrators": list(integrators),
        "scenes": found,
        "losses": losses(found),
        "notes": [*NOTES, made, *mujoco_runs.absent("ours alone")],
    }


def write(report: dict[str, Any], folder: Path) -> None:
    """The four files. Raises `InputError` where they cannot be written."""
    from pbfd_torch.bench.precision_levels import markdown
    from pbfd_torch.bench.precision_pictures import draw_steps, draw_work

    write_files(
        folder,
        report,
        FILES[0],
        lambda: write_whole(folder / FILES[1], markdown(report)),
        lambda: draw_work(report, folder / FILES[2]),
        lambda: draw_steps(report, folder / FILES[3]),
    )


def print_report(report: dict[str, Any], folder: Path) -> None:
    """The cheapest way to every error, where ours loses, notes, and where the files are."""
    from pbfd_torch.bench.precision_levels import LEVEL_HEADERS, level_table

    console = Console(markup=False, emoji=False)
    result = new_table(
        f"Cheapest way to an error: integrator, Δt, wall ms per simulated s and world (batch: {report['worlds']} worlds)",
        *("scene", *LEVEL_HEADERS),
    )
    for scene in report["scenes"].values():
        for k, line in enumerate(level_table(scene)):
            result.add_row("" if k else scene["title"], *(cell.replace(" ", "\n", 1) if ":" in cell else cell for cell in line))
    console.print(result, "", sep="\n")
    for heading, lines in (("where ours loses:", report["losses"]), ("notes:", report["notes"])):
        console.print(heading)
        for line in lines:
            console.print(f"- {line}")
    about = report["environment"]
    peer = f"MuJoCo {about['mujoco']}" if about["mujoco"] else "no MuJoCo"
    console.print(f"\n{report['wall_s']:.0f} s; PyTorch {about['torch']}, {peer}, {about['threads']} thread, {about['processor']}")
    print(f"written: {', '.join(str(folder / name) for name in FILES)}")
