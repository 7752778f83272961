"""`pbfd bench precision`: the references, the errors, and what the command prints and writes."""

from __future__ import annotations

import io
import json
import math
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch.bench import mujoco_runs, precision, precision_levels
from pbfd_torch.bench.precision_reference import chain_tips, middle_axes
from pbfd_torch.bench.precision_scenes import CASES, margin, middle_axis, stopped, straight_links, tenths, tip
from pbfd_torch.bench.precision_tracks import Track, rms
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES, boxes, chains
from tests.printed import Printed, called

# References ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("reference", "times"), [(chain_tips, 10), (middle_axes, 25)])
def test_reference_is_of_fourth_order(reference: Any, times: int) -> None:
    """Halving the step divides the error by 16."""
    fine = reference(times, 2.5e-4)
    errors = [rms(reference(times, dt) - fine) for dt in (4e-3, 2e-3, 1e-3)]
    for before, after in pairwise(errors):
        assert 11 < before / after < 23
    assert errors[-1] < 1e-6


def test_reference_of_the_chain_is_the_known_one() -> None:
    """The tip after 1 s, and MuJoCo's RK4 at 1 ms all the way."""
    tips = chain_tips(10, 1e-3)
    np.testing.assert_allclose(tips[-1].numpy(), chains.FIXED_TIP, atol=5e-7)
    track = precision.peer_motion(CASES["chain-fixed"], "RK4", 0.001, 1.0)[0]
    assert track.dt == 0.001
    assert rms(tip(track)[:, 0] - tips) < 1e-6


def test_reference_of_the_body_agrees_with_mujoco() -> None:
    """RK4 at 1 ms, through the turn-over."""
    track = precision.peer_motion(CASES["dzhanibekov"], "RK4", 0.001, 2.5)[0]
    assert rms(middle_axis(track)[:, 0] - middle_axes(25, 1e-3)) < 1e-6


def test_own_reference_is_told_with_its_change() -> None:
    """A motion that is off by dt metres: the value at dt, and the uncertainty dt; an exact reference is taken as it is."""
    case = CASES["hopper"]
    start = case.setup(1).q

    def motion(dt: float, duration: float) -> Track:
        q = start.expand(round(duration / 0.1) + 1, 1, -1).clone()
        q[..., 0] += dt
        return Track.of_states(case.setup(1).scene, tenths(duration, 0.0), q, torch.zeros(*q.shape[:2], 6, dtype=torch.float64))

    found = precision.reference_of(case, "x", 0.01, motion)
    at_rest = case.observe(motion(0.0, case.duration))
    assert rms(found.value - at_rest) == pytest.approx(0.01)
    assert found.uncertainty == pytest.approx(0.01)
    assert found.source == "x at 0.01 s"
    exact = precision.our_reference(CASES["chain-slope-drop"], 0.01)
    assert (float(exact.value), exact.uncertainty) == (0.0, 0.0)


