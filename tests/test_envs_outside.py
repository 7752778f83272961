"""Environments in other libraries' hands: masks, seeds for each world, actions that are none, and copies in other processes."""

from __future__ import annotations

import functools
import multiprocessing
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AsyncVectorEnv

from pbfd_torch import InputError
from pbfd_torch.envs import ENVIRONMENTS, PbfdEnv, Randomization, make_env
from pbfd_torch.envs.gymnasium_envs import PREFIX

POLE = f"{PREFIX}/CartPole-v0"
WORLDS = 4
CHANCES = Randomization(mass=(0.8, 1.2), push=5.0, push_probability=0.5)


def vector(**arguments: Any) -> Any:
    return gymnasium.make_vec(POLE, num_envs=WORLDS, **arguments)


def pushed(env: Any, steps: int = 3, first: int = 0) -> list[np.ndarray[Any, Any]]:
    """Observations of steps under pushes that differ between worlds."""
    shape = env.action_space.shape
    return [env.step(np.random.default_rng(first + k).uniform(-1, 1, shape).astype(np.float32))[0] for k in range(steps)]


def test_a_mask_resets_its_worlds_only() -> None:
    """The others go on to the bit as if nothing had been reset, and those of the mask start anew."""
    env, other = vector(), vector()
    for one in (env, other):
        one.reset(seed=3)
        pushed(one)
    mask = np.array([True, False, False, True])
    before = other._now["observation"].numpy().copy()
    after, _ = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], before[~mask])
    assert (np.abs(after[mask]) <= 0.05).all()
    assert (after[mask] != before[mask]).all()
    assert env._now["state", "steps"].squeeze(-1).tolist() == [0, 3, 3, 0]
    for mine, theirs in zip(pushed(env, 4, 10), pushed(other, 4, 10), strict=True):
        np.testing.assert_array_equal(mine[~mask], theirs[~mask])


def test_a_masked_world_that_has_ended_is_not_reset_again() -> None:
    """Its next step is one of the new episode."""
    env = vector(max_episode_steps=2)
    env.reset(seed=0)
    pushed(env, 2)
    assert env._ended.all()
    env.reset(options={"reset_mask": np.array([True, True, False, False])})
    env.step(np.zeros((WORLDS, 1), np.float32))
    assert env._now["state", "steps"].squeeze(-1).tolist() == [1, 1, 0, 0]


@pytest.mark.parametrize("mask", [[1, 0, 0, 0], np.zeros(3, bool), np.zeros((4, 1), bool), "all", np.zeros(4)])
def test_a_wrong_mask_is_refused(mask: Any) -> None:
    env = vector()
    with pytest.raises(InputError, match="all of them must be reset first"):
        env.reset(options={"reset_mask": np.array([True, False, False, False])})
    env.reset(seed=0)
    with pytest.raises(InputError, match=r"reset_mask is of .*: must be of bool with shape \(4,\)"):
        env.reset(options={"reset_mask": mask})


@pytest.mark.parametrize("randomization", [None, CHANCES], ids=["plain", "randomised"])
def test_a_seed_for_each_world(randomization: Randomization | None) -> None:
    """What a world starts from, draws and is pushed by follows from its own seed, wherever it stands, whatever others do; lists,
    tuples and arrays mean the same."""
    seeds = [7, 8, 9, 10]
    env, turned = vector(randomization=randomization), vector(randomization=randomization)
    mine, _ = env.reset(seed=seeds)
    theirs, _ = turned.reset(seed=np.array(seeds[::-1]))
    np.testing.assert_array_equal(mine, theirs[::-1])
    assert len(np.unique(mine[:, 0])) == WORLDS
    again, _ = env.reset(options={"reset_mask": np.array([True, False, True, False])})
    for _ in range(2):  # its second start follows from its seed as well, and so do the pushes between
        env.step(np.zeros((WORLDS, 1), np.float32))
    fresh, _ = env.reset(seed=tuple(seeds))
    np.testing.assert_array_equal(fresh, mine)
    second, _ = env.reset(options={"reset_mask": np.array([True, False, True, False])})
    np.testing.assert_array_equal(second, again)
    for _ in range(2):
        env.step(np.zeros((WORLDS, 1), np.float32))
    state = env._now["state"]
    env.reset(seed=seeds[::-1])
    env.reset(options={"reset_mask": np.array([False, True, False, True])})
    for _ in range(2):
        env.step(np.zeros((WORLDS, 1), np.float32))
    for name, value in state.items():
        torch.testing.assert_close(env._now["state", name].flip(0), value, rtol=1e-12, atol=1e-12)


def test_no_seed_for_a_world_leaves_its_sequence() -> None:
    env, other = vector(), vector()
    for one in (env, other):
        one.reset(seed=[1, 2, 3, 4])
    first, _ = env.reset(seed=[None, 20, None, 40])
    plain, _ = other.reset()
    np.testing.assert_array_equal(first[[0, 2]], plain[[0, 2]])
    assert (first[[1, 3]] != plain[[1, 3]]).all()


def test_one_seed_of_any_library() -> None:
    """A numpy integer is one; it ends the seeds for each world."""
    env = vector()
    plain, _ = env.reset(seed=5)
    env.reset(seed=[1, 2, 3, 4])
    for seed in (np.int64(5), np.uint8(5)):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], plain)
    single: Any = gymnasium.make(POLE)
    np.testing.assert_array_equal(single.reset(seed=np.int32(5))[0], single.reset(seed=5)[0])


