"""`pbfd bench gradients`: the scenes, the errors that are measured, the cheapest ways, and what the command prints and writes."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch

from pbfd_torch.bench import gradients, gradients_scenes, gradients_table, mujoco_runs
from pbfd_torch.bench.gradients_scenes import PROBLEMS
from pbfd_torch.bench.precision import Reference
from pbfd_torch.native.library import library
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.kinematics import place
from tests.printed import called, json_object

TOSS, BOX = PROBLEMS["toss"], PROBLEMS["box"]
TINY = replace(
    gradients.QUICK,
    steps={"toss": (0.02,), "box": (0.02,)},
    difference_steps={"toss": (0.02,), "box": (0.02,)},
    peer_steps={"toss": (0.001,), "box": (0.01,)},
    accuracies=(1e-4,),
    moved=(1e-2,),
    own_step=2e-3,
    own_peer_step=5e-4,
)

# Scenes -------------------------------------------------------------------------------------------------------------------


def test_both_toss_the_same_cube() -> None:
    """Mass, inertia, gravity, friction, start, and where the lowest edge is: a cube of .1 m turned by 60°."""
    model, q, v = TOSS.peer(TOSS.values()[0], 0.001, "Euler")
    scene, our_q, our_v = TOSS.start(TOSS.values())
    assert float(model.body_mass[1]) == pytest.approx(float(scene.articulation.mass[0])) == 0.1
    second = scene.articulation.pseudo_inertia[0, :3, :3].diagonal()
    assert model.body_inertia[1].tolist() == pytest.approx((second.sum() - second).tolist())
    assert model.opt.gravity.tolist() == scene.gravity.tolist() == [0, 0, -2]
    assert model.geom_friction[:, 0].tolist() == [1, 1]
    assert q.tolist() == our_q[0].tolist() == pytest.approx([0, 0, 0.2, math.cos(math.pi / 6), 0.5, 0, 0])
    assert v.tolist() == our_v[0].tolist() == [0, -0.1, -2, 0, 0, 0]
    contact = scene.terms[1]
    assert isinstance(contact, Contact)
    assert isinstance(contact.normal_force, NormalForce)
    assert contact.normal_force.release == pytest.approx(0.336)
    lowest = 0.05 * (math.cos(math.pi / 3) + math.sin(math.pi / 3))
    assert float(contact.depth(place(scene.articulation, our_q)).amax()) == pytest.approx(lowest - 0.2)


def test_release_is_the_speed_of_the_first_edge_in_mujoco() -> None:
    """By RK4 at .05 ms: the velocity of the edge when it has left the ground."""
    model, q, v = TOSS.peer(TOSS.values()[0], 5e-5, "RK4")
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q.numpy(), v.numpy()
    touched, edge = False, None
    while not touched or data.ncon:
        mujoco.mj_step(model, data)
        touched = touched or data.ncon > 0
        edge = data.contact[0].pos.copy() if data.ncon else edge
    assert edge is not None
    turning = data.xmat[1].reshape(3, 3) @ data.qvel[3:]
    speed = data.qvel[2] + turning[0] * (edge[1] - data.qpos[1])
    assert speed == pytest.approx(gradients_scenes.RELEASE, abs=2e-3)


# Errors -------------------------------------------------------------------------------------------------------------------

RIGHT = (1 / (0.3 * 9.81), -1 / (2 * 0.09 * 9.81))  # v/(μg), −v²/(2μ²g)


@pytest.mark.parametrize(("name", "within"), [("Simulator", 3e-3), ("EventSimulator", 8e-3)])
def test_derivatives_of_the_box(name: str, within: float) -> None:
    """Within .3 % of Coulomb's law at 20 ms, where the step is cut at the end of the slide within what the slip speed leaves of
    that, 8 ε_v/v by μ; and those of the simulation to 1e-7."""
    assert BOX.exact == pytest.approx(RIGHT)
    row = gradients.derivative_row(BOX, name, 0.02, gradients.our_reference(BOX, 1.0), TINY)
    assert row["gradient"] == pytest.approx(RIGHT, rel=within)
    assert 0 < row["error"] < within
    assert row["error"] == pytest.approx(max(abs(x / y - 1) for x, y in zip(row["gradient"], RIGHT, strict=True)))
    assert row["own_differences"] < 1e-7
    assert row["together_s"] > row["forward_s"] > 0
    assert row["unsolved_steps"] == 0


def test_differences_of_the_box() -> None:
    """Ours as good as the derivative; MuJoCo's within 2 %, by its RK4 at 10 ms."""
    reference = gradients.our_reference(BOX, 1.0)
    found = gradients.difference_row(BOX, "Simulator", gradients.for_differences(0.02, None), 1e-3, reference, TINY)
    assert found["error"] < 3e-3
    assert found["dt"] == pytest.approx(0.02)
    row = gradients.peer_row(BOX, "RK4", 0.01, 1e-2, gradients.peer_reference(BOX, 1.0), TINY)
    assert 1e-3 < row["error"] < 0.02
    assert row["together_s"] == pytest.approx(4 * row["forward_s"])


