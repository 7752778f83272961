"""Rollouts as files: what is saved comes back; foreign and damaged files are refused; interruptions leave nothing."""

from __future__ import annotations

import json
import math
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pbfd_torch import InputError, Rollout, Simulator, memory
from pbfd_torch.models.chains import chain_fixed, chain_slope_drop
from pbfd_torch.records.rollout import FORMAT
from pbfd_torch.solvers.objective import Status
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from tests.bodies import at, rolled_out
from tests.record_arrays import ARRAYS
from tests.small_scenes import ball


@pytest.fixture(scope="module")
def rollout() -> Rollout:
    return rolled_out(ball(CoulombFriction(0.5)), 0.02, 0.1, at(0.06).repeat(2, 1))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
def test_saved_rollout_comes_back(tmp_path: Path, dtype: torch.dtype) -> None:
    """save then load: every array bitwise and in its dtype, names and dt equal; folders are made, nothing else is left behind."""
    setup = chain_slope_drop(2, dtype)
    simulator = Simulator(setup.scene, 0.05)
    saved = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=3)
    path = tmp_path / "new" / "folder" / "run.npz"
    saved.save(path)
    loaded = Rollout.load(path)
    for name in ARRAYS:
        before, after = getattr(saved, name), getattr(loaded, name)
        assert after.dtype == before.dtype, name
        assert torch.equal(after, before), name
    for name in ("scene_name", "dt", "link_names", "joint_names"):
        assert getattr(loaded, name) == getattr(saved, name)
    assert [x.name for x in path.parent.iterdir()] == ["run.npz"]


def test_rollout_without_contacts_comes_back(tmp_path: Path) -> None:
    """Arrays with no contact points survive as well."""
    saved = rolled_out(chain_fixed().scene, 0.02, 0.04)
    saved.save(tmp_path / "run.npz")
    assert Rollout.load(tmp_path / "run.npz").contact_force.shape == saved.contact_force.shape == (2, 0, 3)


def test_saving_replaces_a_file(tmp_path: Path, rollout: Rollout) -> None:
    """An old file at the path is replaced as a whole."""
    path = tmp_path / "run.npz"
    path.write_bytes(b"old")
    rollout.save(path)
    assert torch.equal(Rollout.load(path).q, rollout.q)


def test_bad_paths(tmp_path: Path, rollout: Rollout) -> None:
    """Nothing there, or a folder: `InputError` that names the path, for load and for save."""
    with pytest.raises(InputError, match=r"no rollout at .*missing"):
        Rollout.load(tmp_path / "missing.npz")
    with pytest.raises(InputError, match="not a readable rollout"):
        Rollout.load(tmp_path)
    with pytest.raises(InputError, match="cannot write"):
        rollout.save(tmp_path)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="cannot write"):
        rollout.save(tmp_path / "file" / "run.npz")
    assert sorted(x.name for x in tmp_path.iterdir()) == ["file"]


def test_foreign_files_are_refused(tmp_path: Path, rollout: Rollout) -> None:
    """Pickles (never unpickled), plain arrays, other archives, archives with another `meta`: `InputError` that names the file."""
    rollout.save(tmp_path / "good.npz")
    arrays = dict(np.load(tmp_path / "good.npz"))
    foreign: dict[str, Any] = {
        "empty": lambda p: p.write_bytes(b""),
        "text": lambda p: p.write_text("hello", encoding="utf-8"),
        "pickle": lambda p: p.write_bytes(pickle.dumps(_Explosive())),
        "array": lambda p: _with_file(p, lambda f: np.save(f, np.zeros(3))),
        "other archive": lambda p: np.savez(p, x=np.zeros(3)),
        "pickled meta": lambda p: np.savez(p, **{**arrays, "meta": np.array([_Explosive()], dtype=object)}),
        "pickled array": lambda p: np.savez(p, **{**arrays, "q": np.array([_Explosive()], dtype=object)}),
        "no q": lambda p: np.savez(p, **{k: v for k, v in arrays.items() if k != "q"}),
        "text array": lambda p: np.savez(p, **{**arrays, "q": np.array(["a", "b"])}),
    }
    metas: dict[str, object] = {
        "other format": {"format": "something else"},
        "format only": {"format": FORMAT},
        "names no list": {"format": FORMAT, "scene_name": "s", "dt": 0.1, "link_names": 5, "joint_names": []},
        "dt no number": {"format": FORMAT, "scene_name": "s", "dt": "soon", "link_names": [], "joint_names": []},
        "dt a truth": {"format": FORMAT, "scene_name": "s", "dt": True, "link_names": [], "joint_names": []},
        "list": [1, 2],
        "number": 3,
    }
    texts = {"no JSON": "{"} | {name: json.dumps(meta) for name, meta in metas.items()}
    for name, text in texts.items():
        foreign[name] = lambda p, text=text: np.savez(p, **{**arrays, "meta": np.array(text)})
    for name, write in foreign.items():
        path = tmp_path / "foreign.npz"
        write(path)
        with pytest.raises(InputError, match=r"foreign.npz'"):
            Rollout.load(path)
        assert not _Explosive.exploded, name


