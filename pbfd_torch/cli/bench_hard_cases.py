"""`pbfd bench hard-cases`: laws that every integrator is held to, from free fall to stacks, at all their time steps."""

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
from pbfd_torch.errors import InputError
from pbfd_torch.files import write_whole
from pbfd_torch.integrators.named import INTEGRATORS

if TYPE_CHECKING:
    from pbfd_torch.bench.hard_cases import Result
    from pbfd_torch.bench.hard_cases_case import Case, Run

FILES = ("hard-cases.json", "hard-cases.md")


def hard_cases(
    cases: Annotated[str, typer.Option(help="Cases, separated by commas; default: all.")] = "",
    integrators: Annotated[str, typer.Option(help=f"From {', '.join(INTEGRATORS)}, separated by commas; default: all.")] = "",
    dt: Annotated[str, typer.Option(help="Time steps in seconds, separated by commas; default: all that each case allows.")] = "",
    out: Annotated[Path, typer.Option(help=f"Folder for {' and '.join(FILES)}.")] = Path("bench-hard-cases"),
    quick: Annotated[bool, typer.Option("--quick", help="One or two time steps a case, and shorter simulations.")] = False,
    engine: EngineOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")] = False,
) -> None:
    """Holds every integrator to closed forms, conservation laws and limits in free motion, friction, contact and stacks, at each
    time step that a case allows. One thread, float64. Exit status 1: something that must hold does not."""
    from pbfd_torch.bench.hard_cases import CASES, plan
    from pbfd_torch.bench.hard_cases_case import TIME_STEPS

    by_text = {f"{step:g}": step for step in TIME_STEPS}
    steps = [by_text[text] for text in chosen("--dt", dt, by_text, _as_seconds)]
    names, schemes = chosen("--cases", cases, CASES), chosen("--integrators", integrators, INTEGRATORS)
    runs = plan(names, schemes, steps, quick, EngineChoice.engine(engine))
    if not runs:
        raise InputError(f"no case is tried so: --cases '{cases}', --integrators '{integrators}', --dt '{dt}'; leave one out")
    check_folder(out, FILES)
    use_threads(1)
    results, report = measured(runs, quick)
    write(results, report, out)
    if as_json:
        print(json.dumps(plain(report), allow_nan=False))
    else:
        print_report(results, report, out)
    raise typer.Exit(min(1, report["failed"]))


def _as_seconds(text: str) -> str:
    """A number in the form that the time steps are written in; any other text as it is."""
    try:
        return f"{float(text):g}"
    except ValueError:
        return text


def measured(runs: Sequence[tuple[Case, Run]], quick: bool) -> tuple[list[Result], dict[str, Any]]:
    """The results, and everything as plain data; with a progress bar on a terminal."""
    from pbfd_torch.bench import engines
    from pbfd_torch.bench.hard_cases import NOTES, measure

    started = time.perf_counter()
    results = []
    with tqdm(total=len(runs), unit="run", disable=not sys.stderr.isatty(), leave=False) as bar:
        for case, run in runs:
            bar.set_description(f"{case.name}, {run.integrator}")
            results.append(measure(case, run))
            bar.update()
    names = {run.integrator for _, run in runs}
    return results, {
        "wall_s": time.perf_counter() - started,
        "environment": environment(),
        "quick": quick,
        "integrators": [name for name in INTEGRATORS if name in names],
        "failed": sum(bool(result.failed) for result in results),
        "laws": {case.name: case.law for case, _ in runs},
        "results": [result.plain() for result in results],
        "notes": [*NOTES, f"{engines.in_words((f'{x.case} by {x.integrator}', x.engine) for x in results)}."],
    }


def write(results: Sequence[Result], report: dict[str, Any], folder: Path) -> None:
    """The two files. Raises `InputError` where they cannot be written."""
    from pbfd_torch.bench.hard_cases_table import markdown

    write_files(
        folder,
        report,
        FILES[0],
        lambda: write_whole(folder / FILES[1], markdown(report, results)),
    )


def print_report(results: Sequence[Result], report: dict[str, Any], folder: Path) -> None:
    """Table, notes, and where the files are."""
    from pbfd_torch.bench.hard_cases_table import short, table

    console = Console(markup=False, emoji=False)
    shown = new_table("Hard cases: verdict, Δt that fail or are over, worst value/limit, fallbacks", "case")
    for name in report["integrators"]:
        shown.add_column(name, justify="left", overflow="fold")
    for line in table(results, report["integrators"], short):
        shown.add_row(*line)
    console.print(shown, "", sep="\n")
    for note in report["notes"]:
        console.print(f"- {note}")
    about = report["environment"]
    console.print(
        f"\n{len(results)} runs, {report['failed']} failed; {report['wall_s']:.0f} s; "
        f"PyTorch {about['torch']}, {about['threads']} thread, {about['processor']}"
    )
    print(f"written: {', '.join(str(folder / name) for name in FILES)}")
