"""The `pbfd` command's words about input that it cannot use."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from pbfd_torch.cli.options import Device, Dtype, Friction, Integrator, SolverChoice
from pbfd_torch.errors import ModelError
from pbfd_torch.models import SCENES
from pbfd_torch.simulator import Simulator
from tests.command import ARM, HOPPER, Pbfd, caller

pbfd = pytest.fixture(caller)
BOX = ("simulate", "box-slide")
BAD_INPUT: dict[str, tuple[tuple[object, ...], tuple[str, ...]]] = {
    "unknown scene": (("simulate", "box-slid"), ("'box-slid' is no file and no named scene", *SCENES)),
    "absurd scene": (("simulate", "x" * 300), ("is no file and no named scene",)),
    "missing file": (("simulate", "missing.urdf"), ("missing.urdf: no such file",)),
    "name too long": (("simulate", "x" * 300 + ".xml"), ("File name too long",)),
    "folder": (("simulate", "folder.xml"), ("folder.xml: is a directory: must be a file",)),
    "empty file": (("simulate", "empty.xml"), ("empty.xml: the file is empty",)),
    "malformed URDF": (("simulate", "broken.urdf"), ("broken.urdf", "malformed XML", "line 1")),
    "malformed MJCF": (("simulate", "broken.xml"), ("broken.xml", "XML", "broken.xml:1: malformed XML")),
    "no XML": (("simulate", "noise.xml"), ("noise.xml:1: malformed XML",)),
    "no robot": (("simulate", "page.xml"), ("page.xml: root element is <html>: must be <robot> (URDF) or <mujoco> (MJCF)",)),
    "other extension": (("simulate", "robot.txt"), ("robot.txt: extension '.txt' is not known: must be .urdf, .xml or .mjcf",)),
    "worlds 0": ((*BOX, "--worlds", 0), ("--worlds is 0: must be from 1 to",)),
    "worlds -3": ((*BOX, "--worlds", -3), ("--worlds is -3: must be from 1 to",)),
    "worlds beyond memory": (
        (*BOX, "--worlds", 99999999999),
        ("--worlds is 99999999999: must be from 1 to", "which have 16 KiB each in half of the memory that is available"),
    ),
    "a record beyond memory": (
        (*BOX, "--worlds", 10000, "--duration", 1e4),
        ("500000 steps of 10000 worlds make a record of at least", "GiB: must be at most", "half of the memory that is available"),
    ),
    "worlds of a file 0": (("simulate", HOPPER, "--worlds", 0), ("--worlds is 0: must be from 1 to",)),
    "threads beyond any": ((*BOX, "--threads", "9" * 400), (f"--threads is {'9' * 400}: must be from 1 to 256",)),
    "duration beyond any": ((*BOX, "--duration", 1e308, "--dt", 1e-5), ("--duration is 1e+308 s: must be from 1e-05 to 1e+09",)),
    "threads 0": ((*BOX, "--threads", 0), ("--threads is 0: must be from 1 to 256",)),
    "dt 0": ((*BOX, "--dt", 0), ("--dt is 0 s: must be from 1e-05 to 100",)),
    "dt < 0": ((*BOX, "--dt", -0.02), ("--dt is -0.02 s: must be from 1e-05 to 100",)),
    "dt > duration": ((*BOX, "--dt", 2), ("--dt is 2 s: must be at most the duration, 1.5 s",)),
    "dt NaN": ((*BOX, "--dt", "nan"), ("--dt is nan s: must be from 1e-05 to 100",)),
    "dt tiny": ((*BOX, "--dt", 1e-6), ("--dt is 1e-06 s: must be from 1e-05 to 100",)),
    "duration NaN": ((*BOX, "--duration", "nan"), ("--duration is nan s: must be from 1e-05 to 1e+09",)),
    "duration infinite": ((*BOX, "--duration", "inf"), ("--duration is inf s: must be from 1e-05 to 1e+09",)),
    "duration 0": ((*BOX, "--duration", 0), ("--duration is 0 s: must be from 1e-05 to 1e+09",)),
    "duration < 0": ((*BOX, "--duration", -1), ("--duration is -1 s: must be from 1e-05 to 1e+09",)),
    "too many steps": ((*BOX, "--duration", 1e9), ("--duration 1e+09 s", "50000000000 steps: must be at most 10000000")),
    "seed": ((*BOX, "--seed", 2**64), (f"--seed is {2**64}: must be from 0 to {2**64 - 1}",)),
    "accuracy tiny": ((*BOX, "--accuracy", 1e-300), ("--accuracy is 1e-300 m: must be from 1e-09 to 1",)),
    "control step 0": (("train", "hopper", "--control-dt", 0, "--out", "t"), ("--control-dt is 0 s: must be from 1e-05 to 1",)),
    "minutes NaN": (
        ("train", "hopper", "--minutes", "nan", "--out", "t"),
        ("--minutes is nan min: must be from 0.001 to 1000000",),
    ),
    "minutes < 0": (("train", "hopper", "--minutes", -1, "--out", "t"), ("--minutes is -1 min: must be from 0.001 to 1000000",)),
    "frames < 0": (("train", "hopper", "--frames", -5, "--out", "t"), ("--frames is -5: must be from 1 to 1000000000000",)),
    "envs": (("train", "hopper", "--envs", 99999999999, "--out", "t"), ("--envs is 99999999999: must be from 1 to",)),
    "mass range": (("train", "hopper", "--mass", 1, "inf", "--out", "t"), ("--mass is inf: must be from 0.001 to 1000",)),
    "training in a file": (("train", "hopper", "--out", "page.xml"), ("--out is 'page.xml': must be a folder, new or not",)),
    "long name": (("train", "hopper", "--out", "x" * 300), ("must be a folder, new or not, that can be written to",)),
    "episodes 0": (("evaluate", "page.xml", "--episodes", 0), ("--episodes is 0: must be from 1 to",)),
    "port 0": (("view", "box-slide", "--port", 0), ("--port is 0: must be from 1 to 65535",)),
    "frame < 0": (("view", "box-slide", "--frame", -1), ("--frame is -1: must be from 0 to 1000000000",)),
    "side by side": (("view", "box-slide", "--side-by-side", 65), ("--side-by-side is 65: must be from 1 to 64",)),
    "page of another kind": (("view", "box-slide", "--html", "a.txt"), ("--html is 'a.txt': must end in .html",)),
    "still in a file": (("view", "box-slide", "--png", "page.xml/a.png"), ("--png is 'page.xml/a.png': cannot be written there",)),
    "iterations < 0": (("optimize", "hopper", "--iterations", -1), ("--iterations is -1: must be from 1 to",)),
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


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ModelError("no mass", element="link\n'a'", file="r.urdf"), "r.urdf: link 'a': no mass"),
        (OSError(28, "No space left on device"), "[Errno 28] No space left on device"),
        (MemoryError(), "out of memory"),
    ],
    ids=["package", "system", "memory"],
)
def test_an_error_on_the_way_is_one_line(
    pbfd: Pbfd, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Exception, words: str
) -> None:
    """Whatever a command raises on purpose, or the system refuses: status 2 and one line, without a traceback, and no file."""

    def fail(*arguments: object, **more: object) -> None:
        raise error

    monkeypatch.setattr(Simulator, "rollout", fail)
    ran = pbfd("simulate", "box-slide", "--out", tmp_path / "r.npz")
    assert (ran.status, ran.out, ran.err) == (2, "", f"pbfd: {words}\n")
    assert list(tmp_path.iterdir()) == []