def rewritten(path: Path, change: Callable[[dict[str, Any]], object], meta: Callable[[Any], object] = lambda _: None) -> None:
    """The file at a path with changed arrays and a changed `meta`."""
    arrays = dict(np.load(path))
    words = json.loads(str(arrays.pop("meta")))
    meta(words)
    change(arrays)
    np.savez(path, meta=np.array(json.dumps(words)), **arrays)


METAS: dict[str, tuple[Callable[[Any], object], str]] = {
    "dt infinite": (lambda m: m.update(dt=math.inf), "meta holds Infinity: must be finite"),
    "dt NaN": (lambda m: m.update(dt=math.nan), "meta holds NaN: must be finite"),
    "dt negative": (lambda m: m.update(dt=-0.1), "dt is -0.1 s: must be > 0"),
    "dt a text": (lambda m: m.update(dt="soon"), "its dt is 'soon': must be a number"),
    "names a text": (lambda m: m.update(link_names="abc"), "its link_names is 'abc': must be a list"),
    "no dangers": (lambda m: m.pop("dangers"), "its dangers is None: must be a list"),
    "vertices infinite": (lambda m: m["appearance"]["visuals"][0].update(vertices=math.inf), "meta holds Infinity: must be finite"),
    "vertices huge": (lambda m: m["appearance"]["visuals"][0].update(vertices=10**30), "must be from -2⁶³ to 2⁶³ - 1"),
    "colour NaN": (lambda m: m["appearance"]["visuals"][0].update(color=[math.nan] * 3), "meta holds NaN: must be finite"),
    "offset NaN": (
        lambda m: m["appearance"]["planes"].append({"name": "p", "body": -1, "normal": [0, 0, 1], "offset": "nan"}),
        "plane 'p' has offset nan m: must be finite",
    ),
    "no up": (lambda m: m["appearance"].update(up=[0, 0, 0]), "the up is .*: must have a length"),
    "no planes": (lambda m: m["appearance"].pop("planes"), "KeyError 'planes'"),
    "joint beyond q": (lambda m: m["appearance"]["joints"][0].update(first=9), "q has 7"),
}


@pytest.mark.parametrize(("change", "words"), METAS.values(), ids=METAS.keys())
def test_nonsense_in_the_text_is_refused(tmp_path: Path, rollout: Rollout, change: Callable[[Any], object], words: str) -> None:
    """Numbers that are not finite, of the wrong kind or beyond what there is: `InputError` that names file and field."""
    path = tmp_path / "run.npz"
    rollout.save(path)
    rewritten(path, lambda arrays: None, change)
    with pytest.raises(InputError, match=rf"run.npz' is not a readable rollout: .*{words}"):
        Rollout.load(path)


def put(name: str, at: tuple[int, ...], value: float) -> Callable[[dict[str, Any]], object]:
    """A change of one value in an array."""
    return lambda arrays: arrays[name].__setitem__(at, value)


ARRAYS_CHANGED: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "pose NaN": (put("link_poses", (3, 1, 0, 0, 0), math.nan), "link_poses holds nan in step 3 of world 1: must be finite"),
    "q infinite": (put("q", (2, 0, 1), math.inf), "q holds inf in step 2 of world 0: must be finite"),
    "v NaN": (put("v", (5, 1, 1), math.nan), "v holds nan in step 5 of world 1: must be finite"),
    "force NaN": (put("contact_force", (4, 1, 0, 2), math.nan), "contact_force holds nan in step 4 of world 1: must be finite"),
    "time NaN": (put("time", (2,), math.nan), "time holds nan in step 1: must be later than the step before"),
    "time back": (put("time", (2,), 0.0), "time holds 0 in step 1: must be later than the step before"),
    "status unknown": (put("status", (1, 0), 99), "status holds 99 in step 1 of world 0: must be from -1 to 7"),
    "iterations < 0": (put("iterations", (0, 1), -1), "iterations holds -1 in step 0 of world 1: must be ≥ 0"),
    "suspect": (put("suspect", (0, 1), 50), "suspect holds 50 in step 0 of world 1: must be from -1 to"),
    "lanes < 0": (put("lanes", (), -5), "lanes holds -5: must be ≥ 0"),
    "complex": (lambda a: a.update(status=a["status"].astype(complex)), "status is torch.complex128: must be integers"),
    "half": (lambda a: a.update(q=a["q"].astype(np.float16)), "q is torch.float16: must be floating-point numbers"),
    "shape": (lambda a: a.update(v=a["v"][:-1]), r"v has shape \(5, 2, 6\): must be \(6, 2, 6\)"),
    "no dimensions": (lambda a: a.update(obstacle_poses=np.float64(1)), "IndexError"),
    "no start": (lambda a: a.update(q=a["q"][:1]), r"q has shape \(1, 2, 7\)"),
}


