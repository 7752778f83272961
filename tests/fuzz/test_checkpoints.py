"""Damaged checkpoints: refused by the package's own error, or read as a policy that acts and a training that can go on."""

from __future__ import annotations

import warnings
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pbfd_torch.learning.evaluation import Policy
from pbfd_torch.learning.folder import CHECKPOINT, Folder
from pbfd_torch.learning.ppo import Ppo, PpoTrainer
from pbfd_torch.learning.training_env import EnvSettings
from tests.fuzz.nonsense import NONSENSE, placed, places, unless_refused

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning:torchrl", "ignore::DeprecationWarning")
SHORT = Ppo(EnvSettings("cart-pole", num_envs=2), horizon=2, epochs=1, width=8)

TENSORS = st.builds(
    lambda value, shape, kind: torch.full(shape, value).to(kind),
    st.sampled_from([0.0, -1.0, 1e30, torch.nan, torch.inf]),
    st.sampled_from([(), (1,), (4,), (8, 4), (8, 8), (1, 8), (5056,), (0,)]),
    st.sampled_from([torch.float32, torch.float64, torch.float16, torch.int64, torch.uint8, torch.complex64]),
)
ODD = st.sampled_from([torch.zeros(()).expand(10**9, 10**9), torch.zeros(8, 4).to_sparse(), torch.zeros(8, 4, device="meta")])


@pytest.fixture(scope="module")
def trainer(tmp_path_factory: pytest.TempPathFactory) -> PpoTrainer:
    """A training of one batch."""
    made = PpoTrainer(SHORT, tmp_path_factory.mktemp("training"))
    made.run(1)
    return made


@cache
def good(path: Path) -> tuple[bytes, Any]:
    """What the training has saved."""
    file = path / CHECKPOINT
    return file.read_bytes(), torch.load(file, weights_only=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damaged")


def used(folder: Path, trainer: PpoTrainer) -> None:
    """Tries the policy, and goes on with the training."""
    path = folder / CHECKPOINT

    def act() -> int:
        policy = Policy.load(path)
        return len(policy(torch.zeros(3, len(policy.loc), dtype=torch.float64)))

    def go_on() -> None:
        saved = Folder(folder, "PPO", "damaged", resume=True).saved
        assert saved is not None
        trainer._go_on(saved)

    with torch.random.fork_rng(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert unless_refused(act, str(path)) in (None, 3)
        unless_refused(go_on)


@given(st.lists(st.tuples(st.integers(0, 2**20), st.integers(0, 255)), max_size=20), st.integers(0, 2**20))
def test_bytes(folder: Path, trainer: PpoTrainer, changes: list[tuple[int, int]], cut: int) -> None:
    """Some changed, the file cut short."""
    data = bytearray(good(trainer.folder.path)[0])
    for at, value in changes:
        data[at % len(data)] = value
    (folder / CHECKPOINT).write_bytes(bytes(data[: len(data) - cut % len(data)] if cut % 2 else data))
    used(folder, trainer)


@given(st.data())
def test_entries(folder: Path, trainer: PpoTrainer, data: st.DataObject) -> None:
    """One entry, wherever it is, is gone, nonsense, or a tensor of another kind, shape or value."""
    saved = good(trainer.folder.path)[1]
    where = data.draw(st.sampled_from(places(saved)))
    value = data.draw(st.one_of(NONSENSE, TENSORS, ODD))
    torch.save(placed(saved, where, value), folder / CHECKPOINT)
    used(folder, trainer)