@pytest.mark.skipif(library() is None, reason="there is no compiled core")
def test_differences_of_adaptive_steps() -> None:
    """Of the box, to 1e-8 m: within .1 % of Coulomb's law, with steps far shorter than a frame."""
    make = gradients.adaptive(1e-8, None)
    found = gradients.difference_row(BOX, "AdaptiveSimulator", make, 1e-3, gradients.our_reference(BOX, 1.0), TINY)
    assert found["error"] < 1e-3
    assert 1e-4 < found["dt"] < 0.02
    assert found["engine"] == "native"


def test_derivative_of_the_toss() -> None:
    """That of the simulation at 20 ms, to 1e-4; the differences that are measured beside it are the same to 1 %."""
    reference = Reference(torch.tensor([1.0], dtype=torch.float64))
    row = gradients.derivative_row(TOSS, "Simulator", 0.02, reference, TINY)
    assert row["own_differences"] < 1e-4
    assert row["error"] == pytest.approx(abs(row["gradient"][0] - 1))
    found = gradients.difference_row(TOSS, "Simulator", gradients.for_differences(0.02, None), 1e-4, reference, TINY)
    assert found["gradient"] == pytest.approx(row["gradient"], rel=1e-2)


def test_mujocos_toss() -> None:
    """RK4 at .1 ms is within .5 % of its own limit, .575 s; Euler at 1 ms has not even the sign."""
    fine, _ = gradients.peer_differences(TOSS, "RK4", 1e-4, 1e-2)
    coarse, _ = gradients.peer_differences(TOSS, "Euler", 1e-3, 1e-2)
    assert float(fine) == pytest.approx(0.5755, rel=5e-3)
    assert float(coarse) < -0.2


