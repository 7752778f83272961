"""Training: it learns, goes on after interruptions, uses right gradients, and its policies can be tried elsewhere."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from pbfd_torch import InputError, Rollout
from pbfd_torch.envs import Randomization, make_env
from pbfd_torch.learning import curve
from pbfd_torch.learning.checkpoint import load_checkpoint
from pbfd_torch.learning.evaluation import Policy, draw, tried
from pbfd_torch.learning.folder import Folder
from pbfd_torch.learning.ppo import Ppo, PpoTrainer
from pbfd_torch.learning.shac import Shac, ShacTrainer
from pbfd_torch.learning.training_env import EnvSettings, location_and_scale, plain, seen_more, statistics, training_env
from pbfd_torch.learning.worlds import trial_worlds

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:torchrl", "ignore::FutureWarning:torchrl")
POLE = EnvSettings("cart-pole", num_envs=64, seed=3)
QUICK = Ppo(POLE, horizon=16, epochs=10, minibatch=256, learning_rate=1e-3)
SIMULATORS = ("pbfd", "newton-euler", "mujoco")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cart-pole trained for a while."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("training") / "pole"
    PpoTrainer(QUICK, folder).run(25_000)
    return folder


def test_ppo_learns(trained: Path) -> None:
    """The pole stands three times as long after 25 000 steps; curve, picture and checkpoint say the same."""
    rows = curve.load(trained / "curve.csv")
    assert rows[-1].frames == 25_600
    late = [row.mean_return for row in rows[-8:] if row.episodes]
    assert sum(late) / len(late) > 3 * next(row.mean_return for row in rows if row.episodes)
    assert [row.frames for row in rows] == [1024 * (k + 1) for k in range(25)]
    assert all(row.unsolved == 0 for row in rows)
    assert (trained / "curve.png").stat().st_size > 10_000
    saved = load_checkpoint(trained / "checkpoint.pt")
    assert saved["rows"][-1]["frames"] == 25_600
    means = curve.trailing(rows)
    best = max(range(25), key=lambda k: -math.inf if math.isnan(means[k]) else means[k])
    assert load_checkpoint(trained / "best.pt")["rows"][-1]["frames"] == rows[best].frames


@pytest.mark.parametrize("trainer", [PpoTrainer, ShacTrainer])
def test_training_goes_on_where_it_was(tmp_path: Path, trainer: Any) -> None:
    """Resumed: networks, optimiser and statistics are those saved, frames and seconds count on; a folder in use is refused without
    resume, and by the other method."""
    settings: Any = QUICK if trainer is PpoTrainer else Shac(POLE, horizon=8)
    first = trainer(settings, tmp_path)
    first.run(1)
    first.run(first.folder.frames + 1)
    again = trainer(settings, tmp_path, resume=True)
    for name, value in first.actor.state_dict().items():
        torch.testing.assert_close(again.actor.state_dict()[name], value, rtol=0, atol=0)
    torch.testing.assert_close(again.shared["loc"]["observation"], first.shared["loc"]["observation"], rtol=0, atol=0)
    assert again.folder.frames == first.folder.frames
    rows = again.run(again.folder.frames + 1)
    assert len(rows) == 3
    assert rows[-1].seconds > rows[-2].seconds
    with pytest.raises(InputError, match="resume it"):
        trainer(settings, tmp_path)
    with pytest.raises(InputError, match="holds a training by"):
        (ShacTrainer if trainer is PpoTrainer else PpoTrainer)(settings, tmp_path, resume=True)


def test_a_killed_training_is_gone_on_with(tmp_path: Path) -> None:
    """`pbfd train`, killed outright once it has saved, goes on from its last batch with --resume."""
    command = [sys.executable, "-m", "pbfd_torch.cli.main", "train", "cart-pole", "--out", str(tmp_path), "--envs", "8"]
    with subprocess.Popen([*command, "--frames", "10000000"], stderr=subprocess.DEVNULL) as process:
        ends = time.monotonic() + 100
        while not (tmp_path / "curve.png").exists() and time.monotonic() < ends:
            time.sleep(0.2)
        process.send_signal(signal.SIGKILL)
    before = load_checkpoint(tmp_path / "checkpoint.pt")["rows"]
    assert before
    wanted = before[-1]["frames"] + 1
    done = subprocess.run([*command, "--frames", str(wanted), "--resume"], capture_output=True, text=True, check=True)
    assert "written to" in done.stdout
    after = load_checkpoint(tmp_path / "checkpoint.pt")["rows"]
    assert after[: len(before)] == before
    assert len(after) == len(before) + 1


def test_randomised_training(tmp_path: Path) -> None:
    """`pbfd train` with ranges and pushes: the checkpoint says so, and gives the policy's settings back; SHAC refuses."""
    command = [sys.executable, "-m", "pbfd_torch.cli.main", "train", "cart-pole", "--out", str(tmp_path)]
    chances = ["--mass", "0.5", "1.5", "--friction", "0.9", "1", "--push", "2"]
    subprocess.run([*command, "--envs", "4", "--frames", "1", *chances], capture_output=True, text=True, check=True)
    policy = Policy.load(tmp_path / "checkpoint.pt")
    wanted = Randomization(mass=(0.5, 1.5), friction=(0.9, 1.0), push=2.0, push_probability=0.02)
    assert policy.settings.randomization == wanted
    env = policy.settings.make()
    assert env.randomization == wanted
    assert float(env.reset()["state", "world_factors"][:, 0].std()) > 0
    with pytest.raises(InputError, match="it must be None"):
        Shac(policy.settings)


