"""`pbfd bench speed`: the work, who is timed and who is not, ratios, and what the command prints and writes. Not how fast it is."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from pbfd_torch.bench import mujoco_runs, speed, speed_ours
from pbfd_torch.bench.speed import Effort, measure_scene
from pbfd_torch.bench.speed_mujoco import INTEGRATORS, Peer, fewest
from pbfd_torch.bench.speed_ours import Ours, definition
from pbfd_torch.bench.speed_scenes import COURSES, USUAL, Work, bent, nudged, tossed
from pbfd_torch.bench.speed_table import ratio_lines, ratios
from tests.command import Pbfd, caller

pbfd = pytest.fixture(caller)

KEYS = {"scene", "engine", "dtype", "worlds", "threads", "control_steps_per_s", "physics_steps_per_s", "us_per_step"}
KEYS |= {"evaluations_mean", "solved_share", "fallback_share", "error_m", "warmup_s", "note"}
SHORT = replace(
    COURSES["hopper"],
    case=replace(COURSES["hopper"].case, duration=0.08, observed_s=0.08, observe=lambda track: track.poses[-1, :, 0, :, 3]),
    worlds=(1, 3),
)
TINY = Effort(("hopper",), (1, 3), 3, 4, 2, 1, 0.0, 1e9, 1, 0.004, 0.002)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """The quick run with four steps of one world and of three, whose error is that after ten; one thread."""
    monkeypatch.setattr(speed, "all_threads", lambda: (1,))
    monkeypatch.setattr(speed, "QUICK", TINY)
    monkeypatch.setitem(COURSES, "hopper", SHORT)


# the work -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", COURSES)
def test_work(name: str) -> None:
    """The first world starts as the scene does, the others beside it; controls are within the drive around the held one, and every
    world has its own. Twice the same."""
    course = COURSES[name]
    setup, work, again = course.setup(3), course.work(3), course.work(3)
    assert torch.equal(work.q[0], setup.q[0])
    assert torch.equal(work.v[0], setup.v[0])
    assert torch.equal(work.controls, again.controls)
    assert torch.equal(work.q, again.q)
    assert bool((work.v[1] != work.v[2]).any())
    away = work.controls - setup.controls(course.steps)
    assert work.controls.shape == (course.steps, 3, setup.scene.nu)
    assert float(away.abs().max() if away.numel() else 0.0) <= course.drive
    assert work.world_steps == 3 * course.steps
    assert setup.scene.nu == 0 or not torch.equal(work.controls[:, 0], work.controls[:, 1])


@pytest.mark.parametrize("name", [name for name, course in COURSES.items() if course.starts is bent])
def test_bent_starts(name: str) -> None:
    """Differ in hinges and slides alone."""
    setup = COURSES[name].setup(3)
    q, v = bent(setup)
    t = setup.scene.articulation.topology
    free = [(i, j) for i, j, (size, _) in zip(t.q_start, t.v_start, t.joint_sizes, strict=True) if size == 7]
    for i, j in free:  # only its height may be another, so that nothing starts in the ground
        kept = [i, i + 1, *range(i + 3, i + 7)]
        torch.testing.assert_close(q[:, kept], setup.q[:, kept], rtol=0, atol=1e-15)
        assert not v[:, j : j + 6].any()
    assert bool((q[1] != q[2]).any())


def test_starts_of_bodies() -> None:
    """What falls starts elsewhere and turned; what touches starts where it is, and moves a little."""
    for name, course in COURSES.items():
        setup = course.setup(3)
        q, v = course.starts(setup)
        if course.starts is tossed:
            assert name == "mesh-terrain"
            assert bool((q != setup.q).any(-1).all())
        if course.starts is nudged:
            torch.testing.assert_close(q, setup.q, rtol=0, atol=1e-15)
            assert 0 < float((v - setup.v).abs().max()) < 0.3


def test_landing_of_bodies_is_known_to_a_millimetre() -> None:
    """Its reference at .5 ms, and a smaller step is closer to it."""
    course = COURSES["mesh-terrain"]
    if Ours(course, "native", "float64").missing():
        pytest.skip("there is no core")
    reference = speed._our_reference(course, 0.0005)
    errors = [
        course.case.error(definition(replace(course, dt=dt)).motion(course.case, 0.36), reference.value) for dt in (0.02, 0.004)
    ]
    assert reference.uncertainty < 0.001
    assert errors[1] < errors[0] < 0.005


def test_short_runs_start_spread_over_the_record() -> None:
    """Three groups of two worlds take six times, evenly, of the worlds that were recorded in turn; in float32 they are float32."""
    course = replace(COURSES["hopper"], steps=12)
    record = definition(course).record(course.work(2))
    rows = []
    for group in range(3):
        states, controls = record.spread(2, group, 3, 1)
        for world, q in enumerate(states.q):
            rows.append(int((record.states.q[:, (group + 3 * world) % 2] == q).all(-1).nonzero()))
        assert controls.shape == (1, 2, 3)
    assert sorted(rows) == [0, 2, 4, 6, 8, 10]
    (solution,) = Ours(course, "torch", "float32").ready_under_way(record, 2, 1, 1, 1)()
    assert solution.q.dtype == torch.float32
    assert solution.evaluations.shape == (1, 2)


# the contestants ----------------------------------------------------------------------------------------------------------


def test_our_engines_make_the_same_motion() -> None:
    """PyTorch's and, where it is there, the core's, which gets no other control; both in the control steps of the robots."""
    course = COURSES["hopper"]
    track = Ours(course, "torch", "float64").motion(course.case, 0.4)
    assert len(track.time) == 51
    native = Ours(course, "native", "float64")
    if not native.missing():
        torch.testing.assert_close(native.motion(course.case, 0.4).q, track.q, rtol=0, atol=1e-6)


def test_mujoco_makes_the_same_work() -> None:
    """Its rollout is that of `mj_step` from the work's start, every control held for the steps of a control step."""
    course = replace(COURSES["hopper"], steps=3)
    work = course.work(2)
    peer = Peer(course, "mujoco-implicitfast", 2)
    assert not peer.lost(work)
    model = mujoco_runs.loaded("hopper", 0.004, "implicitfast")
    data = mujoco.MjData(model)
    start, controls, states = peer._arguments(model, data, work)
    assert start.shape == (2, 1 + model.nq + model.nv)
    assert states.shape == (2, 6, 1 + model.nq + model.nv)
    np.testing.assert_array_equal(controls[1, 2], work.controls[1, 1].numpy())
    np.testing.assert_array_equal(controls[1, 3], work.controls[1, 1].numpy())
    np.testing.assert_array_equal(start[1, 1:], np.concatenate((work.q[1], work.v[1])))


