"""Drawn command lines: they do what is asked, or end with status 2 and a word about it; never with a traceback."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import pbfd_torch.viewer
from pbfd_torch.cli import (
    bench_friction,
    bench_hard_cases,
    bench_precision,
    bench_slope,
    bench_soak,
    bench_solvers,
    bench_speed,
    optimize,
    simulate,
)
from pbfd_torch.errors import InputError
from pbfd_torch.learning.ppo import PpoTrainer
from pbfd_torch.learning.shac import ShacTrainer
from tests.command import ARM, HOPPER
from tests.printed import called

ABSURD = [
    *("nan", "inf", "-inf", "-1", "0", "1e-300", "1e300", "1e999", "99999999999", "-99999999999", str(2**64), "9" * 400, "1e-9"),
    *("2.5", "", " ", "x", "0x10", "--", "-", "--help", "None", "true", "1,2", "💥", "a\nb", "x" * 300),
    *("folder", "text.npz", "damaged.pt"),
]
WORDS = st.text(st.characters(exclude_characters="/\\\0", exclude_categories=["Cs"]), max_size=6).filter(lambda x: x != "..")
ANY = st.sampled_from(ABSURD) | WORDS

# what each option also takes, besides nonsense; "" is given to flags, which take nothing
SCENE = ["box-slide", "dzhanibekov", str(HOPPER), str(ARM), "missing.xml", "folder", "broken.urdf"]
OUT = ["new/run.npz", "folder/run.npz", "run.txt", "text.npz/run.npz"]
WORLDS, DT, SEED = ["1", "2", "3"], ["0.02", "0.05"], ["0", "7"]
SIMULATE: dict[str, list[str]] = {
    "--worlds": WORLDS, "--duration": ["0.1"], "--dt": DT, "--accuracy": ["0.01"], "--seed": SEED, "--out": OUT,
    "--integrator": ["bdf2", "implicit-euler"], "--solver": ["lm", "jtj-lm"], "--friction": ["none", "anchored"],
    "--dtype": ["float32"], "--device": ["cpu", "cuda"], "--schedule": ["asynchronous"], "--engine": ["native", "torch"],
    "--workers": ["1"], "--threads": ["1"],
    "--keyframe": ["home"], "--free-base": [""], "--fixed-base": [""], "--json": [""],
}  # fmt: skip
VIEW: dict[str, list[str]] = {
    "--ghost": ["text.npz"], "--live": [""], "--html": ["a.html"], "--png": ["a.png", "folder"], "--mp4": ["a.gif"],
    "--frame": ["1"], "--side-by-side": ["1", "2"], "--contacts": [""],
    "--worlds": WORLDS, "--duration": ["0.1"], "--dt": DT, "--seed": SEED,
    "--host": ["127.0.0.1"], "--port": ["8080"], "--origin": ["https://hub.example.org"], "--keyframe": ["home"],
}  # fmt: skip
TRAIN: dict[str, list[str]] = {
    "--out": ["new", "folder", "text.npz"], "--method": ["ppo", "shac"], "--frames": ["1"], "--minutes": ["1"], "--resume": [""],
    "--seed": SEED, "--workers": ["1"], "--ray": ["0", "1"], "--dtype": ["float32"], "--control-dt": ["0.02"], "--dt": ["0.01"],
    "--push": ["5"], "--threads": ["1"], "--mass": ["0.5 1.5", "2 1"], "--friction": ["nan 1"], "--gain": ["0 1"],
}  # fmt: skip
EVALUATE = {"--on": ["pbfd", "mujoco"], "--episodes": ["1"], "--seed": SEED, "--out": ["new", "text.npz"], "--json": [""]}
OPTIMIZE = {"--iterations": ["1"], "--worlds": WORLDS, "--seed": SEED, "--threads": ["1"], "--out": ["new"], "--json": [""]}
BENCH = {"--out": ["new", "text.npz"], "--quick": [""], "--engine": ["native", "torch"], "--json": [""]}
MEASURED = ("--steps", "--dt", "--worlds", "--seconds", "--sizes", "--batch", "--repeats")
COMMANDS: dict[tuple[str, ...], tuple[list[str], dict[str, list[str]]]] = {
    ("simulate",): (SCENE, SIMULATE),
    ("info",): (SCENE, {"--fixed-base": [""], "--free-base": [""], "--json": [""]}),
    ("view",): ([*SCENE, "text.npz"], VIEW),
    ("train",): (["cart-pole", "hopper"], TRAIN),
    ("evaluate",): (["damaged.pt", "folder", "missing.pt"], EVALUATE),
    ("optimize",): (["hopper", "box-throw"], OPTIMIZE),
    ("demo",): ([], {"--out": ["new", "text.npz"]}),
    ("scenes",): ([], {}),
    ("bench", "solvers"): (
        [],
        BENCH | {f"--{x}": ["1"] for x in ("steps", "dt", "worlds", "seconds", "sizes", "batch", "repeats")},
    ),
    ("bench", "friction"): ([], BENCH),
    ("bench", "precision"): ([], BENCH | {"--scenes": ["stack"], "--integrators": ["bdf2"]}),
    ("bench", "gradients"): ([], BENCH | {"--problems": ["box", "toss,box"]}),
    ("bench", "hard-cases"): ([], BENCH | {"--cases": ["free-fall"], "--integrators": ["bdf2"], "--dt": ["0.01"]}),
    ("bench", "slope"): ([], BENCH | {"--duration": ["1"]}),
    ("bench", "speed"): ([], BENCH | {"--scenes": ["hopper", "stack"]}),
    ("bench", "soak"): ([], BENCH | {"--world-steps": ["10"], "--seed": ["3"], "--dt": ["0.01"]}),
}


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    """A command, most times with what it is about, and some of its options."""
    command = draw(st.sampled_from(list(COMMANDS)))
    subjects, options = COMMANDS[command]
    found = list(command)
    named: int = draw(st.integers(0, 9))
    if subjects and named:
        found.append(draw(st.sampled_from(subjects) | ANY))
    names: list[str] = draw(st.sets(st.sampled_from(sorted(options)), max_size=4).map(sorted)) if options else []
    for name in names:
        found.append(name)
        if options[name] != [""]:  # flags take nothing
            found += draw(st.sampled_from(options[name]).map(str.split) | ANY.map(lambda value: [value]))
    if command == ("train",) and draw(st.booleans()):
        found += ["--out", "new", "--envs", "2"]
    return found


class _Shown:
    """In the place of what opens a server."""

    address = "nowhere"

    def __init__(self, *_: Any) -> None:
        pass

    def wait(self) -> None:
        pass

    def close(self) -> None:
        pass


def _not_measured(*_: Any) -> Any:
    raise InputError("this is where the work would begin")


@pytest.fixture(scope="module", autouse=True)
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A folder with things that are no robots and no results; ten steps are many, and what takes minutes, or a browser, is left
    out."""
    folder = tmp_path_factory.mktemp("lines")
    (folder / "folder").mkdir()
    (folder / "text.npz").write_text("no rollout")
    (folder / "damaged.pt").write_bytes(b"PK\x03\x04 nothing")
    (folder / "broken.urdf").write_text("<robot><link")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(simulate, "MAX_STEPS", 10)
        patch.setattr(optimize, "run", _not_measured)
        for bench in (bench_friction, bench_hard_cases, bench_precision, bench_slope, bench_soak, bench_solvers, bench_speed):
            patch.setattr(bench, "measured", _not_measured)
        for trainer in (PpoTrainer, ShacTrainer):
            patch.setattr(trainer, "__init__", _not_measured)
        for name in ("Inspector", "Live"):
            patch.setattr(pbfd_torch.viewer, name, _Shown)
        for name in ("save_html", "save_png", "save_film"):
            patch.setattr(pbfd_torch.viewer, name, lambda *_, **__: None)
        yield
    torch.set_num_threads(1)


