"""The `pbfd` command: what it prints, writes and returns, and its words about input that it cannot use."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from tqdm import tqdm

import pbfd_torch.cli.demo
import pbfd_torch.cli.options
from pbfd_torch.cli.options import Choices, Device, Dtype, Friction, Integrator, SolverChoice
from pbfd_torch.models import SCENES, Setup
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from tests.gymnasium_files import gymnasium_file
from tests.printed import Printed, called

ROOT = Path(__file__).parent.parent
ARM = Path(__file__).parent / "data" / "arm_description" / "arm.urdf"
HOPPER = ROOT / "models" / "hopper.xml"
SHORT = ("--duration", "0.1")  # five steps of box-slide
JSON_KEYS = {
    *("scene", "worlds", "dt", "duration", "steps", "integrator", "solver", "dtype", "device"),
    *("wall_s", "ms_per_simulated_s_per_world", "solved_fraction"),
    *("iterations_mean", "iterations_p95", "iterations_max", "evaluations_mean"),
    *("max_penetration_m", "energy_start_J", "energy_end_J", "energy_max_gain_J", "final_com_m", "metrics"),
}
INFO_KEYS = {
    *("name", "nq", "nv", "nu", "mass_kg", "gravity_m_s2", "links", "joints"),
    *("actuators", "obstacles", "keyframes", "terms", "not_modelled"),
}


@dataclass(frozen=True)
class Ran(Printed):
    """How one call of the command ended."""

    @property
    def words(self) -> str:
        """Standard error in one line, without the frame that typer draws around its messages."""
        return " ".join(re.sub("[─│╭╮╰╯]", " ", self.err).split())


Pbfd = Callable[..., Ran]


@pytest.fixture
def pbfd(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Pbfd:
    """Calls the command in this process."""
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)  # the command sets its own: back to this one at the end

    def call(*arguments: object) -> Ran:
        capsys.readouterr()
        with warnings.catch_warnings():
            status = called(monkeypatch, *arguments)
        printed = capsys.readouterr()
        return Ran(status, printed.out, printed.err)

    return call


@pytest.fixture
def unsolvable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gives the solver a single evaluation."""
    monkeypatch.setattr(Choices, "make_solver", lambda self: Descent(max_evaluations=1))


# simulate -----------------------------------------------------------------------------------------------------------------


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
    """Coulomb's law stops the box after v²/(2 μ g); without friction it slides on at 1 m/s; a drag that grows with the speed, and
    is Coulomb's at 1 m/s, lets it go farther than Coulomb's; the derived law's is proportional to the speed: twice as far."""
    metrics = pbfd("simulate", "box-slide", "--friction", choice.value, "--json").data["metrics"]
    distance, exact = metrics["stop_distance_m"], metrics["stop_distance_exact_m"]
    ratio = [d / e for d, e in zip(distance, exact, strict=True)]
    if choice is Friction.COULOMB:
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


# bad input ----------------------------------------------------------------------------------------------------------------