def test_two_processes_collect(tmp_path: Path) -> None:
    """Two workers give batches of twice the size, with statistics that both have added to."""
    trainer = PpoTrainer(dataclasses.replace(QUICK, workers=2), tmp_path)
    seen = trainer.shared["count"]["observation"].clone()
    rows = trainer.run(1)
    assert rows[-1].frames == 2 * 1024
    assert float(trainer.shared["count"]["observation"] - seen) >= 2 * 16


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="no Ray")
def test_two_ray_collectors(tmp_path: Path) -> None:
    """Two remote collectors on this machine give batches of twice the size."""
    rows = PpoTrainer(dataclasses.replace(QUICK, ray=2), tmp_path).run(1)
    assert rows[-1].frames == 2 * 1024


# Gradients ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cart-pole", "hopper"])
def test_gradients_of_the_return_are_right(name: str) -> None:
    """The sum of rewards over five steps by the first action: within 1e-5 of central differences."""
    env = make_env(name, num_envs=2, seed=1)
    state, _ = env.starts(2)
    width = env.action_spec.shape[-1]
    rest = 0.1 * torch.ones(2, width, dtype=torch.float64)

    def total(action: torch.Tensor) -> torch.Tensor:
        now, gain = state, torch.zeros(2, dtype=torch.float64)
        for k in range(5):
            outcome = env.advanced(now, action if k == 0 else rest)
            now = outcome.state
            gain = gain + outcome.reward + outcome.observation.square().sum(-1)
        return gain.sum()

    action = torch.full((2, width), 0.2, dtype=torch.float64, requires_grad=True)
    total(action).backward()
    step = 1e-5
    for k in range(width):
        shift = torch.zeros_like(action)
        shift[1, k] = step
        with torch.no_grad():
            difference = float(total(action + shift) - total(action - shift)) / (2 * step)
        assert action.grad is not None
        assert float(action.grad[1, k]) == pytest.approx(difference, rel=1e-5, abs=1e-6)


def test_shac_learns(tmp_path: Path) -> None:
    """The reacher's cost per step falls by a third within 20 000 steps, and nothing is unsolved."""
    rows = ShacTrainer(Shac(EnvSettings("reacher", num_envs=64, seed=1), horizon=8), tmp_path).run(20_000)
    # all worlds begin anew every 12 batches, so it goes up and down
    assert max(row.reward for row in rows[20:]) > 0.67 * rows[0].reward
    assert all(math.isfinite(row.loss) and row.unsolved == 0 for row in rows)


