"""Rollouts as files: what is saved comes back; foreign and damaged files are refused; interruptions leave nothing."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pbfd_torch import InputError, Rollout, Simulator
from pbfd_torch.models.chains import chain_fixed, chain_slope_drop
from pbfd_torch.records.rollout import FORMAT
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from tests.bodies import at, rolled_out
from tests.record_arrays import ARRAYS
from tests.small_scenes import ball


@pytest.fixture
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
        Path(file).write_bytes(b"half a file")
        raise error

    monkeypatch.setattr(np, "savez_compressed", half)
    with pytest.raises((KeyboardInterrupt, InputError)):
        rollout.save(path)
    assert path.read_bytes() == good
    assert [x.name for x in tmp_path.iterdir()] == ["run.npz"]
