"""`pbfd bench solvers`: Fig. 4 and Table I of the paper, measured."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from pbfd_torch.cli.benchmarks import environment, new_table, plain, three_digits, write_files
from pbfd_torch.cli.options import Choices, EngineChoice, EngineOption, load_setup, use_threads
from pbfd_torch.cli.outputs import check_folder
from pbfd_torch.cli.ranges import MEASURED_SECONDS, MEASURED_STEP, MEASURED_STEPS, MEASURED_WORLDS, REPEATS
from pbfd_torch.errors import InputError
from pbfd_torch.native.engine import Engine

MOST_DOFS = 200
FILES = ("solvers.json", "fig4.png", "table1.png")


def solvers(
    out: Annotated[Path, typer.Option(help=f"Folder for {', '.join(FILES)}.")] = Path("bench-solvers"),
    steps: Annotated[int, MEASURED_STEPS.option("Fig. 4: steps of each chain.")] = 60,
    dt: Annotated[float | None, MEASURED_STEP.option("Fig. 4: time step in seconds; default: each scene's.")] = None,
    worlds: Annotated[int, MEASURED_WORLDS.option("Fig. 4: worlds, all but the first with small extra velocities.")] = 1,
    seconds: Annotated[
        float, MEASURED_SECONDS.option("Fig. 4: time for each case on each chain; slow ones get through fewer steps.")
    ] = 12.0,
    sizes: Annotated[str, typer.Option(help="Table I: degrees of freedom, separated by commas.")] = "5,10,20,40,80",
    batch: Annotated[int, MEASURED_WORLDS.option("Table I: worlds in the batch, beside a single one.")] = 256,
    repeats: Annotated[int, REPEATS.option("Times that a short measurement is repeated; the shortest counts.")] = 5,
    engine: EngineOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")] = False,
) -> None:
    """Compares LM, JTJ-LM and L-BFGS on E and GE with the default: Fig. 4 (iterations, time and error of every step of two chains)
    and Table I (cost of each substep over the degrees of freedom). Solves and substeps are PyTorch's, all of them; --engine makes
    the motions that Fig. 4 takes its steps from. One thread, float64. Exit status 1: the default left a step unsolved."""
    counts = parsed_sizes(sizes)
    check_folder(out, FILES)
    use_threads(1)
    report = measured(steps, dt, worlds, seconds, counts, batch, repeats, EngineChoice.engine(engine))
    write(report, out)
    if as_json:
        print(json.dumps(plain(report), allow_nan=False))
    else:
        print_report(report, out)
    raise typer.Exit(min(1, sum(chain["cases"]["default"]["unsolved_steps"] for chain in report["figure_4"]["chains"].values())))


def parsed_sizes(text: str) -> list[int]:
    """Ascending degrees of freedom. Raises `InputError` for what is no list of at least two different sizes."""
    try:
        found = sorted({int(part) for part in text.split(",")})
    except ValueError:
        found = []
    if len(found) < 2 or found[0] < 2 or found[-1] > MOST_DOFS:
        raise InputError(f"--sizes is '{text}': must be at least two different numbers from 2 to {MOST_DOFS}, such as 5,10,20")
    return found


def measured(
    steps: int, dt: float | None, worlds: int, seconds: float, sizes: Sequence[int], batch: int, repeats: int,
    engine: Engine | None,
) -> dict[str, Any]:  # fmt: skip
    """Everything that the command measures, as plain data; with a progress bar on a terminal."""
    from pbfd_torch.bench import figure_4, table_1
    from pbfd_torch.bench.timing import fit_sizes

    started = time.perf_counter()
    variants = table_1.variants(batch)
    total = len(figure_4.CHAINS) * len(figure_4.CASES) * steps + len(variants) * table_1.units(sizes)
    with tqdm(total=total, unit="measurement", disable=not sys.stderr.isatty(), leave=False) as bar:
        chains = {}
        for name in figure_4.CHAINS:
            bar.set_description(name)
            setup = load_setup(name, worlds, Choices(seed=0))
            chains[name] = figure_4.measure_chain(setup, dt or setup.dt, steps, seconds, repeats, bar.update, engine)
        costs = {}
        for variant in variants:
            bar.set_description(f"Table I, {variant.key}")
            costs[variant.key] = table_1.measure_variant(variant, sizes, repeats, bar.update)
    return {
        "wall_s": time.perf_counter() - started,
        "environment": environment(),
        "figure_4": {"chains": chains, "seconds_per_case": seconds, "repeats": repeats, "notes": list(figure_4.NOTES)},
        "table_1": {
            "sizes": list(sizes),
            "fit_sizes": fit_sizes(sizes),
            "repeats": repeats,
            "variants": costs,
            "paper": {
                case: dict(zip(("gradient", "hessian", "inversion", "total"), row.paper, strict=True))
                | {"total_on_cpu": row.paper_cpu_total}
                for case, row in table_1.ROWS.items()
            },
            "notes": list(table_1.NOTES),
        },
    }


def write(report: dict[str, Any], folder: Path) -> None:
    """The three files. Raises `InputError` where they cannot be written."""
    from pbfd_torch.bench.pictures import draw_figure_4, draw_table_1

    table = report["table_1"]
    write_files(
        folder,
        report,
        FILES[0],
        lambda: draw_figure_4(report["figure_4"]["chains"], folder / FILES[1]),
        lambda: draw_table_1(table["sizes"], table["fit_sizes"], table["variants"], folder / FILES[2]),
    )


def print_report(report: dict[str, Any], folder: Path) -> None:
    """Tables, notes, and where the files are."""
    console = Console(markup=False, emoji=False)
    about = report["environment"]
    for name, chain in report["figure_4"]["chains"].items():
        console.print(_figure_4_table(name, chain), "", sep="\n")
    for note in report["figure_4"]["notes"]:
        console.print(f"- {note}")
    table = report["table_1"]
    console.print("", _table_1_rows(table), "", sep="\n")
    for title, found in table["variants"].items():
        console.print(_substep_table(title, found, table["sizes"]), "", sep="\n")
    for note in table["notes"]:
        console.print(f"- {note}")
    console.print(
        f"\n{report['wall_s']:.0f} s; PyTorch {about['torch']}, {about['threads']} thread, {about['dtype']}, {about['processor']}"
    )
    print(f"written: {', '.join(str(folder / name) for name in FILES)}")


def _figure_4_table(name: str, chain: dict[str, Any]) -> Table:
    table = new_table(
        f"Fig. 4, {name}: {chain['steps']} steps of {chain['dt']:g} s, worlds: {chain['worlds']}; reference solved to "
        f"{_number(chain['reference_residual_norm_max'])}; motion: {chain['engine']}, solves: torch",
        *("case", "budget", "failed\n/steps", "iterations\nmean/p95/max", "time [ms]\nmean/p95/max", "×\ndefault"),
        *("largest\nresidual", "tip error\n[m]"),
    )
    for case, found in chain["cases"].items():
        table.add_row(
            case,
            str(found["budget"] or ""),
            f"{found['unsolved_steps']}/{found['measured_steps']}",
            "/".join(three_digits(found["iterations"][key]) for key in ("mean", "p95", "max")),
            "/".join(three_digits(found["time_ms"][key]) for key in ("mean", "p95", "max")),
            three_digits(found["time_of_default"]),
            _number(found["residual_norm_max"]),
            _number(found["tip_error_max_m"]),
        )
    return table


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.1e}"


def _table_1_rows(table: dict[str, Any]) -> Table:
    """The paper's Table I with our exponents: measured (paper)."""
    from pbfd_torch.bench.table_1 import ROWS

    fit, (title, found) = table["fit_sizes"], next(iter(table["variants"].items()))
    result = new_table(
        f"Table I, {title}: exponents over n = {fit[0]} … {fit[-1]}, measured (paper)",
        *("case", "gradient", "Hessian", "solve (paper: GPU)", "iteration (paper: GPU, CPU)"),
    )
    for case, row in ROWS.items():
        parts = [
            "/" if name is None else f"{found['substeps'][name]['exponent']:.1f} ({'/' if paper is None else paper})"
            for name, paper in zip((row.gradient, row.hessian, row.solve), row.paper[:3], strict=True)
        ]
        result.add_row(case, *parts, f"{found['iterations'][case]['exponent']:.1f} ({row.paper[3]}, {row.paper_cpu_total})")
    result.add_row("default", "", "", "", f"{found['iterations']['default']['exponent']:.1f}")
    return result


def _substep_table(title: str, found: dict[str, Any], sizes: Sequence[int]) -> Table:
    columns = [f"n = {n}" for n in sizes]
    result = new_table(
        f"{title} (autodiff: {found['worlds_of_autodiff']}): time per world [µs]", "substep", *columns, "exponent", "error"
    )
    for row in found["substeps"].values():
        result.add_row(row["label"], *map(three_digits, row["us_per_world"]), f"{row['exponent']:.2f}", _number(row["error_max"]))
    for case, row in found["iterations"].items():
        result.add_row(f"iteration: {case}", *map(three_digits, row["us_per_world"]), f"{row['exponent']:.2f}", "")
    return result