@given(command_lines())
def test_command_lines(line: list[str]) -> None:
    """Status 0, 1 or 2; with 2, standard error says why."""
    out, err = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        warnings.catch_warnings(),
    ):
        patch.setattr(warnings, "formatwarning", warnings.formatwarning)
        status = called(patch, *line)
    assert status in (0, 1, 2)
    assert status != 2 or err.getvalue() or out.getvalue()
    assert "Traceback" not in err.getvalue()


def test_every_command_is_drawn() -> None:
    """The lists above have all commands and options."""
    import typer.main

    from pbfd_torch.cli.main import app

    found = {}

    def walk(command: Any, before: tuple[str, ...]) -> None:
        for name, inner in getattr(command, "commands", {}).items():
            walk(inner, (*before, name))
        if not hasattr(command, "commands"):
            found[before] = {name for x in command.params for name in (*x.opts, *x.secondary_opts) if name.startswith("--")}

    walk(typer.main.get_command(app), ())
    assert set(found) == set(COMMANDS)
    left = {command: names - set(COMMANDS[command][1]) for command, names in found.items()}
    assert {c: n for c, n in left.items() if n} == {
        ("train",): {"--envs"},  # given where a training would begin
        ("view",): {"--integrator", "--fixed-base", "--free-base"},
    }


def test_the_folder_is_small() -> None:
    """Whatever was drawn, results are in the folder of the tests."""
    assert Path.cwd().name.startswith("lines")
