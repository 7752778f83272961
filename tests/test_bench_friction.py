"""`pbfd bench friction`: Fig. 5 of the paper, PBD's artefact included, and what the command prints and writes."""

from __future__ import annotations

import copy
import io
import json
import math
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from pbfd_torch.bench import figure_5
from pbfd_torch.cli import bench_friction
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from tests.printed import Printed, called

FILES = {"friction.json", "fig5.png"}
DURATION = 2.0


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """The exit status of `pbfd bench friction`."""
    return called(monkeypatch, "bench", "friction", *arguments)


@dataclass(frozen=True)
class Ran(Printed):
    """One call of the command with --quick --json: its exit status, what it printed, and its folder."""

    folder: Path


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """The quick run, over half its time."""
    folder = tmp_path_factory.mktemp("bench") / "new" / "folder"
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(figure_5, "DURATION", DURATION)
        status = call(patch, "--quick", "--out", folder, "--json")
    return Ran(status, out.getvalue(), err.getvalue(), folder)


@pytest.fixture(scope="module")
def curves(ran: Ran) -> dict[str, dict[str, Any]]:
    """Case → time step → curve."""
    found: dict[str, dict[str, Any]] = ran.data["curves"]
    return found


def test_quick_run_writes_its_files(ran: Ran) -> None:
    """It ends well, silently but for the object; the folder holds both files, and the JSON one says the same."""
    assert (ran.status, ran.err) == (0, "")
    assert {file.name for file in ran.folder.iterdir()} == FILES
    assert json.loads((ran.folder / "friction.json").read_text()) == ran.data
    assert (ran.folder / "fig5.png").read_bytes().startswith(b"\x89PNG")
    assert ran.data["environment"]["dtype"] == "float64"


def test_every_step_is_solved(curves: dict[str, dict[str, Any]]) -> None:
    """All laws, all time steps, all values; each curve says what it cost."""
    assert set(curves) == set(figure_5.CASES)
    for case in curves.values():
        assert set(case) == {f"{dt:g}" for dt in figure_5.QUICK_TIME_STEPS}
        for dt, curve in case.items():
            assert curve["unsolved_steps"] == 0
            assert curve["steps"] == round(DURATION / float(dt))
            assert curve["evaluations"] >= 1
            assert curve["us_per_step"] > 0
            assert {len(curve[key]) for key in ("values", "distance_m", "expected_m", "final_speed_m_s")} == {9}


@pytest.mark.parametrize("case", ["coulomb", "pbfd-printed", "pbfd-derived"])
def test_distance_falls_with_friction(curves: dict[str, dict[str, Any]], case: str) -> None:
    """Coulomb's and both PBFD laws: more friction, shorter slides, at every time step."""
    for curve in curves[case].values():
        distance = curve["distance_m"]
        assert all(after < before for before, after in pairwise(distance))
        assert curve["falls"]
        assert curve["least_at"] == curve["values"][-1]


@pytest.mark.parametrize("case", ["pbd", "pbd-energy"])
def test_distance_of_pbd_rises_past_a_threshold(curves: dict[str, dict[str, Any]], case: str) -> None:
    """PBD: the distance falls, then rises until the box slides as without friction: sooner and more at the larger step."""
    least = {}
    for dt, curve in curves[case].items():
        distance = curve["distance_m"]
        turn = distance.index(min(distance))
        assert 0 < turn < len(distance) - 1
        assert all(after < before for before, after in pairwise(distance[: turn + 1]))
        assert all(after > before for before, after in pairwise(distance[turn:]))
        assert not curve["falls"]
        assert (curve["least_m"], curve["least_at"]) == (distance[turn], curve["values"][turn])
        assert distance[-1] > 0.99 * figure_5.SPEED * DURATION
        least[float(dt)] = (curve["least_at"], curve["least_m"])
    (small, large) = (least[dt] for dt in figure_5.QUICK_TIME_STEPS)
    assert large[0] < small[0]
    assert large[1] > small[1]