BOX = ("simulate", "box-slide")
BAD_INPUT: dict[str, tuple[tuple[object, ...], tuple[str, ...]]] = {
    "unknown scene": (("simulate", "box-slid"), ("'box-slid' is no file and no named scene", *SCENES)),
    "absurd scene": (("simulate", "x" * 300), ("is no file and no named scene",)),
    "missing file": (("simulate", "missing.urdf"), ("missing.urdf: no such file",)),
    "name too long": (("simulate", "x" * 300 + ".xml"), ("File name too long",)),
    "folder": (("simulate", "folder.xml"), ("folder.xml: is a directory: must be a file",)),
    "empty file": (("simulate", "empty.xml"), ("empty.xml: the file is empty",)),
    "malformed URDF": (("simulate", "broken.urdf"), ("broken.urdf", "malformed XML", "line 1")),
    "malformed MJCF": (("simulate", "broken.xml"), ("broken.xml", "XML", "Line number=1")),
    "no XML": (("simulate", "noise.xml"), ("noise.xml:1: malformed XML",)),
    "no robot": (("simulate", "page.xml"), ("page.xml: root element is <html>: must be <robot> (URDF) or <mujoco> (MJCF)",)),
    "other extension": (("simulate", "robot.txt"), ("robot.txt: extension '.txt' is not known: must be .urdf, .xml or .mjcf",)),
    "worlds 0": ((*BOX, "--worlds", 0), ("--worlds is 0: must be ≥ 1",)),
    "worlds -3": ((*BOX, "--worlds", -3), ("--worlds is -3: must be ≥ 1",)),
    "worlds of a file 0": (("simulate", HOPPER, "--worlds", 0), ("--worlds is 0: must be ≥ 1",)),
    "threads 0": ((*BOX, "--threads", 0), ("--threads is 0: must be ≥ 1",)),
    "dt 0": ((*BOX, "--dt", 0), ("--dt is 0.0 s: must be > 0",)),
    "dt < 0": ((*BOX, "--dt", -0.02), ("--dt is -0.02 s: must be > 0",)),
    "dt > duration": ((*BOX, "--dt", 2), ("--dt is 2.0 s: must be > 0 and at most the duration, 1.5 s",)),
    "dt NaN": ((*BOX, "--dt", "nan"), ("--dt is nan s: must be > 0",)),
    "dt tiny": ((*BOX, "--dt", 1e-6), ("dt is 1e-06 s: must be a finite number ≥ 1e-5",)),
    "duration NaN": ((*BOX, "--duration", "nan"), ("--duration is nan s: must be > 0 and finite",)),
    "duration infinite": ((*BOX, "--duration", "inf"), ("--duration is inf s: must be > 0 and finite",)),
    "duration 0": ((*BOX, "--duration", 0), ("--duration is 0.0 s: must be > 0 and finite",)),
    "duration < 0": ((*BOX, "--duration", -1), ("--duration is -1.0 s: must be > 0 and finite",)),
    "too many steps": ((*BOX, "--duration", 1e9), ("--duration 1000000000.0 s", "50000000000 steps: must be at most 10000000")),
    "seed": ((*BOX, "--seed", 2**64), (f"--seed is {2**64}: must be from",)),
    "base of a scene": (("simulate", "hopper", "--free-base"), ("--free-base", "URDF files only", "scene 'hopper'")),
    "fixed base of a scene": (("simulate", "hopper", "--fixed-base"), ("--fixed-base", "URDF files only", "scene 'hopper'")),
    "base of an MJCF": (("simulate", HOPPER, "--free-base"), ("free_base is True: an MJCF file says itself what is free",)),
    "keyframe of a scene": (("simulate", "hopper", "--keyframe", "home"), ("--keyframe is for MJCF files only", "scene 'hopper'")),
    "keyframe of a URDF": (("simulate", ARM, "--keyframe", "home"), ("no keyframe named 'home': the keyframes are none",)),
    "info of a scene in code": (("info", "box-slide"), ("'box-slide' is a scene made in code: give a URDF or MJCF file",)),
    "info of nothing": (("info", "missing.xml"), ("missing.xml: no such file",)),
    "out of another kind": ((*BOX, "--out", "rollout.txt"), ("--out is 'rollout.txt': must end in .npz",)),
    "out below a file": ((*BOX, "--out", "page.xml/new/r.npz"), ("--out is 'page.xml/new/r.npz': cannot be written there",)),
    "out on a folder": ((*BOX, "--out", "folder.npz"), ("--out is 'folder.npz': cannot be written there",)),
    "demo below a file": (("demo", "--out", "page.xml"), ("page.xml/rollout.npz': cannot be written there",)),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with things that are no robots; anything that would be simulated fails the test."""
    monkeypatch.chdir(tmp_path)
    texts = {"broken.urdf": "<robot><link", "broken.xml": "<mujoco><body", "page.xml": "<html/>", "robot.txt": "<robot/>"}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "empty.xml").touch()
    (tmp_path / "noise.xml").write_bytes(bytes(range(128, 256)))
    for name in ("folder.xml", "folder.npz"):
        (tmp_path / name).mkdir()

    def refuse(*arguments: object, **more: object) -> None:
        pytest.fail("input that cannot be used was simulated")

    monkeypatch.setattr(Simulator, "rollout", refuse)
    return tmp_path


@pytest.mark.parametrize(("arguments", "words"), BAD_INPUT.values(), ids=BAD_INPUT.keys())
def test_bad_input(pbfd: Pbfd, folder: Path, arguments: tuple[object, ...], words: tuple[str, ...]) -> None:
    """Status 2, and one line on standard error that names the value and what it must be; nothing is printed or written."""
    before = sorted(folder.rglob("*"))
    writes = arguments[0] == "simulate" and "--out" not in arguments
    ran = pbfd(*arguments, *(("--out", "new/rollout.npz") if writes else ()))
    assert (ran.status, ran.out) == (2, "")
    assert ran.err.startswith("pbfd: ")
    assert ran.err.count("\n") == 1
    for word in words:
        assert word in ran.err
    assert sorted(folder.rglob("*")) == before


CHOICES = {"integrator": Integrator, "solver": SolverChoice, "friction": Friction, "dtype": Dtype, "device": Device}


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(("option", "kind"), CHOICES.items(), ids=CHOICES.keys())
def test_unknown_choice(pbfd: Pbfd, option: str, kind: type[Integrator | SolverChoice | Friction | Dtype | Device]) -> None:
    """Status 2; the message names the option, the value and every choice."""
    ran = pbfd("simulate", "box-slide", f"--{option}", "magic")
    assert (ran.status, ran.out) == (2, "")
    for word in (f"--{option}", "'magic'", *(x.value for x in kind)):
        assert word in ran.words


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(("option", "value"), [("worlds", "2.5"), ("worlds", "many"), ("dt", "fast"), ("seed", "x")])
def test_no_number(pbfd: Pbfd, option: str, value: str) -> None:
    """Status 2 for text where a number must be; the message names the option and what is wanted."""
    ran = pbfd("simulate", "box-slide", f"--{option}", value)
    assert (ran.status, ran.out) == (2, "")
    assert f"--{option}" in ran.words
    assert re.search("valid (number|integer|float)", ran.words)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
@pytest.mark.usefixtures("folder")
def test_cuda_where_there_is_none(pbfd: Pbfd) -> None:
    """--device cuda without a device: status 2, and the words say what to choose instead."""
    ran = pbfd("simulate", "box-slide", "--device", "cuda")
    assert (ran.status, ran.out) == (2, "")
    assert ran.err == "pbfd: --device is cuda, but PyTorch finds no CUDA device: choose cpu\n"


def test_unwritable_folder(pbfd: Pbfd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder without permission to write is refused before the simulation, whoever runs the test."""
    monkeypatch.setattr("os.access", lambda path, mode: False)
    file = tmp_path / "rollout.npz"
    ran = pbfd("simulate", "box-slide", "--out", file)
    assert (ran.status, ran.out) == (2, "")
    assert ran.err == f"pbfd: --out is '{file}': cannot be written there\n"


# info, scenes, demo -------------------------------------------------------------------------------------------------------


def test_info_of_a_shipped_robot(pbfd: Pbfd) -> None:
    """`info hopper` describes the file behind the scene, as JSON and as tables."""
    ran = pbfd("info", "hopper", "--json")
    assert (ran.status, ran.err) == (0, "")
    data = ran.data
    assert set(data) == INFO_KEYS
    assert (data["name"], data["nq"], data["nv"], data["nu"]) == ("hopper", 6, 6, 3)
    assert data["gravity_m_s2"] == [0, 0, -9.81]
    assert [x["name"] for x in data["links"]] == ["torso", "thigh", "leg", "foot"]
    assert data["mass_kg"] == pytest.approx(sum(x["mass_kg"] for x in data["links"]))
    assert data["links"][3] == {"name": "foot", "parent": "leg", "mass_kg": pytest.approx(5.3156, abs=1e-3), "shapes": ["Capsule"]}
    assert [x["kind"] for x in data["joints"]] == ["slide", "slide", "hinge", "hinge", "hinge", "hinge"]
    foot = data["joints"][-1]
    assert foot["range"] == pytest.approx([-math.pi / 4, math.pi / 4])
    assert (foot["armature"], foot["damping"]) == (1, 1)
    assert data["obstacles"] == [{"name": "floor", "shape": "HalfSpace", "normal": [0, 0, 1], "offset_m": 0}]
    assert data["actuators"] == ["thigh", "leg", "foot"]

    ran = pbfd("info", "hopper")
    assert ran.status == 0
    assert ran.out.startswith("hopper: 4 links, 6 degrees of freedom, 3 actuators, 15.82")
    assert re.search(r"^foot_joint +hinge +foot +-0\.7854 … 0\.7854 +1 +1 *$", ran.out, re.MULTILINE)
    assert "obstacle: floor, HalfSpace at 0 m along [0.0, 0.0, 1.0]\n" in ran.out


def test_info_of_a_urdf(pbfd: Pbfd) -> None:
    """`info` on a URDF: its root is free unless --fixed-base, and what is not modelled is listed line by line."""
    free, fixed = pbfd("info", ARM, "--json").data, pbfd("info", ARM, "--fixed-base", "--json").data
    assert (free["nv"], fixed["nv"]) == (9, 3)
    assert free["joints"][0]["kind"] == "free"
    assert [x["name"] for x in fixed["joints"]] == ["shoulder", "extend", "wrist"]
    assert "velocity limits (3): wrist, shoulder, extend" in free["not_modelled"]
    out = pbfd("info", ARM).out
    assert out.endswith("not modelled:\n" + "".join(f"  {line}\n" for line in free["not_modelled"]))


def test_info_lists_what_is_not_modelled(pbfd: Pbfd, tmp_path: Path) -> None:
    """Everything that Gymnasium's humanoid asks for is modelled, rolling friction is not; long names stay whole in the tables."""
    file = gymnasium_file("humanoid")
    data = pbfd("info", file, "--json").data
    assert (data["nv"], data["nu"], len(data["links"])) == (23, 17, 13)
    assert data["not_modelled"] == []
    ran = pbfd("info", file)
    assert (ran.status, ran.err) == (0, "")
    assert ran.out.endswith("not modelled: nothing\n")
    ball = tmp_path / "ball.xml"
    ball.write_text("<mujoco><worldbody><body><freejoint/><geom name='g' size='0.1' condim='6'/></body></worldbody></mujoco>")
    line = "torsional and rolling friction (condim 4, 6) (1): g"
    assert pbfd("info", ball, "--json").data["not_modelled"] == [line]
    assert pbfd("info", ball).out.endswith(f"not modelled:\n  {line}\n")
    assert re.search(r"^right_shoulder1 +hinge +right_upper_arm +-1\.484 … 1\.047 ", ran.out, re.MULTILINE)


def test_names_are_printed_as_they_are(pbfd: Pbfd, tmp_path: Path) -> None:
    """Square brackets and colons in names are no mark-up."""
    file = tmp_path / "odd.xml"
    body = '<body name="[/red]"><joint name=":robot:"/><geom size="0.1"/></body>'
    file.write_text(f'<mujoco model="[bold]"><worldbody>{body}</worldbody></mujoco>')
    ran = pbfd("info", file)
    assert ran.out.startswith("[bold]: 1 links")
    assert re.search(r"^:robot: +hinge +\[/red\]", ran.out, re.MULTILINE)
    assert pbfd("simulate", file, "--duration", 0.008).out.startswith("pbfd simulate [bold]")


def test_scenes_are_listed(pbfd: Pbfd) -> None:
    """`scenes` prints one line for each scene: its name and a whole sentence."""
    ran = pbfd("scenes")
    assert (ran.status, ran.err) == (0, "")
    lines = ran.out.splitlines()
    assert [line.split()[0] for line in lines] == list(SCENES)
    assert all(re.fullmatch(r"\S+ +[A-Z].+\.", line) for line in lines)


def test_demo(pbfd: Pbfd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`demo` writes a rollout and a picture, here of two worlds and half a second."""
    load_setup = pbfd_torch.cli.options.load_setup

    def shorter(scene: str, worlds: int | None, choices: Choices) -> Setup:
        assert worlds is not None
        assert worlds > 2
        return dataclasses.replace(load_setup(scene, 2, choices), duration=0.5)

    monkeypatch.setattr(pbfd_torch.cli.demo, "load_setup", shorter)
    folder = tmp_path / "new" / "demo"
    ran = pbfd("demo", "--out", folder)
    assert (ran.status, ran.err) == (0, "")
    assert f"picture written to {folder / 'picture.png'}\n" in ran.out
    assert sorted(x.name for x in folder.iterdir()) == ["picture.png", "rollout.npz"]
    rollout = Rollout.load(folder / "rollout.npz")
    assert (rollout.scene_name, rollout.steps, rollout.q.shape[1]) == ("chain-slope-drop", 10, 2)
    picture = (folder / "picture.png").read_bytes()
    assert picture.startswith(b"\x89PNG\r\n\x1a\n")
    assert len(picture) > 30_000


# as a program -------------------------------------------------------------------------------------------------------------


def program(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs the command as a program of its own, in `folder`."""
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r}); from pbfd_torch.cli.main import main; main()"]
    return subprocess.run([*command, *arguments], cwd=folder, capture_output=True, text=True, timeout=120, check=False)


def test_program_that_succeeds(tmp_path: Path) -> None:
    """Status 0; standard output holds the JSON object alone, standard error nothing; the file is there, alone and
    with the permissions of any new file."""
    ran = program("simulate", "box-slide", *SHORT, "--json", "--out", "rollout.npz", folder=tmp_path)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert json.loads(ran.stdout)["steps"] == 5
    file, plain = tmp_path / "rollout.npz", tmp_path / "plain"
    assert list(tmp_path.iterdir()) == [file]
    plain.touch()
    assert file.stat().st_mode == plain.stat().st_mode


def test_program_with_bad_input(tmp_path: Path) -> None:
    """Status 2 and one line on standard error."""
    ran = program("simulate", "nothing.xml", folder=tmp_path)
    assert (ran.returncode, ran.stdout, ran.stderr) == (2, "", "pbfd: nothing.xml: no such file\n")