@pytest.mark.parametrize(("change", "words"), ARRAYS_CHANGED.values(), ids=ARRAYS_CHANGED.keys())
def test_values_that_no_simulation_leaves_are_refused(
    tmp_path: Path, rollout: Rollout, change: Callable[[dict[str, Any]], object], words: str
) -> None:
    """`InputError` that names the array and, where it is one value, its step and its world."""
    path = tmp_path / "run.npz"
    rollout.save(path)
    rewritten(path, change)
    with pytest.raises(InputError, match=words):
        Rollout.load(path)


def test_an_unsolved_step_may_hold_what_is_not_finite(tmp_path: Path, rollout: Rollout) -> None:
    """Its residual, say; its world's poses may not."""
    path = tmp_path / "run.npz"
    rollout.save(path)

    def fail(arrays: dict[str, Any]) -> None:
        arrays["status"][2, 1] = int(Status.NON_FINITE)
        arrays["residual_norm"][2, 1] = math.inf
        arrays["kinetic_energy"][3, 1] = math.nan

    rewritten(path, fail)
    assert not bool(Rollout.load(path).solved[2, 1])
    rewritten(path, put("q", (3, 1, 0), math.nan))
    with pytest.raises(InputError, match="q holds nan in step 3 of world 1"):
        Rollout.load(path)


def test_a_file_may_claim_half_of_the_memory(tmp_path: Path, rollout: Rollout, monkeypatch: pytest.MonkeyPatch) -> None:
    """More is refused before it is read, with both numbers."""
    path = tmp_path / "run.npz"
    rollout.save(path)
    monkeypatch.setattr(memory, "available", lambda: 2 * 10**4)
    with pytest.raises(InputError, match=r"it claims .* GiB: must be at most 9.31e-06 GiB, 50% of the memory that is available"):
        Rollout.load(path)


class _Explosive:
    """Says so when it is unpickled."""

    exploded = False

    def __reduce__(self) -> tuple[Any, ...]:
        return setattr, (_Explosive, "exploded", True)


def _with_file(path: Path, write: Callable[[Any], object]) -> None:
    with path.open("wb") as file:
        write(file)


def test_damaged_files_are_refused(tmp_path: Path, rollout: Rollout) -> None:
    """A file cut short anywhere, or with bytes changed: `InputError`, or the same data (the change hit nothing that matters)."""
    path = tmp_path / "run.npz"
    rollout.save(path)
    data = path.read_bytes()
    random = np.random.default_rng(0)
    refused = 0
    for k in range(300):
        damaged = bytearray(data)
        if k % 3 == 0:
            damaged = damaged[: int(random.integers(len(data)))]
        else:
            for _ in range(1 if k % 3 == 1 else 20):
                damaged[int(random.integers(len(data)))] = int(random.integers(256))
        path.write_bytes(bytes(damaged))
        try:
            assert torch.equal(Rollout.load(path).q, rollout.q)
        except InputError:
            refused += 1
    assert refused > 200


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_interrupted_save_leaves_nothing(
    tmp_path: Path, rollout: Rollout, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    """An interruption or a full disk half-way: the old file stays, no partial one is left."""
    path = tmp_path / "run.npz"
    rollout.save(path)
    good = path.read_bytes()

    def half(file: Any, **arrays: Any) -> None:
        file.write(b"half a file")
        raise error

    monkeypatch.setattr(np, "savez_compressed", half)
    with pytest.raises((KeyboardInterrupt, InputError)):
        rollout.save(path)
    assert path.read_bytes() == good
    assert [x.name for x in tmp_path.iterdir()] == ["run.npz"]


_SLOW_SAVE = """
import sys, numpy as np
from pbfd_torch import Simulator
from pbfd_torch.models import SCENES

setup = SCENES["box-slide"]()
simulator = Simulator(setup.scene, 0.02)
rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=1)

def slow(file, **arrays):
    file.write(b"half a file")
    file.flush()
    print("half", flush=True)
    sys.stdin.read()

np.savez_compressed = slow
rollout.save(sys.argv[1])
"""


@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_save_leaves_nothing_that_looks_like_a_result(tmp_path: Path, rollout: Rollout, kind: signal.Signals) -> None:
    """The process ends in the middle of writing: the old file stays, and what is left beside it is hidden and no .npz."""
    path = tmp_path / "run.npz"
    rollout.save(path)
    good = path.read_bytes()
    command = [sys.executable, "-c", _SLOW_SAVE, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout
        assert process.stdout.readline() == b"half\n"
        process.send_signal(kind)
        assert process.wait(60) == -kind
    assert path.read_bytes() == good
    left = [x.name for x in tmp_path.iterdir() if x != path]
    assert all(name.startswith(".") and name.endswith(".part") for name in left)
    assert list(tmp_path.glob("*.npz")) == [path]
