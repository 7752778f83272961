"""`pbfd bench hard-cases`: what the command prints and writes, its exit status, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from pbfd_torch.bench import hard_cases
from pbfd_torch.bench.hard_cases_case import Case, Check, Run
from tests.printed import called, json_object

FILES = {"hard-cases.json", "hard-cases.md"}


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """The exit status of `pbfd bench hard-cases`."""
    return called(monkeypatch, "bench", "hard-cases", *arguments)


def too_much(run: Run) -> Sequence[Check]:
    """A law that BDF2 must keep and breaks at the larger step, and that implicit Euler may break; its number is NaN there."""
    value = 2.0 if run.dt > 0.05 else 0.5
    return [Check("number [m]", float("nan") if run.integrator == "implicit-euler" else value, 1.0, run.among(("bdf2",)))]


def test_files_and_object(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """One JSON object, the same in the file; the page has the table, the law, and every number; all holds: status 0."""
    out = tmp_path / "new" / "folder"
    chosen = ("--cases", "free-fall, rotation-oracle", "--dt", ".05,0.1", "--integrators", "implicit-euler,energy-momentum")
    assert call(monkeypatch, *chosen, "--out", out, "--json") == 0
    captured = capsys.readouterr()
    data = json_object(captured.out)
    assert captured.err == ""
    assert {file.name for file in out.iterdir()} == FILES
    assert json.loads((out / "hard-cases.json").read_text()) == data
    assert data["failed"] == 0
    assert data["integrators"] == ["implicit-euler", "energy-momentum"]
    found = [(x["case"], x["integrator"], x["dt"]) for x in data["results"]]
    both = [("free-fall", x, dt) for x in data["integrators"] for dt in (0.05, 0.1)]
    assert found == [*both, *(("rotation-oracle", "implicit-euler", dt) for dt in (0.05, 0.1))]
    for result in data["results"]:
        assert result["wall_s"] > 0
        assert {check["verdict"] for check in result["checks"]} == {"pass"}
        assert set(result["fallbacks"]) == {"warm_started", "continued", "eased", "halved"}
    page = (out / "hard-cases.md").read_text()
    assert "| case | implicit-euler | energy-momentum |" in page
    assert "6 runs, 0 failed." in page
    assert f"- **free-fall**: {data['laws']['free-fall']}" in page
    assert page.count("| position error [m] |") == 4


def test_a_failure_is_shown(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Status 1 where a limit that must hold is exceeded, 0 where it is only reported; the table says which and at which step; NaN
    becomes null."""
    monkeypatch.setattr(hard_cases, "CASES", {"too-much": Case(too_much, (0.05, 0.1), (0.05,))})
    monkeypatch.setattr("pbfd_torch.bench.hard_cases_table.CASES", hard_cases.CASES)
    arguments = ("--cases", "too-much", "--out", tmp_path)
    assert call(monkeypatch, *arguments) == 1
    printed = " ".join(capsys.readouterr().out.split())
    assert "FAIL .1" in printed
    assert "10 runs, 1 failed" in printed
    assert "hard-cases.md" in printed
    results = json.loads((tmp_path / "hard-cases.json").read_text())["results"]
    assert [x["checks"][0]["value"] for x in results if x["integrator"] == "implicit-euler"] == [None, None]
    assert call(monkeypatch, *arguments, "--integrators", "implicit-euler,variational") == 0
    assert "pass (.05 .1 over)" in capsys.readouterr().out
    assert call(monkeypatch, *arguments, "--quick") == 0
    assert "5 runs, 0 failed" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--cases", "free-fal"), "--cases is 'free-fal': must be from free-fall, rotation-oracle"),
        (("--cases", ","), "--cases is ','"),
        (("--integrators", "rk4"), "--integrators is 'rk4': must be from implicit-euler, bdf2"),
        (("--dt", "0.03"), "--dt is '0.03': must be from 0.001, 0.004, 0.01, 0.02, 0.05, 0.1"),
        (("--dt", "fast"), "--dt is 'fast'"),
        (("--cases", "rotation-oracle", "--integrators", "bdf2"), "no case is tried so: --cases 'rotation-oracle'"),
    ],
)
def test_bad_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], words: str
) -> None:
    """Status 2 and one line that names the option, its value and the valid ones; nothing is measured."""
    assert call(monkeypatch, *arguments) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_out_must_be_a_folder(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A file in the way is found before the measurement."""
    file = tmp_path / "file"
    file.write_text("")
    assert call(monkeypatch, "--out", file) == 2
    assert capsys.readouterr().err == f"pbfd: --out is '{file}': must be a folder, new or not, that can be written to\n"
