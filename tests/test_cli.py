"""The `pbfd` command: `info`, `scenes` and `demo`, and the command as a program of its own."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import pytest

import pbfd_torch.cli.demo
import pbfd_torch.cli.options
from pbfd_torch.cli.options import Choices
from pbfd_torch.models import SCENES, Setup
from pbfd_torch.records.rollout import Rollout
from tests.command import ARM, ROOT, SHORT, Pbfd, caller
from tests.gymnasium_files import gymnasium_file

pbfd = pytest.fixture(caller)
INFO_KEYS = {
    *("name", "nq", "nv", "nu", "mass_kg", "gravity_m_s2", "links", "joints"),
    *("actuators", "unlimited_actuators", "obstacles", "keyframes", "terms", "not_modelled", "native_library"),
    *("engine", "engine_reason"),
}


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
    assert data["unlimited_actuators"] == []

    ran = pbfd("info", "hopper")
    assert ran.status == 0
    assert ran.out.startswith("hopper: 4 links, 6 degrees of freedom, 3 actuators, 15.82")
    assert re.search(r"^foot_joint +hinge +foot +-0\.7854 … 0\.7854 +1 +1 *$", ran.out, re.MULTILINE)
    assert "obstacle: floor, HalfSpace at 0 m along [0, 0, 1]\n" in ran.out


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
    """Of Gymnasium's humanoid only numbers of MuJoCo's method, and rolling friction; long names stay whole in the tables."""
    file = gymnasium_file("humanoid")
    data = pbfd("info", file, "--json").data
    assert (data["nv"], data["nu"], len(data["links"])) == (23, 17, 13)
    lines = ["attributes of <geom>: margin (1)", "attributes of <option>: integrator (1), iterations (1), solver (1)"]
    assert data["not_modelled"] == lines
    ran = pbfd("info", file)
    assert (ran.status, ran.err) == (0, "")
    assert ran.out.endswith("not modelled:\n" + "".join(f"  {line}\n" for line in lines))
    assert pbfd("info", "hopper").out.endswith("not modelled: nothing\n")
    ball = tmp_path / "ball.xml"
    ball.write_text("<mujoco><worldbody><body><freejoint/><geom name='g' size='0.1' condim='6'/></body></worldbody></mujoco>")
    line = "torsional and rolling friction (condim 4, 6) (1): g"
    assert pbfd("info", ball, "--json").data["not_modelled"] == [line]
    assert pbfd("info", ball).out.endswith(f"not modelled:\n  {line}\n")
    assert re.search(r"^right_shoulder1 +hinge +right_upper_arm +-1\.484 … 1\.047 ", ran.out, re.MULTILINE)


def test_numbers_are_printed_as_people_write_them(pbfd: Pbfd, tmp_path: Path) -> None:
    """0.1, not 0.10000000149011612."""
    file = tmp_path / "step.xml"
    ball = "<body><freejoint/><geom size='0.1'/></body>"
    world = (
        f"<option gravity='0 0.1 -9.8'/><worldbody><geom name='step' type='box' size='1 1 1' pos='0.1 0 -1.3'/>{ball}</worldbody>"
    )
    file.write_text(f"<mujoco>{world}</mujoco>")
    out = pbfd("info", file).out
    assert "obstacle: step, Box at [0.1, 0, -1.3]\n" in out
    assert "gravity [0, 0.1, -9.8]\n" in out
    assert pbfd("info", file, "--json").data["obstacles"][0]["position_m"] == [0.1, 0, -1.3]


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