def test_integrators_are_mujocos() -> None:
    """All three are there, `discrete` among them."""
    for name in INTEGRATORS.values():
        model = mujoco_runs.loaded("hopper", 0.008, name)
        assert model.opt.integrator == getattr(mujoco.mjtIntegrator, f"mjINT_{name.upper()}")


def test_fewest_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first number of steps that does; a shipped number is not undercut; none: the row will say so."""
    course = COURSES["chain-slope-drop"]
    work = replace(course, steps=1).work(1)
    monkeypatch.setattr(Peer, "lost", lambda self, _: self.substeps < 5)
    monkeypatch.setattr(Peer, "wrong", lambda self: self.substeps < 10)
    peer, note = fewest(course, "mujoco-discrete", work)
    assert (peer.substeps, peer.missing()) == (10, "")
    assert note == "diverges or ends over 0.5 m off with fewer than 10 steps of 0.005 s"
    monkeypatch.setattr(Peer, "lost", lambda *_: False)
    monkeypatch.setattr(Peer, "wrong", lambda _: False)
    assert [fewest(COURSES["hopper"], name, work)[0].substeps for name in INTEGRATORS] == [1, 1, 4]
    monkeypatch.setattr(Peer, "lost", lambda *_: True)
    peer, note = fewest(COURSES["hopper"], "mujoco-rk4", work)
    assert peer.missing() == "diverges at every step from 0.008 to 8e-05 s"
    assert note == ""


def test_what_is_not_covered_has_a_row_that_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a core its rows have no numbers; without MuJoCo it has no rows."""
    monkeypatch.setattr(speed_ours, "uncovered", lambda _: "there is no core")
    found = measure_scene(replace(SHORT, worlds=(3,)), TINY, (1,), False, lambda _: None)
    rows = {(row["engine"], row["dtype"]): row for row in found["rows"]}
    assert set(rows) == {(engine, dtype) for engine in ("native", "torch") for dtype in ("float64", "float32")}
    native = rows["native", "float32"]
    assert native["note"] == "there is no core"
    assert math.isnan(native["control_steps_per_s"])
    assert math.isnan(native["error_m"])
    assert native["timed_world_steps"] == 0
    assert rows["torch", "float64"]["control_steps_per_s"] > 0
    assert rows["torch", "float64"]["note"] == ""


