"""`pbfd bench solvers`: what it measures, prints and writes, and its words about options that it cannot use."""

from __future__ import annotations

import copy
import io
import json
import math
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pbfd_torch.bench import figure_4, table_1
from pbfd_torch.bench.timing import exponent, fit_sizes, timed, worst
from pbfd_torch.cli import bench_solvers
from pbfd_torch.solvers.named import TABLE_1
from tests.printed import Printed, called

TINY = ("--steps", "2", "--seconds", "0.05", "--sizes", "5,10", "--batch", "2", "--repeats", "1")
FILES = {"solvers.json", "fig4.png", "table1.png"}


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """The exit status of `pbfd bench solvers`."""
    return called(monkeypatch, "bench", "solvers", *arguments)


@dataclass(frozen=True)
class Ran(Printed):
    """One call of the command with --json: its exit status, what it printed, its folder, and the report before it was printed."""

    folder: Path
    measured: dict[str, Any]


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """A tiny run; L-BFGS, which needs hundreds of evaluations, is given up early."""
    folder = tmp_path_factory.mktemp("bench") / "new" / "folder"
    out, err = io.StringIO(), io.StringIO()
    kept: list[dict[str, Any]] = []
    measure = bench_solvers.measured

    def measured(*arguments: Any) -> dict[str, Any]:
        kept.append(measure(*arguments))
        return kept[-1]

    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(figure_4, "BUDGETS", {"L-BFGS, E": 20, "L-BFGS, GE": 20, "LM, GE": 20})
        patch.setattr(table_1, "STEADY_S", 0.0)
        patch.setattr(bench_solvers, "measured", measured)
        status = call(patch, *TINY, "--out", folder, "--json")
    return Ran(status, out.getvalue(), err.getvalue(), folder, kept[0])


@pytest.fixture(scope="module")
def report(ran: Ran) -> dict[str, Any]:
    """What the tiny run printed."""
    return ran.data


def numbers(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every leaf that is no text, with where it is."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from numbers(item, f"{path}/{key}")
    elif isinstance(value, list):
        for item in value:
            yield from numbers(item, path)
    elif not isinstance(value, str):
        yield path, value


def test_tiny_run_writes_its_files(ran: Ran, report: dict[str, Any]) -> None:
    """It ends well, silently but for the object; the folder holds the three files, and the JSON one says the same."""
    assert (ran.status, ran.err) == (0, "")
    assert {file.name for file in ran.folder.iterdir()} == FILES
    assert json.loads((ran.folder / "solvers.json").read_text()) == report
    for name in ("fig4.png", "table1.png"):
        assert (ran.folder / name).read_bytes().startswith(b"\x89PNG")
    about = report["environment"]
    assert (about["threads"], about["dtype"]) == (1, "float64")
    assert about["torch"]


@pytest.mark.parametrize("chain", figure_4.CHAINS)
def test_figure_4_has_every_case(report: dict[str, Any], chain: str) -> None:
    """All six cases and the default, with costs, errors and as many curve points as steps were measured."""
    found = report["figure_4"]["chains"][chain]
    assert set(found["cases"]) == {*TABLE_1, "default"}
    assert (found["steps"], found["worlds"]) == (2, 1)
    assert found["reference_residual_norm_max"] <= 1e-11
    for case, row in found["cases"].items():
        assert 1 <= row["measured_steps"] <= 2
        assert 0 <= row["unsolved_steps"] <= row["measured_steps"]
        assert 0 < row["time_ms"]["mean"] <= row["time_ms"]["max"]
        assert 0 <= row["iterations"]["mean"] <= row["iterations"]["p95"] <= row["iterations"]["max"]
        assert row["residual_norm_max"] >= 0
        assert row["time_of_default"] > 0
        assert {len(curve) for curve in row["per_step"].values()} == {row["measured_steps"]}
        if row["unsolved_steps"] == 0:
            assert row["residual_norm_max"] <= 1e-9
            assert row["tip_error_max_m"] < 1e-9, case
    default = found["cases"]["default"]
    assert (default["measured_steps"], default["unsolved_steps"], default["time_of_default"]) == (2, 0, 1)


def test_matrix_cases_solve_the_fixed_chain(report: dict[str, Any]) -> None:
    """Without contact E and GE have the same solution, and all cases with matrices find it at the first step."""
    cases = report["figure_4"]["chains"]["chain-fixed"]["cases"]
    for case in ("LM, E", "JTJ-LM, E", "LM, GE", "JTJ-LM, GE", "default"):
        assert cases[case]["unsolved_steps"] == 0
        assert cases[case]["tip_error_max_solved_m"] < 1e-10


def test_table_1_has_every_substep(report: dict[str, Any]) -> None:
    """Costs for both sizes, an exponent and a small error for each substep, in all variants; the paper's exponents beside."""
    table = report["table_1"]
    assert (table["sizes"], table["fit_sizes"]) == ([5, 10], [5, 10])
    assert set(table["variants"]) == {"2 worlds, no contact", "2 worlds, contact", "1 world, no contact"}
    for found in table["variants"].values():
        assert set(found["substeps"]) == set(table_1.SUBSTEPS)
        assert set(found["iterations"]) == {*TABLE_1, "default"}
        for row in (*found["substeps"].values(), *found["iterations"].values()):
            assert all(cost > 0 for cost in row["us_per_world"])
            assert len(row["us_per_world"]) == 2
            assert math.isfinite(row["exponent"])
    for name, row in table["variants"]["1 world, no contact"]["substeps"].items():
        assert row["error_max"] is None if name == "gauss_newton_E" else row["error_max"] < 1e-9
    assert table["paper"]["LM, GE"] == {"gradient": 2, "hessian": 3, "inversion": 2, "total": 3, "total_on_cpu": 3}
    assert set(table["paper"]) == set(TABLE_1)


def test_numbers_are_there(report: dict[str, Any]) -> None:
    """None stands only for what does not apply, or for a derivative that is not finite."""
    absent = {path.rpartition("/")[2] for path, value in numbers(report) if value is None}
    assert absent <= {"budget", "pbfd_torch", "tip_error_max_solved_m", "error_max", "hessian", "inversion"}


def test_tables_on_the_terminal(ran: Ran, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Without --json there are tables with every case and substep, the notes, and where the files are."""
    monkeypatch.setattr(bench_solvers, "measured", lambda *arguments: ran.measured)
    monkeypatch.setattr(bench_solvers, "write", lambda report, folder: None)
    assert call(monkeypatch, *TINY) == 0
    printed = " ".join(capsys.readouterr().out.split())
    for words in (
        "Fig. 4, chain-fixed: 2 steps of 0.01 s",
        "Fig. 4, chain-ground: 2 steps of 0.02 s",
        "Table I, 2 worlds",
        *TABLE_1,
    ):
        assert words in printed
    assert "on E friction is lagged" in printed
    assert "fig4.png" in printed


def test_unsolved_default_ends_with_status_1(ran: Ran, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Steps that the default leaves unsolved are reported, and the exit status says so."""
    broken = copy.deepcopy(ran.measured)
    broken["figure_4"]["chains"]["chain-ground"]["cases"]["default"]["unsolved_steps"] = 2
    monkeypatch.setattr(bench_solvers, "measured", lambda *arguments: broken)
    monkeypatch.setattr(bench_solvers, "write", lambda report, folder: None)
    assert call(monkeypatch, *TINY) == 1
    assert "2/2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--steps", "0"), "--steps is 0: must be from 1 to 10000"),
        (("--worlds", "0"), "--worlds is 0: must be from 1 to 4096"),
        (("--batch", "5000"), "--batch is 5000: must be from 1 to 4096"),
        (("--repeats", "-1"), "--repeats is -1: must be from 1 to 1000"),
        (("--dt", "0"), "--dt is 0 s: must be from 1e-05 to 0.1"),
        (("--dt", "nan"), "--dt is nan s: must be from 1e-05 to 0.1"),
        (("--seconds", "inf"), "--seconds is inf s: must be from 0.001 to 100000"),
        (("--sizes", "5"), "--sizes is '5': must be at least two different numbers from 2 to 200, such as 5,10,20"),
        (("--sizes", "5,5"), "--sizes is '5,5': must be"),
        (("--sizes", "5,ten"), "--sizes is '5,ten': must be"),
        (("--sizes", "5,201"), "--sizes is '5,201': must be"),
        (("--sizes", "1,5"), "--sizes is '1,5': must be"),
    ],
)
def test_bad_options(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, options: tuple[str, str], words: str
) -> None:
    """Status 2 and one line that names value and range, before anything is measured or written."""
    folder = tmp_path / "out"
    assert call(monkeypatch, *options, "--out", folder) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(f"pbfd: {words}")
    assert printed.err.count("\n") == 1
    assert not folder.exists()


