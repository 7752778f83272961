"""`pbfd bench slope`: the runs behind Fig. 6, the verdicts on the paper's claims, and what the command prints and writes."""

from __future__ import annotations

import copy
import io
import json
import math
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from pbfd_torch.bench import figure_6, figure_6_claims, mujoco_runs
from pbfd_torch.bench.figure_6 import (
    FORMULATIONS,
    OURS,
    STARTS,
    Case,
    Effort,
    Row,
    best_step,
    measure_run,
    observed,
    pose_rates,
    snapshots,
)
from pbfd_torch.bench.figure_6_claims import claims, markdown, verdict
from pbfd_torch.bench.figure_6_peers import PEERS
from pbfd_torch.cli import bench_slope
from pbfd_torch.models import chains
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from tests.printed import Printed, called

TINY = Effort(
    duration=0.2,
    time_steps=(0.02, 0.1),
    worlds=2,
    batch_steps=1,
    repeats=1,
    most_steps=4,
    points=(2, 3),
    frictions=(0.2, 0.9),
    starts=("dropped",),
)
SLIDE = chains.SLIDE


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """The exit status of `pbfd bench slope`."""
    return called(monkeypatch, "bench", "slope", *arguments)


# Runs ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("simulator", FORMULATIONS)
def test_laid_chain_slides_as_coulomb_has_it(simulator: str) -> None:
    """x = ½ g (sin − μ cos) T²: ours exactly, Newton–Euler ½ a T Δt further, its velocity being that of the step's end. All 20
    points touch, it is stable, and both times are there."""
    row = measure_run(simulator, Case("laid", 0.05, 8), worlds=3)
    late = 0.5 * SLIDE * 0.4 * 0.05 if simulator == "conventional" else 0.0
    assert row["margin_m"] == pytest.approx(late, abs=1e-4)
    assert row["speed_m_s"] == pytest.approx(SLIDE * 0.4, rel=0.1)
    assert (row["in_touch"], row["unsolved_steps"], row["stable"]) == (20.0, 0, True)
    assert set(row["ms_per_s"]) == {"1", "3"}
    assert min(row["ms_per_s"].values()) > 0


@pytest.mark.parametrize("simulator", PEERS)
def test_mujoco_slides_too(simulator: str) -> None:
    """A few steps of a tenth of a second: within a tenth of the way, with all its points, four per link."""
    row = measure_run(simulator, Case("laid", 0.001, 100, points=4))
    assert row["stable"]
    assert row["margin_m"] == pytest.approx(0.0, abs=0.1 * 0.5 * SLIDE * 0.1**2)
    assert row["in_touch"] > 20
    assert row["ms_per_s"]["1"] > 0
    stuck = measure_run(simulator, Case("laid", 0.001, 100, mu=1.0))
    assert stuck["speed_m_s"] < 0.02 < SLIDE * 0.1


def test_explicit_bias_breaks_newton_euler() -> None:
    """At Δt = .05 hinges that turn at 5 rad/s blow it up; ours stay stable over the same time, and no batch is timed of what is
    unstable."""
    case = Case("scattered", 0.05, 12)
    broken, ours = (measure_run(simulator, case, worlds=2) for simulator in ("conventional", "implicit-euler"))
    assert not broken["stable"]
    assert "2" not in broken["ms_per_s"]
    assert (ours["stable"], ours["unsolved_steps"], ours["energy_gain"]) == (True, 0, pytest.approx(0.0, abs=1e-3))


@pytest.mark.parametrize(("lift", "stable"), [(0.0, True), (0.001, True), (0.005, False), (math.nan, False)])
def test_rise_of_energy(lift: float, stable: bool) -> None:
    """A chain at rest that is lifted by h off the slope gains m g h cos 30°, in units of m g times its radius."""
    case = Case("laid", 0.1, 2)
    q, v = STARTS["laid"].state()
    path = q.repeat(3, 1, 1)
    path[2, :, 2] += lift
    row = observed(case, path, pose_rates(case.scene(), path, v.repeat(3, 1, 1)))
    assert row["stable"] is stable
    assert row["finite"] is math.isfinite(lift)
    if row["finite"]:
        expected = lift * math.cos(chains.SLOPE) / chains.RADIUS
        assert row["energy_gain"] == pytest.approx(expected, abs=1e-9)


