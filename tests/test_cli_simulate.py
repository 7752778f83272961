"""`pbfd simulate`: what it prints, writes and returns."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
import torch
from tqdm import tqdm

from pbfd_torch.cli.options import Choices, Friction, Integrator, SolverChoice
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.native.library import library
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from tests.command import ARM, SHORT, Pbfd, caller

pbfd = pytest.fixture(caller)
JSON_KEYS = {
    *("scene", "worlds", "dt", "duration", "steps", "integrator", "solver", "dtype", "device"),
    *("wall_s", "ms_per_simulated_s_per_world", "solved_fraction"),
    *("iterations_mean", "iterations_p95", "iterations_max", "evaluations_mean"),
    *("max_penetration_m", "energy_start_J", "energy_end_J", "energy_max_gain_J", "final_com_m", "metrics"),
}


@pytest.fixture
def unsolvable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gives the solver a single evaluation."""
    monkeypatch.setattr(Choices, "make_solver", lambda self: Descent(max_evaluations=1))


def test_json_is_one_object_with_every_key(pbfd: Pbfd) -> None:
    """`simulate box-slide --json` prints exactly one object; its numbers are those of a box that slides to rest."""
    ran = pbfd("simulate", "box-slide", "--json")
    assert (ran.status, ran.err) == (0, "")
    data = ran.data
    assert set(data) >= JSON_KEYS
    assert (data["scene"], data["worlds"], data["steps"]) == ("box-slide", 5, 75)
    assert (data["dt"], data["duration"]) == (0.02, pytest.approx(1.5))
    chosen = Choices()
    assert [data[key] for key in ("integrator", "solver")] == [chosen.integrator.value, chosen.solver.value]
    assert (data["dtype"], data["device"], data["solved_fraction"]) == ("float64", "cpu", 1.0)
    assert data["wall_s"] > 0
    assert data["ms_per_simulated_s_per_world"] == pytest.approx(1e3 * data["wall_s"] / 1.5 / 5)
    assert 0 < data["iterations_mean"] <= data["iterations_p95"] <= data["iterations_max"]
    assert data["evaluations_mean"] >= 1
    assert 1e-5 < data["max_penetration_m"] < 1e-3
    assert data["energy_start_J"] == pytest.approx(0.5 + 9.81 * 0.06, rel=0.01)
    assert data["energy_end_J"] == pytest.approx(data["energy_start_J"] - 0.5, abs=1e-3)
    assert 0 <= data["energy_max_gain_J"] < 1e-9
    assert data["final_com_m"] == pytest.approx([1 / (2 * 0.1 * 9.81), 0, 0.06], abs=2e-3)
    assert data["metrics"]["mu"] == [0.1, 0.2, 0.3, 0.5, 0.8]
    assert max(map(abs, data["metrics"]["stop_distance_error"])) < 0.01
    assert max(data["metrics"]["final_speed_m_s"]) < 1e-9


@pytest.mark.skipif(library() is None, reason="there is no compiled core")
def test_engine(pbfd: Pbfd) -> None:
    """--engine says what makes the steps; without it the compiled core does where it can, and the report says why not."""
    short = ("--duration", "0.04", "--json")
    compiled = pbfd("simulate", "hopper", *short).data
    assert (compiled["engine"], compiled["engine_reason"]) == ("native", "")
    defined = pbfd("simulate", "hopper", *short, "--engine", "torch").data
    assert (defined["engine"], defined["engine_reason"]) == ("torch", "")
    assert compiled["energy_end_J"] == pytest.approx(defined["energy_end_J"], rel=1e-6)
    for other in (("--accuracy", "1e-3"), ("--schedule", "asynchronous")):
        ours, theirs = (pbfd("simulate", "hopper", *short, *other, "--engine", name).data for name in ("native", "torch"))
        assert (ours["engine"], theirs["engine"]) == ("native", "torch")
        assert ours["energy_end_J"] == pytest.approx(theirs["energy_end_J"], rel=1e-6)


@pytest.mark.parametrize("choice", Integrator)
def test_integrators(pbfd: Pbfd, choice: Integrator) -> None:
    """Each that there is has a name here; how many steps were explicit is told."""
    assert {x.value for x in Integrator} == set(INTEGRATORS)
    data = pbfd("simulate", "chain-fixed", "--integrator", choice, "--dt", "0.005", "--duration", "0.05", "--json").data
    assert (data["integrator"], data["solved_fraction"]) == (choice.value, 1.0)
    assert data["explicit_steps"] == (10 if choice is Integrator.RUNGE_KUTTA else 0)