@pytest.mark.parametrize("seed", [-1, 1.5, "one", True, 2**64, [1, 2, 3], [1, 2, 3, -4], [1, 2, 3, "x"], np.zeros(4)])
def test_a_wrong_seed_is_refused(seed: Any) -> None:
    with pytest.raises(InputError, match=r"seed (is|has) .*must be"):
        vector().reset(seed=seed)
    if not isinstance(seed, list | np.ndarray):
        with pytest.raises(InputError, match=r"seed is .*must be an integer from 0"):
            gymnasium.make(POLE).unwrapped.reset(seed=seed)
        with pytest.raises(InputError, match="seed is"):
            make_env("cart-pole", seed=seed)


@pytest.mark.parametrize("one", [True, False], ids=["one world", "vector"])
def test_actions_that_are_none(one: bool) -> None:
    """Before the first reset, of another shape, of no numbers: `InputError` that says what they must be; the world does not
    notice."""
    env: Any = gymnasium.make(POLE).unwrapped if one else vector()
    shape = env.action_space.shape
    with pytest.raises(InputError, match="step before the first reset"):
        env.step(np.zeros(shape, np.float32))
    env.reset(seed=0)
    for action, words in (
        (np.zeros((7, 7), np.float32), r"action has shape \(7, 7\): must be"),
        (np.float32(0), r"action has shape \(\): must be"),
        (np.zeros(shape, complex), "action is of complex128: must be of numbers"),
        (np.full(shape, "left"), "must be of numbers"),
        (None, "must be of numbers"),
        ([[1], [1, 2]], "must be an array of shape"),
    ):
        with pytest.raises(InputError, match=words):
            env.step(action)
    observation = env.step(np.full(shape, 1e300))[0]
    assert np.isfinite(observation).all()


def test_an_action_with_nan_ends_its_world_only() -> None:
    """As in the batch that torchrl sees: flagged, and finite."""
    env, other = vector(), vector()
    for one in (env, other):
        one.reset(seed=1)
    actions = np.full((WORLDS, 1), 0.5, np.float32)
    plain = other.step(actions)[0]
    actions[2] = np.nan
    observation, reward, terminated, _, info = env.step(actions)
    assert terminated.tolist() == info["unsolved"].tolist() == [False, False, True, False]
    assert np.isfinite(observation).all()
    assert reward[2] == 0
    np.testing.assert_array_equal(observation[[0, 1, 3]], plain[[0, 1, 3]])


def test_a_tensordict_that_cannot_be_stepped_from() -> None:
    env = make_env("cart-pole", num_envs=2)
    now = env.reset()
    with pytest.raises(InputError, match="without 'action'"):
        env._step(now)
    with pytest.raises(InputError, match="without 'state'"):
        env._step(now.exclude("state"))
    with pytest.raises(InputError, match=r"action is torch.int64: must be floating-point"):
        env._step(now.set("action", torch.zeros(2, 1, dtype=torch.int64)))


@pytest.mark.parametrize("arguments", [{"num_envs": 10**11}, {"num_envs": 2.5}, {"control_dt": 0.0}, {"dt": float("nan")}])
def test_arguments_out_of_range(arguments: dict[str, Any]) -> None:
    (name,) = arguments
    with pytest.raises(InputError, match=f"{name} is .*: must be"):
        make_env("cart-pole", **arguments)


# Copies -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_pickled_environment_goes_on_to_the_bit(name: str) -> None:
    """Steps, resets and the random numbers of both."""
    env: PbfdEnv = make_env(name, num_envs=2, randomization=CHANCES if name == "cart-pole" else None)
    now = env.reset()
    copy = pickle.loads(pickle.dumps(env))
    action = torch.full(env.action_spec.shape, 0.3)
    for one in (env, copy):
        after = one.step(now.clone().set("action", action))["next"]
        fresh = one.reset()
        kept = (after["observation"], fresh["observation"], fresh["state"])
        if one is env:
            wanted = kept
    for mine, theirs in zip(wanted, kept, strict=True):
        assert bool((mine == theirs).all())


def _gone_on(env: Any) -> list[np.ndarray[Any, Any]]:
    return [*pushed(env), env.reset()[0]]


def test_a_copy_in_another_process_goes_on_to_the_bit() -> None:
    """A vector under way, in a process that has been started anew."""
    env = vector(randomization=CHANCES)
    env.reset(seed=[1, 2, 3, 4])
    pushed(env)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        theirs = pool.apply(_gone_on, (env,))
    for mine, other in zip(_gone_on(env), theirs, strict=True):
        np.testing.assert_array_equal(mine, other)


def _made() -> Any:
    import pbfd_torch.envs  # noqa: F401  (registers)

    return gymnasium.make(POLE)


def _given(env: Any) -> Any:
    return env


def test_gymnasiums_own_processes() -> None:
    """`AsyncVectorEnv` with processes that are started anew: made there, and sent there."""
    ready = gymnasium.make(POLE)
    env = AsyncVectorEnv([_made, functools.partial(_given, ready)], context="spawn")
    try:
        env.reset(seed=[4, 5])
        first = env.step(np.zeros((2, 1), np.float32))[0]
    finally:
        env.close()
    for seed, row in zip((4, 5), first, strict=True):
        ready.reset(seed=seed)
        np.testing.assert_array_equal(ready.step(np.zeros(1, np.float32))[0], row)
