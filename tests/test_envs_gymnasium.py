"""Environments as Gymnasium and other libraries' agents see them."""

from __future__ import annotations

import importlib.util
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from pbfd_torch.envs import ENVIRONMENTS, HopperEnv, make_env
from pbfd_torch.envs.gymnasium_envs import IDS, PREFIX, register


def test_every_environment_is_registered_once() -> None:
    register()  # twice is no error
    assert set(IDS.values()) == set(ENVIRONMENTS)
    assert {f"{PREFIX}/{name}" for name in IDS} <= set(gymnasium.registry)


@pytest.mark.parametrize("name", IDS)
@pytest.mark.filterwarnings("ignore:.*WARN.*")  # Gymnasium's advice on unbounded observations
def test_gymnasiums_own_check(name: str) -> None:
    check_env(gymnasium.make(f"{PREFIX}/{name}").unwrapped, skip_render_check=True)


def test_one_world_is_that_of_torchrl() -> None:
    """The same seed and actions give the same observations, rewards and ends, to the bit."""
    plain, env = gymnasium.make(f"{PREFIX}/Hopper-v0"), HopperEnv(num_envs=1)
    observation, _ = plain.reset(seed=11)
    env.set_seed(11)
    now = env.reset()
    random = np.random.default_rng(0)
    for _ in range(12):
        np.testing.assert_array_equal(observation, now["observation"][0].numpy())
        action = random.uniform(-1, 1, 3).astype(np.float32)
        observation, reward, terminated, truncated, info = plain.step(action)
        after = env.step(now.set("action", torch.from_numpy(action)[None]))["next"]
        assert (reward, terminated, truncated) == (float(after["reward"]), bool(after["terminated"]), bool(after["truncated"]))
        assert info["unsolved"] == bool(after["unsolved"])
        now = after.exclude("reward")


def test_a_vector_is_so_many_worlds_and_resets_what_has_ended() -> None:
    """Random torques fell hoppers at different times; the step after an end gives a new start, no reward, and no end."""
    env = gymnasium.make_vec(f"{PREFIX}/Hopper-v0", num_envs=6)
    observation, _ = env.reset(seed=2)
    assert observation.shape == (6, 11)
    assert observation.dtype == np.float32
    random = np.random.default_rng(1)
    before, ends = np.zeros(6, bool), 0
    for _ in range(40):
        observation, reward, terminated, truncated, info = env.step(random.uniform(-1, 1, (6, 3)).astype(np.float32))
        assert np.isfinite(observation).all()
        assert observation.shape == (6, 11)
        assert info["unsolved"].shape == (6,)
        np.testing.assert_array_equal(reward[before], 0)
        np.testing.assert_allclose(observation[before, 0], 1.25, atol=6e-3)
        assert not terminated[before].any()
        before = terminated | truncated
        ends += int(before.sum())
    assert ends > 6


def test_the_time_limit_truncates() -> None:
    env = gymnasium.make(f"{PREFIX}/Reacher-v0", max_episode_steps=None)
    env.reset(seed=0)
    ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(100)]
    assert ends[:99] == [(False, False)] * 99
    assert ends[99] == (False, True)


def test_observation_action_and_time_step_of_hopper_and_walker_are_gymnasiums() -> None:
    """Against Gymnasium's own v5 environments: spaces, control step, first observation and its noise."""
    pytest.importorskip("mujoco")
    for ours, theirs in (("Hopper-v0", "Hopper-v5"), ("Walker-v0", "Walker2d-v5")):
        mine: Any = gymnasium.make(f"{PREFIX}/{ours}").unwrapped
        peer: Any = gymnasium.make(theirs).unwrapped
        assert mine.observation_space.shape == peer.observation_space.shape
        np.testing.assert_array_equal(mine.action_space.low, peer.action_space.low)
        np.testing.assert_array_equal(mine.action_space.high, peer.action_space.high)
        assert make_env(IDS[ours]).control_dt == pytest.approx(peer.dt)
        first, other = mine.reset(seed=0)[0], peer.reset(seed=0)[0]
        np.testing.assert_allclose(first, other, atol=1e-2 + 1e-6)
        centre = np.zeros_like(first)
        centre[0] = 1.25
        assert 1e-4 < np.abs(first - centre).max() <= 5e-3 + 1e-6


@pytest.mark.parametrize(("ours", "theirs"), [("hopper", "Hopper-v5"), ("walker", "Walker2d-v5")])
def test_reward_and_health_of_hopper_and_walker_are_gymnasiums(ours: str, theirs: str) -> None:
    """The same states and actions are fed to both definitions: 200 random ones, many of them on either side of each limit."""
    pytest.importorskip("mujoco")
    from pbfd_torch.envs import Step

    env, peer = make_env(ours), gymnasium.make(theirs).unwrapped
    nq = env.scene.articulation.nq
    random = np.random.default_rng(3)
    kinds = set()
    for _ in range(200):
        q, v = random.normal(0, 0.3, nq), random.normal(0, 4, nq)
        q[1] = random.uniform(0.5, 2.2)
        q[2] *= 2 if ours == "walker" else 0.5
        moved, action = random.normal(0, 0.01), random.uniform(-1, 1, env.scene.nu)
        peer.set_state(q, v)  # type: ignore[attr-defined]
        wanted, _ = peer._get_rew(moved / 0.008, action)  # type: ignore[attr-defined]
        before = torch.tensor(q)[None].clone()
        before[:, 0] -= moved
        step = Step(before, torch.tensor(q)[None], torch.tensor(v)[None], torch.tensor(action)[None], 0.008)
        assert float(env.reward(step)) == pytest.approx(wanted, abs=1e-9)
        healthy = bool(env.healthy(step.q, step.v))
        assert healthy == bool(peer.is_healthy)  # type: ignore[attr-defined]
        np.testing.assert_allclose(env.observe(step.q, step.v)[0], peer._get_obs(), atol=1e-12)  # type: ignore[attr-defined]
        kinds.add(healthy)
    assert kinds == {True, False}


@pytest.mark.skipif(importlib.util.find_spec("stable_baselines3") is None, reason="no Stable-Baselines3")
def test_an_agent_of_another_library_learns() -> None:
    """Stable-Baselines3's PPO holds the pole up three times as long after 10 000 steps as before."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    def length(agent: PPO) -> float:
        trial = Monitor(gymnasium.make(f"{PREFIX}/CartPole-v0"))
        mean, _ = evaluate_policy(agent, trial, n_eval_episodes=3, deterministic=True)
        return float(np.mean(mean))

    env = gymnasium.make(f"{PREFIX}/CartPole-v0")
    agent = PPO("MlpPolicy", env, n_steps=512, seed=0, device="cpu", learning_rate=1e-3)
    before = length(agent)
    agent.learn(10_000)
    assert agent.num_timesteps >= 10_000
    assert length(agent) > 3 * before