# Trials ---------------------------------------------------------------------------------------------------------------


def test_what_a_policy_sees_is_what_it_saw(tmp_path: Path) -> None:
    """Location and scale from a checkpoint's statistics are those of torchrl's normaliser, to rounding; both see on alike."""
    shared = statistics(POLE, tmp_path)
    env = training_env(POLE, 0, tmp_path)
    env.rollout(40, break_when_any_done=False)
    env.transform[0].freeze()
    batch = env.rollout(5, break_when_any_done=False)
    loc, scale = location_and_scale(plain(shared))
    torch.testing.assert_close(batch["seen"], (batch["observation"] - loc) / scale, rtol=1e-5, atol=1e-5)
    other = shared.clone()
    observation = torch.ones(64, 4)
    seen_more(other, observation)
    loc_after, _ = location_and_scale(plain(other))
    assert float((loc_after - loc).abs().max()) > 0


def test_policies_on_trial_elsewhere(trained: Path, tmp_path: Path) -> None:
    """A trained policy keeps most of its return on Newton–Euler and MuJoCo; each trial's rollout can be saved and loaded."""
    policy = Policy.load(trained / "checkpoint.pt")
    trials = [tried(policy, policy.settings, on, episodes=8) for on in SIMULATORS]
    for trial in trials:
        assert trial.unsolved == 0
        assert trial.mean > 0.7 * trials[0].mean
        assert trial.rollout.link_names == trials[0].rollout.link_names
        trial.rollout.save(tmp_path / "x.npz")
        assert Rollout.load(tmp_path / "x.npz").scene_name == f"cart-pole, {trial.on}"
    assert [trial.engine for trial in trials] == [make_env("cart-pole").simulator.engine, "torch", "mujoco"]
    assert trials[0].mean > 60
    draw({"pole": trials}, tmp_path / "bars.png")
    assert (tmp_path / "bars.png").stat().st_size > 5000
    again = tried(policy, policy.settings, "pbfd", episodes=8)
    assert again.returns.tolist() == trials[0].returns.tolist()
    with pytest.raises(InputError, match="must be one of pbfd, newton-euler, mujoco"):
        tried(policy, policy.settings, "bullet", episodes=1)


@pytest.mark.parametrize("name", ["hopper", "walker", "hopper-3d", "walker-3d", "reacher", "cart-pole"])
def test_one_motion_is_nearly_the_same_everywhere(name: str) -> None:
    """Joints bent, robots in the air, the same action held: after three control steps PBFD, Newton–Euler and MuJoCo, all in small
    steps, are within 5 % of what has moved: coordinates, signs, gears and files mean the same."""
    control = make_env(name).control_dt
    env = make_env(name, num_envs=2, control_dt=control, dt=control / 10)
    q, v = (x.clone() for x in env.start(2, torch.Generator().manual_seed(7)))
    if name in ("hopper", "walker"):
        q[:, 1], q[:, 3:] = 2.5, -0.3
    elif name.endswith("3d"):
        q[:, 2], q[:, 7:] = 2.5, -0.3
    action = torch.linspace(-0.3, 0.3, env.action_spec.shape[-1], dtype=q.dtype).expand(2, -1)
    ends = []
    for on in SIMULATORS:
        worlds = trial_worlds(on, name, env)
        worlds.start(q, v)
        for _ in range(3):
            end, _, solved = worlds.step(action)
            assert bool(solved.all())
        ends.append(end)
    moved = float((ends[0] - q).abs().max())
    assert moved > 1e-3
    for end in ends[1:]:
        assert float((end - ends[0]).abs().max()) < 0.05 * moved