def test_pbd_is_the_minimum_of_its_energy(curves: dict[str, dict[str, Any]]) -> None:
    """The root of the gradient and the minimum of E (Eq. 6) are the same motion, to 1e-7 of the distance."""
    for dt in curves["pbd"]:
        assert curves["pbd-energy"][dt]["distance_m"] == pytest.approx(curves["pbd"][dt]["distance_m"], rel=1e-7)


def test_coulombs_distance(curves: dict[str, dict[str, Any]]) -> None:
    """v²/(2μg), within 0.5 % wherever the box stops in four steps or more."""
    for dt, curve in curves["coulomb"].items():
        for mu, distance in zip(curve["values"], curve["distance_m"], strict=True):
            if figure_5.SPEED / (mu * figure_5.GRAVITY * float(dt)) >= 4:
                assert distance == pytest.approx(figure_5.SPEED**2 / (2 * mu * figure_5.GRAVITY), rel=5e-3)
        assert curve["moving"] == 0


@pytest.mark.parametrize("case", list(figure_5.CASES))
def test_error_is_of_first_order(curves: dict[str, dict[str, Any]], case: str) -> None:
    """The box goes as far as a point mass with the law's own μ(v), but for less than what one step covers at the start."""
    for dt, curve in curves[case].items():
        differences = [abs(a - b) for a, b in zip(curve["distance_m"], curve["expected_m"], strict=True)]
        assert max(differences) == curve["error_max_m"]
        assert curve["error_max_m"] < figure_5.SPEED * float(dt)


def test_expected_distance_in_closed_form() -> None:
    """Coulomb v²/(2μg); derived, a drag k v: v/k (1 − e^{−kT}); printed, k v²: ln(1 + k v T)/k: to 1e-5."""
    dt, share = 0.02, torch.tensor([1.0, 30.0], dtype=torch.float64)
    stiffness = share * float(figure_5.NORMAL_FORCE.stiffness)
    mu = torch.tensor([0.1, 0.7], dtype=torch.float64)
    time = figure_5.DURATION

    def expected(law: Any) -> list[float]:
        return figure_5.expected_distance(law, dt, 2).tolist()  # type: ignore[no-any-return, unused-ignore]

    assert expected(CoulombFriction(mu[:, None])) == pytest.approx([0.5 / (m * figure_5.GRAVITY) for m in mu.tolist()], rel=1e-5)
    k = [2 * x * dt * figure_5.GRAVITY for x in share.tolist()]
    assert expected(PbfdFriction.as_derived(stiffness[:, None])) == pytest.approx(
        [(1 - math.exp(-x * time)) / x for x in k], rel=1e-5
    )
    k = [2 * x * dt**2 * figure_5.GRAVITY for x in share.tolist()]
    assert expected(PbfdFriction.as_printed(stiffness[:, None])) == pytest.approx([math.log1p(x * time) / x for x in k], rel=1e-5)


def test_table_on_the_terminal_and_status(ran: Ran, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Without --json there is a table with every law, the notes, and where the files are. An unsolved step is shown, and the exit
    status is then 1."""
    report = ran.data
    monkeypatch.setattr(bench_friction, "write", lambda report, folder: None)
    for unsolved, status in ((0, 0), (3, 1)):
        shown = copy.deepcopy(report)
        shown["curves"]["pbd"]["0.05"]["unsolved_steps"] = unsolved
        monkeypatch.setattr(bench_friction, "measured", lambda *arguments, shown=shown: shown)
        assert call(monkeypatch, "--quick") == status
        printed = " ".join(capsys.readouterr().out.split())
        for words in (
            "Fig. 5: a box that starts at 1 m/s",
            "Coulomb",
            "PBD, min E",
            "PBFD, printed",
            "PBFD, derived",
            f"{unsolved}/360",
        ):
            assert words in printed
        assert figure_5.NOTES[0] in printed
        assert "fig5.png" in printed


def test_out_must_be_a_folder(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A file in the way is found before the measurement."""
    file, taken = tmp_path / "file", tmp_path / "taken"
    file.write_text("")
    (taken / "fig5.png").mkdir(parents=True)
    for out in (file, file / "below", taken):
        assert call(monkeypatch, "--out", out) == 2
        assert capsys.readouterr().err == f"pbfd: --out is '{out}': must be a folder, new or not, that can be written to\n"