@pytest.mark.parametrize("dt", [0.0001, *precision.FULL.steps])
def test_steps_of_all_lengths_see_the_same_control(dt: float) -> None:
    """Ten values a second, those of the sine in the middle of each tenth; zero where there is no control."""
    case, count = CASES["walker"], round(1.0 / dt)
    controls = case.controls(dt, dt * torch.arange(count, dtype=torch.float64))
    assert controls is not None
    middle = torch.arange(10, dtype=torch.float64)[:, None] / 10 + 0.05
    should = 0.1 * torch.sin(2 * math.pi * middle + torch.arange(6))
    np.testing.assert_allclose(controls.numpy(), should.repeat_interleave(count // 10, 0).numpy(), atol=1e-12)
    assert CASES["chain-free"].controls(dt, torch.zeros(3)) is None


# Errors -------------------------------------------------------------------------------------------------------------------


def made_up(name: str, duration: float, path: Any, worlds: int = 1) -> Track:
    """A motion at a step of .1 s with configurations path(t, q) `[nq]` and no velocities."""
    setup = SCENES[name](worlds=worlds)
    time = tenths(duration, 0.0)
    q = torch.stack([torch.stack([path(float(t), row.clone(), k) for k, row in enumerate(setup.q)]) for t in time])
    return Track.of_states(setup.scene, time, q, torch.zeros(*q.shape[:2], setup.v.shape[-1], dtype=torch.float64))


def moved(x: float, z: float = 0.0) -> Any:
    """The free body goes x, z [m] per second squared."""

    def path(t: float, q: Tensor, world: int) -> Tensor:
        q[0], q[2] = q[0] + x * t * t, q[2] + z * t * t
        return q

    return path


def test_errors_of_made_up_motions() -> None:
    """Each against a value found by hand."""
    hanging = made_up("chain-fixed", 1.0, lambda t, q, k: q.index_fill(0, torch.tensor([0]), math.pi / 2 * (t > 0)))
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    assert tip(hanging)[:, 0].numpy() == pytest.approx(down.expand(10, -1).numpy(), abs=1e-12)
    assert CASES["chain-fixed"].error(hanging, (down + torch.tensor([0.03, 0.0, 0.04]))[None, None]) == pytest.approx(0.05)

    free = 0.5 * chains.SLIDE
    exact = CASES["chain-slope"].exact
    assert exact is not None
    assert CASES["chain-slope"].error(made_up("chain-slope", 10.0, moved(free + 0.01)), exact()) == pytest.approx(1.0)

    late = made_up("chain-slope-drop", 5.0, moved(free - 0.02, 0.01))
    assert float(margin(late)) == pytest.approx(25 * (-0.02 + 0.01 * chains.SLOPE_FRICTION))

    fallen = made_up("chain-ground", 0.5, moved(0.5, -0.1))
    landing = CASES["chain-ground"].observe(fallen) - fallen.center[:1]
    assert landing[0, 0].tolist() == pytest.approx([0.08, 0.0, -0.016])

    box = made_up("box-slide", 1.5, moved(0.1), worlds=5)
    should = 0.5 / boxes.GRAVITY / torch.tensor(boxes.SLIDING_FRICTION, dtype=torch.float64)
    assert stopped(box)[:, 0].tolist() == pytest.approx([0.225] * 5)
    exact = CASES["box-slide"].exact
    assert exact is not None
    assert CASES["box-slide"].error(box, exact()) == pytest.approx(float((0.225 - should).square().mean().sqrt()))


def test_straight_chain_has_no_error() -> None:
    """A rigid rotation by 10 rad/s about the centre, which moves at 5 m/s; the same, 1 cm higher, is 1 % of the length off."""

    def path(t: float, q: Tensor, world: int) -> Tensor:
        angle = 10 * t
        q[0], q[2] = 0.5 + 5 * t - 0.5 * math.cos(angle), 0.5 * math.sin(angle)
        q[3:7] = torch.tensor([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0])
        return q

    track = made_up("chain-free", 2.0, path)
    case = CASES["chain-free"]
    assert case.error(track, straight_links()) < 1e-7
    higher = track.poses.clone()
    higher[..., 2, 3] += 0.01
    assert case.error(replace(track, poses=higher), straight_links()) == pytest.approx(0.01, rel=1e-5)


def test_numbers_of_a_motion() -> None:
    """Energy, momenta and depth of the spinning body with given velocities, and of a sunken chain."""
    setup = SCENES["dzhanibekov"]()
    q = setup.q.expand(3, 1, -1)
    v = setup.v.expand(3, 1, -1) * torch.tensor([1.0, 1.1, 0.5], dtype=torch.float64)[:, None, None]
    track = Track.of_states(setup.scene, tenths(0.2, 0.0), q, v)
    start = float(track.energy[0])
    assert start == pytest.approx(0.5 * 400 * float(track.angular[0, 0, 1]) / 20, rel=1e-6)
    numbers = track.numbers()
    assert numbers["energy_gain_J"] == pytest.approx(0.21 * start)
    assert numbers["energy_gain"] == pytest.approx(0.21 / 1.21)
    assert numbers["energy_drift"] == pytest.approx(0.75)
    assert numbers["angular_momentum_drift"] == pytest.approx(0.5)
    assert math.isnan(numbers["linear_momentum_drift"])  # there is none at the start
    assert numbers["penetration_m"] == 0.0
    deep = made_up("chain-slope", 0.1, moved(0.0, -1.0))
    assert deep.numbers()["penetration_m"] == pytest.approx(0.01 + float(deep.depth[0]))


def test_start_of_our_track_is_the_setups() -> None:
    """Energy and momentum at the start are those of the given velocity, and the exact rotation keeps them to first order."""
    case = CASES["chain-free"]
    motion = precision.our_motion(case, "implicit-euler", 0.01, 0.1)
    assert float(motion.track.energy[0]) == pytest.approx(0.5 * 25 + float(motion.track.angular[0, 0, 1]) * 10 / 2)
    assert motion.track.linear[0, 0].tolist() == pytest.approx([5.0, 0.0, 0.0], abs=1e-12)
    assert 0 < motion.track.numbers()["angular_momentum_drift"] < 0.2


def test_starts_are_spread_over_what_is_finite() -> None:
    """Two groups of two worlds, over the half of a motion that is finite."""
    track = made_up("chain-ground", 2.0, moved(1.0))
    broken = replace(track, q=torch.where(track.time[:, None, None] > 0.85, torch.nan, track.q))
    for group, times in enumerate(([0.0, 0.4], [0.2, 0.6])):
        q, _, time = precision.starts(broken, 2, group, 2)
        assert time.tolist() == pytest.approx(times)
        assert q[:, 0].tolist() == pytest.approx([t * t for t in times])


# Levels -------------------------------------------------------------------------------------------------------------------


def row(simulator: str, error: float, single: float, batch: float | None = None, **more: Any) -> dict[str, Any]:
    times = {"1": single} if batch is None else {"1": single, "64": batch}
    common = {"integrator": "x", "dt": 0.01, "diverged": False, "unsolved_steps": 0, "world_steps": 9, "fallbacks": {"halving": 0}}
    return {"simulator": simulator, "error": error, "ms_per_s": times, **common, **more}


def test_levels_and_losses() -> None:
    """The cheapest row that is known to be good enough: not diverged, unsolved, with energy gained, or finer than its reference."""
    rows = [row("pbfd_torch", 0.05, 10, 2), row("pbfd_torch", 0.005, 90, 30), row("pbfd_torch", 1e-9, 1, 1, unsolved_steps=1)]
    rows += [row("MuJoCo", 0.02, 5), row("MuJoCo", 0.004, 20), row("MuJoCo", math.nan, math.nan, diverged=True)]
    rows += [row("MuJoCo", 1e-9, 1, energy_gain=0.11)]
    scene = {"title": "T", "unit": "m", "levels": [0.1, 0.01, 0.001], "own_references": {}, "rows": rows}
    assert precision_levels.level_table(scene) == [
        ["0.1 m", "x 0.01 s: 2", "x 0.01 s: 10", "x 0.01 s: 5", "0.4"],
        ["0.01 m", "x 0.01 s: 30", "x 0.01 s: 90", "x 0.01 s: 20", "1.5"],
        ["0.001 m", "–", "–", "–", "–"],
    ]
    assert precision_levels.losses({"T": scene}) == ["T: 0.01 m: ours takes 1.5 times as long as MuJoCo x"]
    unsure = {**scene, "own_references": {"pbfd_torch": {"source": "s", "uncertainty": 0.02}}}
    assert precision_levels.losses({"T": unsure}) == ["T: 0.01 m: MuJoCo x 20 ms, ours at no time step measured"]


@pytest.mark.parametrize("name", INTEGRATORS)
def test_every_integrator_is_measured(name: str) -> None:
    """Ours, one by one, on the sliding box: the row is whole and the distances are right to 1 cm."""
    case = CASES["box-slide"]
    motion = precision.our_motion(case, name, 0.02, case.duration)
    assert case.exact is not None
    found = precision.our_row(case, motion, precision.Reference(case.exact()), None, replace(precision.QUICK, worlds=5))
    assert found["error"] < 0.01
    assert found["world_steps"] == 5 * 75
    assert set(found["ms_per_s"]) == {"1", "5"}


# Command ------------------------------------------------------------------------------------------------------------------

FILES = {"precision.json", "precision.md", "precision-errors.png", "precision-steps.png"}


@dataclass(frozen=True)
class Ran(Printed):
    """One call of the command: its exit status, what it printed, and its folder."""

    folder: Path


def call(folder: Path, *arguments: object) -> Ran:
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        effort = replace(precision.QUICK, steps=(0.05, 0.1), worlds=3, seconds=(0.01, 0.01), own_accuracy=1e-3)
        patch.setattr(precision, "QUICK", effort)
        status = called(patch, "bench", "precision", "--quick", "--out", folder, *arguments)
    return Ran(status, out.getvalue(), err.getvalue(), folder)


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    folder = tmp_path_factory.mktemp("bench") / "new" / "folder"
    return call(folder, "--scenes", "chain-ground,chain-fixed", "--integrators", "implicit-euler", "--json")


def test_quick_run_writes_its_files(ran: Ran) -> None:
    """It ends well, silently but for the object; the folder holds all files, and the JSON one says the same."""
    assert (ran.status, ran.err) == (0, "")
    assert {file.name for file in ran.folder.iterdir()} == FILES
    assert json.loads((ran.folder / "precision.json").read_text()) == ran.data
    for name in ("precision-errors.png", "precision-steps.png"):
        assert (ran.folder / name).read_bytes().startswith(b"\x89PNG")
    text = (ran.folder / "precision.md").read_text()
    for words in ("## B: tip, 1 s (`chain-fixed`)", "## Where ours loses", "| MuJoCo | RK4 | 0.01 |", "Runge–Kutta 4", "diverged"):
        assert words in text


def test_rows_of_the_quick_run(ran: Ran) -> None:
    """Every step of every integrator, in the order of the scenes; MuJoCo's RK4 on the chain is as precise as it is known to be."""
    report = ran.data
    assert list(report["scenes"]) == ["chain-fixed", "chain-ground"]
    assert report["environment"]["mujoco"] == mujoco.__version__
    for scene in report["scenes"].values():
        rows = {(r["simulator"], r["integrator"], r["dt"]): r for r in scene["rows"]}
        assert len(rows) == len(scene["rows"]) == 2 + 3 * 4
        for dt in (0.05, 0.1):
            ours = rows["pbfd_torch", "implicit-euler", dt]
            assert ours["error"] > 0
            assert ours["world_steps"] == round(scene["duration_s"] / dt)
            assert min(ours["ms_per_s"].values()) > 0
            assert set(ours["ms_per_s"]) == {"1", "3"}
    chain, ground = report["scenes"].values()
    found = {(r["integrator"], r["dt"]): r for r in chain["rows"]}
    assert found["RK4", 0.01]["error"] == pytest.approx(1.28e-3, rel=0.05)
    assert found["Euler", 0.05]["diverged"]
    assert found["Euler", 0.05]["error"] is None
    assert found["implicit-euler", 0.05]["error"] == pytest.approx(0.371, rel=0.02)
    assert chain["own_references"] == {}
    assert set(ground["own_references"]) == {"pbfd_torch", "MuJoCo"}
    assert all(r["error_to_mujoco"] > 0 for r in ground["rows"] if r["simulator"] == "pbfd_torch")


def test_table_without_mujoco(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Where MuJoCo cannot be imported, the run says so and goes on with ours."""
    monkeypatch.setattr(mujoco_runs, "version", lambda: None)
    found = call(tmp_path, "--scenes", "chain-fixed", "--integrators", "implicit-euler")
    assert found.status == 0
    printed = " ".join(found.out.split())
    for words in ("Cheapest way to an error", "B: tip, 1 s", "MuJoCo cannot be imported: ours alone", "no MuJoCo", "precision.md"):
        assert words in printed
    rows = json.loads((tmp_path / "precision.json").read_text())["scenes"]["chain-fixed"]["rows"]
    assert {(r["simulator"], r["integrator"]) for r in rows} == {("pbfd_torch", "implicit-euler")}


@pytest.mark.parametrize(
    ("option", "value", "valid"),
    [
        ("--scenes", "chain-fixed,nowhere", "chain-fixed, chain-ground"),
        ("--integrators", "rk9", "implicit-euler"),
        ("--scenes", ",", "ch"),
    ],
)
def test_unknown_names(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], option: str, value: str, valid: str
) -> None:
    assert called(monkeypatch, "bench", "precision", option, value) == 2
    assert capsys.readouterr().err.startswith(f"pbfd: {option} is '{value}': must be names from {valid}")


def test_out_must_be_a_folder(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A file in the way is found before the measurement."""
    (tmp_path / "file").write_text("")
    assert called(monkeypatch, "bench", "precision", "--out", tmp_path / "file") == 2
    assert "must be a folder" in capsys.readouterr().err