def test_our_reference_is_extrapolated(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error that is proportional to Δt is gone; what is left of a square is told."""

    def differences(problem: object, dt: float, moved: tuple[float, ...]) -> list[torch.Tensor]:
        return [torch.tensor([3 + 5 * dt + square * dt * dt], dtype=torch.float64) for _ in moved]

    monkeypatch.setattr(gradients, "for_differences", lambda dt, engine: dt)
    monkeypatch.setattr(gradients, "our_differences", differences)
    for square, left in ((0.0, 0.0), (100.0, 6 * 100 * 0.01**2)):
        found = gradients.our_reference(TOSS, 0.01)
        assert float(found.value) == pytest.approx(3 - 2 * square * 0.01**2)
        assert found.uncertainty == pytest.approx(left, abs=1e-12)


def test_reported_errors() -> None:
    """Against the reference that was reported with them; of the box, of what is known."""
    right = torch.tensor(TOSS.reported_reference, dtype=torch.float64)
    errors = {found.name: gradients._reported(found, right)["error"] for found in TOSS.reported}
    assert errors["MJX Euler, 10 ms"] == pytest.approx(24.1, rel=1e-2)
    assert errors["DiffMJX Tsit5, 1e-7"] == pytest.approx(0.0128, rel=1e-2)
    right = torch.tensor(BOX.reported_reference, dtype=torch.float64)
    errors = {found.name: gradients._reported(found, right)["error"] for found in BOX.reported}
    assert errors["Nimble"] == pytest.approx(0.0889, rel=1e-2)
    assert errors["Brax spring"] == pytest.approx(0.0353, rel=1e-2)
    assert math.isnan(errors["MJX elliptic; Brax generalized: NaN"])


# Levels -------------------------------------------------------------------------------------------------------------------


def row(simulator: str, method: str, dt: float, error: float, together_s: float, unsolved: int = 0) -> dict[str, Any]:
    found = {"simulator": simulator, "scheme": "x", "method": method, "dt": dt, "error": error}
    return found | {"together_s": together_s, "unsolved_steps": unsolved}


def test_levels_and_losses() -> None:
    """The cheapest row whose curve stays within the level: a passage through zero does not count, nor what is finer than the
    reference, nor unsolved steps."""
    rows = [row("pbfd_torch", "derivative", 0.01, 0.002, 0.1), row("pbfd_torch", "derivative", 0.001, 0.2, 1.0)]
    rows += [row("pbfd_torch", "differences ±0.001", 0.01, 0.05, 0.02), row("MuJoCo", "differences ±0.01", 0.001, 0.004, 0.01)]
    rows += [row("MuJoCo", "differences ±0.02", 0.001, 1e-9, 0.001, unsolved=1)]
    problem = {"title": "T", "references": {"MuJoCo": {"relative": 0.005}}, "rows": rows}
    assert gradients_table.level_table(problem) == [
        ["50 %", "x 10 ms: 100 ms", "x ±0.001 10 ms: 20 ms", "x ±0.01 1 ms: 10 ms", "2"],
        ["10 %", "–", "x ±0.001 10 ms: 20 ms", "x ±0.01 1 ms: 10 ms", "2"],
        ["1 %", "–", "–", "x ±0.01 1 ms: 10 ms", "–"],
        ["0.1 %", "–", "–", "–", "–"],
    ]
    assert gradients_table.losses({"T": problem}) == [
        "T: 50 %: MuJoCo x ±0.01 1 ms: 10 ms, ours 2 times as long",
        "T: 10 %: MuJoCo x ±0.01 1 ms: 10 ms, ours 2 times as long",
        "T: 1 %: MuJoCo x ±0.01 1 ms: 10 ms, ours at no Δt measured",
    ]


# Command ------------------------------------------------------------------------------------------------------------------

FILES = {"gradients.json", "gradients.md", "gradients.png"}


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """The exit status of `pbfd bench gradients --quick`, with less to do than that has."""
    monkeypatch.setattr(gradients, "QUICK", TINY)
    return called(monkeypatch, "bench", "gradients", "--quick", *arguments)


def test_quick_run_writes_its_files(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """One object, the same in the file; a page with both problems and what others report; a picture."""
    out = tmp_path / "new" / "folder"
    assert call(monkeypatch, "--json", "--out", out) == 0
    captured = capsys.readouterr()
    report = json_object(captured.out)
    assert captured.err == ""
    assert {file.name for file in out.iterdir()} == FILES
    assert json.loads((out / "gradients.json").read_text()) == report
    assert report["environment"]["mujoco"] == mujoco.__version__
    methods = ["derivative", "derivative", "differences ±0.01", "differences ±0.01"]
    for problem, peers in zip(report["problems"].values(), (2, 3), strict=True):
        assert [found["method"] for found in problem["rows"]] == [*methods, *["differences ±0.01"] * peers]
        assert all(found["together_s"] > 0 for found in problem["rows"])
    toss, box = report["problems"].values()
    assert {found["source"][:11] for found in toss["references"].values()} == {"differences"}
    assert box["references"]["MuJoCo"]["value"] == pytest.approx(RIGHT)
    page = (out / "gradients.md").read_text()
    words = (
        "## cube toss: d y(1 s) / d ż",
        "## Where ours loses",
        "published by the authors",
        "Reference: 0.3398 s, -0.5663 m, exact.",
    )
    rows = ("| DiffMJX Tsit5, 1e-7 | 0.1749 s | 1.3 % | 2.39 | 16.5 |  |", "| Nimble | 0.37 s, – | 8.9 % |  |  | 56 |")
    for text in (*words, *rows):
        assert text in page
    assert (out / "gradients.png").read_bytes().startswith(b"\x89PNG")


def test_table_without_mujoco(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Where MuJoCo cannot be imported, the run says so and goes on with ours."""
    monkeypatch.setattr(mujoco_runs, "version", lambda: None)
    assert call(monkeypatch, "--problems", "box", "--out", tmp_path) == 0
    printed = " ".join(capsys.readouterr().out.split())
    for words in (
        "Cheapest way to a relative error",
        "Reference: 0.3398 s",
        "ours alone",
        "no MuJoCo",
        "engine: native",
        "gradients.md",
    ):
        assert words in printed
    rows = json.loads((tmp_path / "gradients.json").read_text())["problems"]["box"]["rows"]
    assert {found["simulator"] for found in rows} == {"pbfd_torch"}


def test_unsolved_steps_are_the_status(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """1, where a step of ours is left without a root."""
    whole = gradients.difference_row
    monkeypatch.setattr(gradients, "difference_row", lambda *arguments: {**whole(*arguments), "unsolved_steps": 1})
    assert call(monkeypatch, "--problems", "box", "--out", tmp_path) == 1
    assert "1 unsolved" in (tmp_path / "gradients.md").read_text()


def test_bad_input(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Status 2 and one line that says what is valid."""
    assert call(monkeypatch, "--problems", "throw") == 2
    assert capsys.readouterr().err == "pbfd: --problems is 'throw': must be names from toss, box, separated by commas\n"
    (tmp_path / "file").write_text("")
    assert call(monkeypatch, "--out", tmp_path / "file") == 2
    assert "must be a folder" in capsys.readouterr().err