def test_starts_and_laws() -> None:
    """The scattered hinges, and no others, turn, always the same way; PBFD's law has the C∥ that gives μ at 1 m/s."""
    for name, start in STARTS.items():
        q, v = start.state()
        assert (q.shape, v.shape) == ((1, 16), (1, 15))
        assert (v[:, :6] == 0).all()
        assert bool((v[:, 6:] != 0).all()) is (name == "scattered")
        torch.testing.assert_close(start.state(), (q, v), rtol=0, atol=0)
    (contact,) = (x for x in Case("laid", 0.1, 1, mu=0.4, law="PBFD").scene().terms if isinstance(x, Contact))
    assert isinstance(contact.friction, PbfdFriction)
    assert float(contact.friction.stiffness) * 2 * figure_6.SPEED * 0.1 / chains.STIFFNESS == pytest.approx(0.4)


def test_pictures_of_the_scene() -> None:
    """Ten links of their length, above the slope, further down it each time."""
    found = list(snapshots(every=5, count=3))
    assert [picture["time_s"] for picture in found] == pytest.approx([0.0, 0.1, 0.2])
    for picture in found:
        x, z = torch.tensor(picture["x_m"]), torch.tensor(picture["z_m"])
        torch.testing.assert_close(torch.hypot(x.diff(), z.diff()), torch.full((10,), chains.LENGTH))
        assert (z + math.tan(chains.SLOPE) * x).min() > 0
    heights = [sum(picture["z_m"]) for picture in found]
    assert heights == sorted(heights, reverse=True)


# Claims -------------------------------------------------------------------------------------------------------------------


def made_up(broken_at: float = math.inf, slower: float = 1.0, ours: float = 1.0) -> dict[str, Any]:
    """A report of numbers as the paper would have them, but for Newton–Euler's smallest unstable step [s], what its time grows by
    from few to many contacts and over μ, and how many times slower ours are."""

    def row(simulator: str, dt: float, time: float, **changes: Any) -> Row:
        return {
            "simulator": simulator,
            "start": "dropped",
            "dt": dt,
            "steps": 10,
            "simulated_s": 1.0,
            "points": 2,
            "mu": 0.3,
            "law": "Coulomb",
            "stable": simulator != "conventional" or dt < broken_at,
            "finite": True,
            "energy_gain": 0.0,
            "margin_m": 0.0,
            "penetration_mm": 0.1,
            "in_touch": 20.0,
            "unsolved_steps": 0,
            "speed_m_s": 1.0,
            "ms_per_s": {"1": time, "256": time / 10},
            **changes,
        }

    steps = [row("implicit-euler", dt, 10.0 * ours) for dt in (0.001, 0.0025, 0.1)]
    steps += [row("implicit-euler-torch", dt, 10.0 * ours) for dt in (0.001, 0.0025, 0.1)]
    steps += [row("energy-momentum", dt, 10.0 * ours) for dt in (0.001, 0.0025, 0.1)]
    steps += [row("conventional", dt, 0.08 / dt) for dt in (0.001, 0.0025, 0.1)]
    contacts = [row("implicit-euler", 0.1, 10.0 * ours * k, points=n, in_touch=10.0 * n) for n, k in ((2, 1.0), (32, 1.2))]
    contacts += [row("conventional", 0.1, 10.0 * k, points=n, in_touch=10.0 * n) for n, k in ((2, 1.0), (32, slower))]
    friction = [row("implicit-euler", 0.1, 10.0 * k, mu=mu, law=law) for law in figure_6.LAWS for mu, k in ((0.1, 1.0), (1.0, 1.1))]
    friction += [row("conventional", 0.1, 10.0 * k, mu=mu) for mu, k in ((0.1, 1.0), (1.0, slower))]
    best = {"dropped": {key: best_step(steps, key, "dropped") for key in FORMULATIONS}}
    return {"time_steps": steps, "contacts": contacts, "friction": friction, "best_dt": best, "duration_s": 10.0, "worlds": 256}


def verdicts(report: dict[str, Any]) -> list[str]:
    return [claim["verdict"] for claim in claims(report)]