def test_what_takes_too_long_makes_a_few_steps() -> None:
    """And torch is left out of the largest batches."""
    course = replace(SHORT, worlds=(3,))
    hurried = replace(TINY, patience_s=0.0, few=6, most_eager=2)
    found = measure_scene(course, hurried, (1,), False, lambda _: None)
    for row in found["rows"]:
        if row["engine"] == "torch":
            assert row["note"] == "not timed where worlds times threads are over 2"
        elif not row["note"]:
            assert row["timed_world_steps"] == 6


def test_several_threads() -> None:
    """Rows of one thread and of two; who is timed by wall time and who by CPU time is no matter of the rows."""
    course = replace(SHORT, worlds=(3,))
    found = measure_scene(course, replace(TINY, most_eager=3), (1, 2), True, lambda _: None)
    rows = {(row["engine"], row["threads"]): row for row in found["rows"]}
    assert rows["torch", 1]["note"] == ""
    assert rows["torch", 2]["note"] == "not timed where worlds times threads are over 3"
    assert rows["mujoco-discrete", 2]["control_steps_per_s"] > 0
    assert rows["native", 2]["note"] or rows["native", 2]["control_steps_per_s"] > 0
    assert speed.all_threads()[0] == 1


def test_errors_are_those_of_their_steps() -> None:
    """A smaller step is closer to the reference."""
    course = COURSES["hopper"]
    reference = speed._our_reference(course, 0.001)
    errors = [
        course.case.error(definition(replace(course, dt=dt)).motion(course.case, 0.4), reference.value) for dt in (0.008, 0.002)
    ]
    assert errors[1] < errors[0] < 0.01
    assert reference.uncertainty < errors[0]


# what is made of them -----------------------------------------------------------------------------------------------------


def row(engine: str, dtype: str, rate: float, **others: Any) -> dict[str, Any]:
    told = {"scene": "s", "worlds": 64, "threads": 1, "substeps": 1} | others
    return {
        **told,
        "engine": engine,
        "dtype": dtype,
        "control_steps_per_s": rate,
        "us_per_step": 1e6 / rate,
        "ms_per_simulated_s": 1 / rate,
    }


def test_ratios() -> None:
    """Of the same scene, worlds and threads; torch of the same dtype; the fastest of MuJoCo's."""
    rows = [
        row("native", "float64", 600.0),
        row("native", "float32", 1200.0),
        row("torch", "float64", 10.0),
        row("torch", "float32", 20.0),
        row("mujoco-implicitfast", "float64", 200.0),
        row("mujoco-discrete", "float64", 300.0),
        row("mujoco-rk4", "float64", math.nan),
        row("native", "float64", math.nan, threads=2),
        row("mujoco-implicitfast", "float64", 1.0, worlds=1),
    ]
    double, single = ratios(rows)
    assert double["times_as_fast_as"] == {"torch": 60, "mujoco-implicitfast": 3, "mujoco-discrete": 2}
    assert single["times_as_fast_as"] == {"torch": 60, "mujoco-implicitfast": 6, "mujoco-discrete": 4}
    assert double["fastest_mujoco"] == "mujoco-discrete"
    assert double["fastest_mujoco_ms_per_simulated_s"] == 1 / 300
    assert ratio_lines([double])[0][:7] == ["s", "64", "float64", "3", "2", "–", "60"]


# the command --------------------------------------------------------------------------------------------------------------