def test_out_must_be_a_folder(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A file in the way is found before the measurement."""
    file = tmp_path / "file"
    file.write_text("")
    for out in (file, file / "below"):
        assert call(monkeypatch, "--out", out) == 2
        assert capsys.readouterr().err == f"pbfd: --out is '{out}': must be a folder, new or not, that can be written to\n"


def test_exponent_of_synthetic_costs() -> None:
    """Costs of 3n² have the exponent 2, on any two sizes or more."""
    sizes = [5, 10, 20, 40, 80]
    assert exponent(sizes, [3 * n**2 for n in sizes]) == pytest.approx(2, abs=1e-12)
    assert exponent([5, 10], [4.0, 32.0]) == pytest.approx(3, abs=1e-12)
    assert fit_sizes(sizes) == [20, 40, 80]
    assert fit_sizes([10, 5]) == [5, 10]
    assert fit_sizes([4, 3, 2]) == [3, 4]


def test_timed_stops_when_enough_time_is_spent() -> None:
    """It gives the first result, calls as often as told, and only once where that one call takes long enough."""
    calls: list[int] = []

    def prepare() -> Any:
        number = len(calls)
        calls.append(number)
        return lambda: number

    result, seconds = timed(prepare, 4, enough_s=math.inf)
    assert (result, len(calls)) == (0, 4)
    assert seconds >= 0
    timed(prepare, 4, enough_s=0.0)
    assert len(calls) == 5


def test_worst_sees_what_is_not_finite() -> None:
    """`max` passes over a NaN that comes second."""
    assert worst([1.0, 2.0]) == 2.0
    assert math.isnan(worst([1.0, math.nan]))
    assert math.isnan(worst([math.inf]))


@pytest.mark.parametrize("count", [1, 2, 3, 60, 64])
def test_spread_visits_every_step_once(count: int) -> None:
    """Any prefix is spread over the range: its largest gap shrinks as it grows."""
    order = list(figure_4.spread(count))
    assert sorted(order) == list(range(count))
    if count == 64:
        assert order[:8] == [0, 32, 16, 48, 8, 40, 24, 56]