HOLDS, FAILS, MISSING = "holds", "does not hold", "not measured"


def test_claims_on_made_up_numbers() -> None:
    """Each follows its own numbers: limits, ours at 0.1 s, 3 and 5 times, fastest, contacts of both, flat in μ, fluctuation."""
    assert verdicts(made_up(0.005, 3.0)) == [HOLDS, MISSING, *[HOLDS] * 6, "holds in part", HOLDS]
    assert verdicts(made_up(slower=1.0)) == [FAILS, MISSING, HOLDS, HOLDS, HOLDS, FAILS, FAILS, HOLDS, HOLDS, FAILS]
    assert verdicts(made_up(0.005, 1.2, ours=2.0))[3:5] == [FAILS, FAILS]
    assert "3.2x (1 world), 3.2x (256 worlds)" in claims(made_up())[3]["measured"]
    assert claims(made_up())[5]["measured"].startswith("dropped 0.08x, 0.001 s against 0.1 s (1 world)")
    assert claims(made_up(0.0))[5]["measured"] == "dropped: the other is stable nowhere"
    assert verdicts(made_up(0.0))[5] == MISSING
    assert claims(made_up(0.005))[0]["measured"] == "Newton–Euler: dropped up to 0.0025 s"
    assert claims(made_up(0.0))[0]["measured"] == "Newton–Euler: dropped not even at 0.001 s"
    report = made_up()
    unsolved = [row for row in report["time_steps"] if row["simulator"] in OURS and row["dt"] == 0.1]
    unsolved[0]["unsolved_steps"] = 1
    assert verdicts(report)[2] == "holds in part"


def test_verdict() -> None:
    assert [verdict(x) for x in ([], [True], [True, False], [False])] == [MISSING, HOLDS, "holds in part", FAILS]


def test_best_step_needs_all_smaller_ones() -> None:
    """A large step that happens to survive where a smaller one does not is no stable step; nor is one of another start."""
    rows = [
        {"simulator": "a", "start": "laid", "dt": dt, "stable": stable}
        for dt, stable in ((0.1, True), (0.01, False), (0.001, True))
    ]
    assert best_step(rows, "a", "laid") == 0.001
    assert best_step(rows[:2], "a", "laid") is None
    assert best_step(rows, "a", "dropped") is None


def test_markdown_of_blown_up_rows() -> None:
    """NaN and what has no time become dashes; all lines of a table are as wide as its header."""
    report = made_up(0.005, 3.0)
    gone = {"finite": False, "margin_m": math.nan, "energy_gain": math.nan, "in_touch": math.nan, "ms_per_s": {}}
    report["time_steps"][-1].update(gone)
    text = markdown({**report, "claims": claims(report), "notes": list(figure_6_claims.NOTES)})
    assert "| Newton–Euler | 0.1 | 1 | – | – | NaN | – | – | 0.1 | 0/10 |" in text
    assert "nan" not in text
    for table in text.split("\n\n"):
        assert len({line.count(" | ") for line in table.split("\n") if line.startswith("| ")}) <= 1


# The command --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ran(Printed):
    """One call of the command with --quick --json: its exit status, what it printed, and its folder."""

    folder: Path


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """A run as quick as can be."""
    folder = tmp_path_factory.mktemp("bench") / "new" / "folder"
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(figure_6, "QUICK", TINY)
        status = call(patch, "--quick", "--out", folder, "--json")
    return Ran(status, out.getvalue(), err.getvalue(), folder)


def test_run_writes_its_files(ran: Ran) -> None:
    """It ends well, silently but for the object; the folder holds the files, and the JSON one says the same."""
    assert (ran.status, ran.err) == (0, "")
    assert {file.name for file in ran.folder.iterdir()} == set(bench_slope.FILES)
    assert json.loads((ran.folder / "slope.json").read_text()) == ran.data
    assert (ran.folder / "figure-6.png").read_bytes().startswith(b"\x89PNG")
    text = (ran.folder / "slope.md").read_text()
    for claim in ran.data["claims"]:
        assert f"| {claim['paper']} | {claim['measured']} | {claim['verdict']} |" in text