def test_the_command_evaluates(trained: Path, tmp_path: Path) -> None:
    """`pbfd evaluate` prints JSON with every simulator, and writes picture, numbers and rollouts."""
    command = [
        sys.executable,
        "-m",
        "pbfd_torch.cli.main",
        "evaluate",
        str(trained),
        "--episodes",
        "4",
        "--out",
        str(tmp_path),
        "--json",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    trials = json.loads(done.stdout)["trials"]
    assert [x["on"] for x in trials] == list(SIMULATORS)
    assert all(math.isfinite(x["mean_return"]) for x in trials)
    assert {x.name for x in tmp_path.iterdir()} == {"returns.png", "returns.json", *(f"pole-{on}.npz" for on in SIMULATORS)}


def test_the_trailing_mean_counts_episodes() -> None:
    """Over the last four episodes or more, batches without any left out; NaN before the first."""
    rows = [
        curve.Row(k, 0.0, n, mean, mean, mean, 1.0, 0.0, 0.0, 0.0)
        for k, (n, mean) in enumerate(((0, math.nan), (2, 1.0), (3, 6.0)))
    ]
    rows += [dataclasses.replace(rows[0], frames=4), dataclasses.replace(rows[1], episodes=1, mean_return=10.0)]
    found = curve.trailing(rows, episodes=4)
    assert math.isnan(found[0])
    assert found[1:] == [1.0, 4.0, 4.0, 7.0]


def test_the_best_checkpoint_is_the_one_that_was_measured(tmp_path: Path) -> None:
    """A batch in which no episode ends, or worse ones do, leaves the best checkpoint alone."""
    folder = Folder(tmp_path, "PPO", "pole", resume=False)
    for frames, episodes, mean in ((1, 0, math.nan), (2, 64, 5.0), (3, 0, math.nan), (4, 64, 4.0), (5, 64, 6.0), (6, 0, math.nan)):
        folder.rows.append(curve.Row(frames, 1.0, episodes, mean, mean, mean, 1.0, 0.0, 0.0, 0.0))
        folder.write({"env": dataclasses.asdict(POLE), "width": 64}, {})
        assert (tmp_path / "best.pt").exists() == (frames > 1)
        if frames > 1:
            assert load_checkpoint(tmp_path / "best.pt")["rows"][-1]["frames"] == (2 if frames < 5 else 5)


def test_what_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    """Missing, foreign, damaged, and one that would run code."""
    with pytest.raises(InputError, match="no checkpoint at"):
        load_checkpoint(tmp_path / "none.pt")
    torch.save({"format": "other"}, tmp_path / "other.pt")
    with pytest.raises(InputError, match="has format 'other'"):
        load_checkpoint(tmp_path / "other.pt")
    (tmp_path / "damaged.pt").write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(InputError, match="not a readable checkpoint"):
        load_checkpoint(tmp_path / "damaged.pt")
    torch.save({"format": "x", "run": print}, tmp_path / "code.pt")
    with pytest.raises(InputError, match="not a readable checkpoint"):
        load_checkpoint(tmp_path / "code.pt")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Ppo(POLE, width=10**9), "width is 1000000000: must be an integer from 1 to 4096"),
        (lambda: EnvSettings("hopper", num_envs=0), "num_envs is 0"),
        (lambda: EnvSettings("hopper", seed=-1), "seed is -1"),
        (lambda: EnvSettings("hopper", control_dt=math.inf), r"control_dt \[s\] is inf"),
        (lambda: EnvSettings("hopper", max_episode_steps=0), "max_episode_steps is 0"),
        (lambda: Ppo(POLE, horizon=0), "horizon is 0"),
        (lambda: Ppo(POLE, workers=2, ray=2), "give one of the two"),
        (lambda: Ppo(POLE, gamma=1.0), "gamma is 1.0"),
        (lambda: Shac(POLE, epochs=0), "epochs is 0"),
        (lambda: EnvSettings("ant").make(), "no environment named 'ant'"),
    ],
)
def test_bad_settings_are_refused(make: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()
