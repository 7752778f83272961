"""Checkpoints: every part of a damaged one is refused by name, before anything is made of it."""

from __future__ import annotations

import dataclasses
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from pbfd_torch import InputError
from pbfd_torch.learning.evaluation import Policy
from pbfd_torch.learning.ppo import Ppo, PpoTrainer
from pbfd_torch.learning.training_env import EnvSettings

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:torchrl", "ignore::FutureWarning:torchrl")
POLE = EnvSettings("cart-pole", num_envs=4, seed=3)
SHORT = Ppo(POLE, horizon=4, epochs=1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training of one batch."""
    folder = tmp_path_factory.mktemp("training")
    PpoTrainer(SHORT, folder).run(1)
    return folder


def entry(saved: Any, *keys: Any) -> Any:
    """The dictionary that holds the last key."""
    for key in keys[:-1]:
        saved = saved[key]
    return saved


FIRST = "module.0.module.0.0.weight"
DAMAGES: dict[str, tuple[tuple[Any, ...], Any, str]] = {
    "no settings": (("settings",), None, "settings is None: must be a dictionary"),
    "no environment": (("settings", "env"), [], r"settings.env is \[\]: must be a dictionary"),
    "unknown environment": (("settings", "env", "name"), "ant", "no environment named 'ant'"),
    "list for a name": (("settings", "env", "name"), ["hopper"], r"no environment named \['hopper'\]"),
    "worlds": (("settings", "env", "num_envs"), -1, "num_envs is -1: must be an integer from 1 to"),
    "control step": (("settings", "env", "control_dt"), 0.0, r"control_dt \[s\] is 0.0: must be a finite number from 1e-05 to 1"),
    "step NaN": (("settings", "env", "dt"), math.nan, r"dt \[s\] is nan: must be a finite number"),
    "dtype": (("settings", "env", "dtype"), "int8", "dtype is 'int8': must be float64 or float32"),
    "randomization": (("settings", "env", "randomization"), {"mass": 3}, "randomization is {'mass': 3}"),
    "another setting": (("settings", "env", "colour"), 1, "hold or lack colour"),
    "width": (("settings", "width"), 10**9, "settings.width is 1000000000: must be an integer from 1 to 4096"),
    "width a truth": (("settings", "width"), True, "settings.width is True: must be an integer"),
    "rows": (("rows",), "none", "rows is 'none': must be a list"),
    "row": (("rows", 0, "frames"), 1.5, r"rows\[0\].frames is 1.5: must be an integer"),
    "seconds": (("seconds",), -1.0, "seconds is -1.0: must be a finite number from 0"),
    "random": (
        ("random",),
        torch.zeros(3),
        r"random is a tensor of torch.float32 with shape \(3,\): must be",
    ),
    "no actor": (("actor",), None, "actor is None: must be a dictionary"),
    "no weight": (("actor", "other"), torch.zeros(3), "actor has not the entries it must have: other"),
    "weight NaN": (("actor", FIRST), torch.full((64, 4), math.nan), f"actor.{FIRST} holds nan: must be finite"),
    "weight of other shape": (("actor", FIRST), torch.zeros(64, 5), r"shape \(64, 5\): must be a tensor of torch.float32 with"),
    "weight huge": (("actor", FIRST), torch.zeros(()).expand(10**6, 10**6), r"shape \(1000000, 1000000\): must be"),
    "weight of other type": (("actor", FIRST), torch.zeros(64, 4).int(), "is a tensor of torch.int32"),
    "weight sparse": (("actor", FIRST), torch.zeros(64, 4).to_sparse(), "must be a tensor of torch.float32 with shape"),
    "weight no tensor": (("actor", FIRST), 3.0, f"actor.{FIRST} is 3.0: must be a tensor"),
    "statistics": (("statistics", "var"), {"observation": -torch.ones(4)}, "statistics.var.observation holds -1.0: must be ≥ 0"),
    "no count": (("statistics", "count"), {"observation": torch.tensor(0)}, "statistics.count.observation holds 0.0: must be ≥ 1"),
}


@pytest.mark.parametrize(("keys", "value", "words"), DAMAGES.values(), ids=DAMAGES.keys())
def test_a_damaged_checkpoint_is_refused(trained: Path, tmp_path: Path, keys: Any, value: Any, words: str) -> None:
    """`InputError` that names file, field, value and range, to those who try a policy as to those who go on with a training."""
    saved = torch.load(trained / "checkpoint.pt", weights_only=True)
    entry(saved, *keys)[keys[-1]] = value
    torch.save(saved, tmp_path / "checkpoint.pt")
    with pytest.raises(InputError, match=words) as found:
        Policy.load(tmp_path / "checkpoint.pt")
    assert str(tmp_path) in str(found.value)
    with pytest.raises(InputError, match=words) as found:
        PpoTrainer(SHORT, tmp_path, resume=True)
    assert str(tmp_path) in str(found.value)


MOMENTS: dict[str, tuple[tuple[Any, ...], Any, str]] = {
    "none": (("optimiser",), None, "optimiser is None: must be a dictionary"),
    "of no parameter": (("optimiser", "state", 99), {}, "a key of optimiser.state is 99: must be an integer from 0 to"),
    "NaN": (
        ("optimiser", "state", 0, "exp_avg"),
        torch.full((64, 4), math.nan),
        "state.0.exp_avg holds nan: must be finite",
    ),
    "negative": (
        ("optimiser", "state", 0, "exp_avg_sq"),
        -torch.ones(64, 4),
        "state.0.exp_avg_sq holds -1.0: must be ≥ 0",
    ),
    "of other shape": (("optimiser", "state", 0, "exp_avg"), torch.zeros(3), r"shape \(3,\): must be a tensor"),
    "critic": (("critic",), {}, "critic has not the entries it must have"),
    "generator": (("random",), torch.full((5056,), 255, dtype=torch.uint8), "random is no state of torch's generator"),
}


@pytest.mark.parametrize(("keys", "value", "words"), MOMENTS.values(), ids=MOMENTS.keys())
def test_a_training_does_not_go_on_from_damage(trained: Path, tmp_path: Path, keys: Any, value: Any, words: str) -> None:
    """What only a training needs is checked where it goes on; a policy can be tried without."""
    saved = torch.load(trained / "checkpoint.pt", weights_only=True)
    entry(saved, *keys)[keys[-1]] = value
    torch.save(saved, tmp_path / "checkpoint.pt")
    with pytest.raises(InputError, match=words):
        PpoTrainer(SHORT, tmp_path, resume=True)
    assert Policy.load(tmp_path / "checkpoint.pt").settings == POLE


def test_a_training_goes_on_in_its_own_environment(trained: Path, tmp_path: Path) -> None:
    """Another environment or another width is refused by name; the folder stays as it was."""
    shutil.copy(trained / "checkpoint.pt", tmp_path)
    with pytest.raises(InputError, match="env is 'reacher': must be 'cart-pole', as before"):
        PpoTrainer(dataclasses.replace(SHORT, env=dataclasses.replace(POLE, name="reacher")), tmp_path, resume=True)
    with pytest.raises(InputError, match=r"actor.* is a tensor of torch.float32 with shape \(64, 4\): must be .*\(32, 4\)"):
        PpoTrainer(dataclasses.replace(SHORT, width=32), tmp_path, resume=True)
    assert [x.name for x in tmp_path.iterdir()] == ["checkpoint.pt"]