def test_panels_of_the_run(ran: Ran) -> None:
    """(b): every simulator, start and Δt; (c): its own Δt and the common one; (d): every μ, and PBFD's law for ours."""
    data, simulators = ran.data, [*FORMULATIONS, *PEERS]
    assert [(row["start"], row["simulator"], row["dt"]) for row in data["time_steps"]] == [
        (start, simulator, dt) for start in TINY.starts for simulator in simulators for dt in TINY.time_steps
    ]
    for start, best in data["best_dt"].items():
        assert {key: best_step(data["time_steps"], key, start) for key in simulators} == best
    for key, dt in data["own_dt"].items():
        steps = {row["dt"] for row in data["contacts"] if row["simulator"] == key}
        assert steps == {dt, figure_6.COMMON_STEP}
        rows = [row for row in data["friction"] if row["simulator"] == key]
        assert [(row["mu"], row["dt"]) for row in rows if row["law"] == "Coulomb"] == [(mu, dt) for mu in TINY.frictions]
        assert len(rows) == len(TINY.frictions) * (2 if key == "implicit-euler" else 1)
    for row in [*data["time_steps"], *data["contacts"], *data["friction"]]:
        assert row["steps"] <= (TINY.most_steps if row["simulator"] in OURS else 100)
        assert row["simulated_s"] == pytest.approx(row["steps"] * row["dt"])
        assert row["unsolved_steps"] == 0


def test_progress_counts_every_run(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many units as are announced, with MuJoCo and without."""
    monkeypatch.setattr(
        figure_6, "measure_run", lambda simulator, case, *_, **__: {**case.__dict__, "simulator": simulator, "stable": True}
    )
    for version, simulators in ((mujoco_runs.version(), 7), (None, 4)):
        monkeypatch.setattr(mujoco_runs, "version", lambda version=version: version)
        told: list[int] = []
        found = figure_6.measure(TINY, told.append)
        assert sum(told) == figure_6.units(TINY)
        assert len(found["time_steps"]) == simulators * len(TINY.time_steps)


def test_tables_on_the_terminal_and_status(ran: Ran, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Without --json there are the panels, the claims and the notes. A step that ours leave unsolved makes the status 1."""
    monkeypatch.setattr(bench_slope, "write", lambda report, folder: None)
    for simulator, status in (("conventional", 0), ("implicit-euler", 1)):
        shown = copy.deepcopy(ran.data)
        next(row for row in shown["time_steps"] if row["simulator"] == simulator)["unsolved_steps"] = 3
        monkeypatch.setattr(bench_slope, "measured", lambda *arguments, shown=shown: shown)
        assert call(monkeypatch) == status
        printed = " ".join(capsys.readouterr().out.split())
        for words in ("(b) pitched by 20°", "(c)", "(d)", "MuJoCo RK4", "HOLD", figure_6_claims.NOTES[0], "figure-6.png"):
            assert words in printed


def test_duration_is_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """--duration replaces that of the effort, quick or not."""
    asked: list[Effort] = []

    def measured(effort: Effort, engine: object) -> dict[str, Any]:
        asked.append(effort)
        return {"time_steps": [], "contacts": [], "friction": []}

    monkeypatch.setattr(bench_slope, "measured", measured)
    monkeypatch.setattr(bench_slope, "write", lambda report, folder: None)
    for arguments in (["--duration", 3, "--quick"], ["--quick"], []):
        assert call(monkeypatch, *arguments, "--json", "--out", tmp_path) == 0
    assert [effort.duration for effort in asked] == [3.0, figure_6.QUICK.duration, 10.0]


@pytest.mark.parametrize("duration", ["0", "-1", "nan", "inf", "61"])
def test_bad_duration(duration: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """It is named, with what is valid."""
    assert call(monkeypatch, "--duration", duration) == 2
    assert capsys.readouterr().err == f"pbfd: --duration is {duration} s: must be from 0.1 to 60\n"


def test_out_must_be_a_folder(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A file in the way is found before the measurement."""
    file, taken = tmp_path / "file", tmp_path / "taken"
    file.write_text("")
    (taken / "slope.md").mkdir(parents=True)
    for out in (file, file / "below", taken):
        assert call(monkeypatch, "--out", out) == 2
        assert capsys.readouterr().err == f"pbfd: --out is '{out}': must be a folder, new or not, that can be written to\n"