def test_command(tiny: None, tmp_path: Path, pbfd: Pbfd) -> None:
    """One JSON object, the same in the folder beside a table and a picture; a row for each contestant, batch, number of threads."""
    ran = pbfd("bench", "speed", "--quick", "--out", tmp_path / "new", "--json")
    assert (ran.status, ran.err) == (0, "")
    report = ran.data
    assert report == json.loads((tmp_path / "new" / "speed.json").read_text())
    assert (tmp_path / "new" / "speed.png").read_bytes().startswith(b"\x89PNG")
    assert "## hopper" in (tmp_path / "new" / "speed.md").read_text()
    threads = report["environment"]["threads"]
    rows = {(x["engine"], x["dtype"], x["worlds"], x["threads"]): x for x in report["rows"]}
    contestants = [(engine, dtype) for engine in ("native", "torch") for dtype in ("float64", "float32")]
    contestants += [(engine, "float64") for engine in INTEGRATORS]
    assert set(rows) == {(*one, worlds, count) for one in contestants for worlds in (1, 3) for count in threads}
    assert len(rows) == len(report["rows"])
    for found in rows.values():
        assert set(found) >= KEYS
        assert found["scene"] == "hopper"
        assert found["note"] or found["us_per_step"] == pytest.approx(1e6 / found["control_steps_per_s"])
        assert found["note"] or found["physics_steps_per_s"] == pytest.approx(found["substeps"] * found["control_steps_per_s"])
    assert rows["torch", "float64", 3, 1]["solved_share"] == 1.0
    assert rows["torch", "float64", 3, 1]["evaluations_mean"] >= 1
    assert rows["mujoco-rk4", "float64", 1, 1]["substeps"] == 4
    assert rows["mujoco-rk4", "float64", 1, 1]["evaluations_mean"] is None
    assert set(report["scenes"]["hopper"]["references"]) == {"pbfd_torch", "MuJoCo"}


def test_tables(tiny: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pbfd: Pbfd) -> None:
    """On paper; without MuJoCo the run says so and goes on with ours."""
    monkeypatch.setattr(mujoco_runs, "version", lambda: None)
    ran = pbfd("bench", "speed", "--quick", "--out", tmp_path)
    assert ran.status == 0
    printed = " ".join(ran.out.split())
    for words in (
        "hopper: control steps of 0.008 s, 4 a rollout",
        "thousands of control steps a second",
        "The core's control steps a second",
        "ours alone",
        "no MuJoCo",
    ):
        assert words in printed
    assert not {x["engine"] for x in json.loads((tmp_path / "speed.json").read_text())["rows"]} & set(INTEGRATORS)


def test_scenes_that_mujoco_does_not_have(tiny: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pbfd: Pbfd) -> None:
    """Are compared with PyTorch alone, where they are asked for."""
    assert "gripper" not in USUAL
    course = COURSES["gripper"]
    monkeypatch.setitem(COURSES, "gripper", replace(course, worlds=(1, 3)))
    ran = pbfd("bench", "speed", "--quick", "--scenes", "gripper", "--out", tmp_path, "--json")
    assert ran.status == 0
    assert {row["engine"] for row in ran.data["rows"]} == {"native", "torch"}
    assert set(ran.data["scenes"]["gripper"]["references"]) == {"pbfd_torch"}


def test_unknown_scenes(tmp_path: Path, pbfd: Pbfd) -> None:
    """Are refused before anything is measured, with the ones there are; so is a file in the way."""
    ran = pbfd("bench", "speed", "--scenes", "hopper,moon", "--out", tmp_path / "new")
    assert ran.status == 2
    assert ran.err.startswith("pbfd: --scenes is 'hopper,moon': must be names from hopper, walker, quadruped, chain-ground")
    (tmp_path / "file").write_text("")
    assert pbfd("bench", "speed", "--out", tmp_path / "file").status == 2
    assert not (tmp_path / "new").exists()


def test_work_of_some_worlds() -> None:
    """Rows of starts and of controls."""
    q, controls = torch.arange(6.0).reshape(3, 2), torch.arange(6.0).reshape(2, 3, 1)
    part = Work(q, q, controls).of(1, 2)
    assert part.q.tolist() == [[2, 3], [4, 5]]
    assert part.controls.tolist() == [[[1], [2]], [[4], [5]]]
    assert part.world_steps == 4