def test_table_names_the_scene_and_its_numbers(pbfd: Pbfd) -> None:
    """Without --json there is a table, and nothing on standard error: no progress bar where it is no terminal."""
    ran = pbfd("simulate", "box-slide", *SHORT)
    assert (ran.status, ran.err) == (0, "")
    assert ran.out.startswith("pbfd simulate box-slide")
    for key in JSON_KEYS - {"scene", "metrics"}:
        assert key in ran.out
    assert "stop_distance_m" in ran.out


def test_progress_bar_on_a_terminal(pbfd: Pbfd, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal a bar counts the steps on standard error; the JSON object stays alone on standard output."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    ran = pbfd("simulate", "box-slide", *SHORT, "--json")
    assert ran.data["steps"] == 5
    assert "step" in ran.err
    assert "\r" in ran.err


def test_notes_say_what_is_not_modelled(pbfd: Pbfd) -> None:
    """A file's lines on what is left out are notes of the report, in the table and in JSON."""
    arguments = ("simulate", ARM, "--duration", "0.016")
    ran = pbfd(*arguments)
    assert (ran.status, ran.err) == (0, "")
    assert "note: not modelled: mimic, these joints move freely (1): wrist\n" in ran.out
    notes = pbfd(*arguments, "--json").data["notes"]
    assert "not modelled: velocity limits (3): wrist, shoulder, extend" in notes
    assert any(re.fullmatch(r"the file has no ground: a level one was added at z = 0\.28\d* m", x) for x in notes)


def test_base_of_a_urdf_is_chosen(pbfd: Pbfd) -> None:
    """--fixed-base welds the root of a URDF, so that no ground is added; --free-base frees it."""
    arguments = ("simulate", ARM, "--duration", "0.016", "--json")
    fixed, free = pbfd(*arguments, "--fixed-base").data, pbfd(*arguments, "--free-base").data
    assert not any("ground" in x for x in fixed["notes"])
    assert any("ground" in x for x in free["notes"])


def test_out_is_the_rollout(pbfd: Pbfd, tmp_path: Path) -> None:
    """--out writes what `Rollout.load` reads, into folders that it makes; the report says where."""
    file = tmp_path / "new" / "folder" / "with-a-name-that-is-too-long-for-a-line-of-eighty-characters" / "rollout.npz"
    ran = pbfd("simulate", "box-slide", *SHORT, "--worlds", 3, "--out", file)
    assert ran.status == 0
    assert f"rollout written to {file}\n" in ran.out
    rollout = Rollout.load(file)
    assert (rollout.scene_name, rollout.dt, rollout.steps) == ("box-slide", 0.02, 5)
    assert rollout.q.shape == (6, 3, 7)
    assert bool(rollout.solved.all())
    assert list(file.parent.iterdir()) == [file]

    data = pbfd("simulate", "box-slide", *SHORT, "--worlds", 3, "--out", file, "--json").data  # writes over it
    assert Rollout.load(file).center_of_mass[-1, 0].tolist() == data["final_com_m"]


@pytest.mark.usefixtures("unsolvable")
def test_unsolved_steps_end_with_status_1(pbfd: Pbfd, tmp_path: Path) -> None:
    """The results are reported and written all the same, and the report says how many worlds are not to be trusted."""
    file = tmp_path / "rollout.npz"
    ran = pbfd("simulate", "box-slide", *SHORT, "--json", "--out", file)
    assert ran.status == 1
    assert ran.data["solved_fraction"] < 1
    rollout = Rollout.load(file)
    assert ran.data["unsolved_steps"] == int((~rollout.solved).sum()) > 0
    ran = pbfd("simulate", "box-slide", *SHORT)
    assert ran.status == 1
    assert f"{int((~rollout.solved).any(0).sum())} of 5 worlds have unsolved steps" in " ".join(ran.out.split())


def test_interrupted_rollout_is_kept(pbfd: Pbfd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C after the third step: those three are reported and written, and standard error says so."""
    done = []

    def update(bar: object, n: float = 1) -> None:
        done.append(n)
        if len(done) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(tqdm, "update", update)
    file = tmp_path / "rollout.npz"
    ran = pbfd("simulate", "box-slide", *SHORT, "--json", "--out", file)
    assert ran.status == 0
    assert ran.data["steps"] == 3
    assert ran.data["duration"] == pytest.approx(0.06)
    assert ran.err == "pbfd: interrupted after 3 of 5 steps; reporting those\n"
    assert Rollout.load(file).steps == 3


def test_interrupted_before_the_first_step(pbfd: Pbfd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C with nothing computed yet: no report, no file, and the status is neither that of success nor that of bad input."""

    def interrupt(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Simulator, "initial_state", interrupt)
    ran = pbfd("simulate", "box-slide", "--json", "--out", tmp_path / "rollout.npz")
    assert ran.status not in (0, 2)
    assert ran.out == ""
    assert "Traceback" not in ran.err
    assert list(tmp_path.iterdir()) == []


def test_seed_shakes_all_worlds_but_the_first(pbfd: Pbfd) -> None:
    """One seed gives the same numbers twice, another one other numbers; world 0 moves as it does without a seed."""

    def distances(*seed: object) -> list[float]:
        found = pbfd("simulate", "box-slide", *SHORT, "--json", *seed).data["metrics"]["stop_distance_m"]
        assert isinstance(found, list)
        return found

    plain, one, two = distances(), distances("--seed", 1), distances("--seed", 2)
    assert one == distances("--seed", 1)
    assert plain[0] == one[0] == two[0]
    for k in range(1, 5):
        assert len({plain[k], one[k], two[k]}) == 3
        assert abs(one[k] - plain[k]) < 0.1 * 0.05 * 4  # four standard deviations


@pytest.mark.parametrize("choice", list(Friction))
def test_friction_laws(pbfd: Pbfd, choice: Friction) -> None:
    """Coulomb's law, with anchors or without, stops the box after v²/(2 μ g); without friction it slides on at 1 m/s; a drag that
    grows with the speed, and is Coulomb's at 1 m/s, lets it go farther than Coulomb's; the derived law's is proportional to the
    speed: twice as far."""
    metrics = pbfd("simulate", "box-slide", "--friction", choice.value, "--json").data["metrics"]
    distance, exact = metrics["stop_distance_m"], metrics["stop_distance_exact_m"]
    ratio = [d / e for d, e in zip(distance, exact, strict=True)]
    if choice in (Friction.COULOMB, Friction.ANCHORED):
        assert ratio == pytest.approx([1] * 5, abs=0.01)
    elif choice is Friction.NONE:
        assert distance == pytest.approx([1.5] * 5, abs=1e-9)
        assert metrics["final_speed_m_s"] == pytest.approx([1] * 5, abs=1e-9)
    else:
        assert all(x > 1.3 for x in ratio)
        assert all(d < 1.0 for d in distance)
        assert all(0 < v < 0.5 for v in metrics["final_speed_m_s"])
    if choice is Friction.PBFD_DERIVED:  # the last two have all but stopped after 1.5 s
        assert ratio[3:] == pytest.approx([2, 2], rel=0.1)


def test_float32(pbfd: Pbfd, tmp_path: Path) -> None:
    """--dtype float32 computes in 32 bits, says so, and stops the box where 64 bits do."""
    file = tmp_path / "rollout.npz"
    ran = pbfd("simulate", "box-slide", "--dtype", "float32", "--json", "--out", file)
    assert ran.status == 0
    assert ran.data["dtype"] == "float32"
    assert Rollout.load(file).q.dtype == torch.float32
    assert max(map(abs, ran.data["metrics"]["stop_distance_error"])) < 0.01


@pytest.mark.parametrize("choice", list(SolverChoice))
def test_solvers(pbfd: Pbfd, choice: SolverChoice) -> None:
    """Every solver that can be chosen runs and is named in the report."""
    ran = pbfd("simulate", "box-slide", *SHORT, "--solver", choice.value, "--json")
    assert ran.status == 0
    assert ran.data["solver"] == choice.value


KEYFRAME = """
<mujoco model="arm">
  <worldbody>
    <body><joint name="elbow" damping="1"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/></body>
  </worldbody>
  <actuator><position joint="elbow" kp="50"/></actuator>
  <keyframe><key name="bent" qpos="0.5" ctrl="0.5"/></keyframe>
</mujoco>
"""


def test_keyframe_is_the_start(pbfd: Pbfd, tmp_path: Path) -> None:
    """--keyframe starts from a named state and holds its control: a servo keeps the angle within its droop; without it the arm
    starts straight and its servo keeps it so. An unknown name is refused with the known ones."""
    model, file = tmp_path / "arm.xml", tmp_path / "rollout.npz"
    model.write_text(KEYFRAME)
    for arguments, angle in ((("--keyframe", "bent"), 0.5), ((), 0.0)):
        assert pbfd("simulate", model, *arguments, *SHORT, "--out", file).status == 0
        q = Rollout.load(file).q
        assert float(q[0]) == pytest.approx(angle, abs=1e-12)
        assert float(q[-1]) == pytest.approx(angle, abs=0.05)
    ran = pbfd("simulate", model, "--keyframe", "home")
    assert (ran.status, ran.err) == (2, "pbfd: no keyframe named 'home': the keyframes are bent\n")
