"""Damaged rollout files: refused by the package's own error, or read as something that can be used."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from pbfd_torch import Rollout
from pbfd_torch.models import SCENES
from pbfd_torch.simulator import Simulator
from tests.fuzz.nonsense import NONSENSE, placed, places, unless_refused

KINDS = st.sampled_from([*map(np.dtype, ("f8", "f4", "f2", "c16", "i4", "i8", "u1", "?", "U3"))])
VALUES = st.sampled_from([np.nan, np.inf, -np.inf, 1e308, -1e308, 0.0, -1.0, 2.0**31, 1e-320])


@cache
def good() -> bytes:
    """A file of two worlds, two steps and contacts."""
    setup = SCENES["chain-slope-drop"](worlds=2)
    simulator = Simulator(setup.scene, 0.05)
    rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(np, "savez_compressed", np.savez)  # its bytes are the numbers
        return written(rollout.save)


def written(save: Callable[[Path], object]) -> bytes:
    """What a function writes to a path."""
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.npz"
        save(path)
        return path.read_bytes()


def contents() -> tuple[dict[str, Any], Any]:
    """The arrays and the text of the good file."""
    arrays = dict(np.load(io.BytesIO(good())))
    return arrays, json.loads(str(arrays.pop("meta")))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("rollouts") / "run.npz"


def read(path: Path) -> None:
    """Reads the file, and uses what is read."""
    rollout = unless_refused(lambda: Rollout.load(path), str(path))
    if rollout is None:
        return
    assert rollout.steps > 0
    assert bool(rollout.q.isfinite().all())
    assert bool(rollout.link_poses.isfinite().all())
    assert rollout.penetration.shape == rollout.solved.shape
    assert set(rollout.hazardous()) <= set(rollout.dangers)
    rollout.save(path)
    Rollout.load(path)


@given(
    st.lists(st.tuples(st.integers(0, 2**20), st.integers(0, 255)), max_size=20),
    st.integers(0, 2**20),
    st.binary(max_size=20),
)
def test_bytes(path: Path, changes: list[tuple[int, int]], cut: int, more: bytes) -> None:
    """Some changed, the file cut short, others appended."""
    data = bytearray(good())
    for at, value in changes:
        data[at % len(data)] = value
    path.write_bytes(bytes(data[: len(data) - cut % len(data)] if cut % 2 else data) + more)
    read(path)


@given(st.data())
def test_arrays(path: Path, data: st.DataObject) -> None:
    """One array missing, of another kind and shape, or with a value that nothing should have."""
    arrays, meta = contents()
    name = data.draw(st.sampled_from(sorted(arrays)))
    kind = data.draw(st.sampled_from(["missing", "other", "value"]))
    if kind == "missing":
        del arrays[name]
    elif kind == "other" or arrays[name].size == 0:
        shape = data.draw(st.one_of(arrays_of.array_shapes(min_dims=0, max_dims=4, max_side=4), st.just(arrays[name].shape)))
        arrays[name] = np.zeros(shape, data.draw(KINDS))
    else:
        with np.errstate(all="ignore"):
            value = np.array(data.draw(VALUES)).astype(arrays[name].dtype)
        arrays[name] = arrays[name].copy()
        arrays[name].flat[data.draw(st.integers(0, arrays[name].size - 1))] = value
    np.savez(path, meta=np.array(json.dumps(meta)), **arrays)
    read(path)


@given(st.data())
def test_text(path: Path, data: st.DataObject) -> None:
    """One entry of the text, wherever in it, is nonsense or gone."""
    arrays, meta = contents()
    where = data.draw(st.sampled_from(places(meta)))
    np.savez(path, meta=np.array(json.dumps(placed(meta, where, data.draw(NONSENSE)))), **arrays)
    read(path)
