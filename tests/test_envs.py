"""Environments as torchrl sees them: specs, seeds, batches, partial resets, transforms, bad actions, randomisation."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import RewardSum, StepCounter, TransformedEnv
from torchrl.envs.transforms import Compose, VecNormV2
from torchrl.envs.utils import check_env_specs

from pbfd_torch.balance.dynamics import center_of_mass
from pbfd_torch.envs import ENVIRONMENTS, HopperEnv, PbfdEnv, Randomization, make_env
from pbfd_torch.errors import InputError, ModelError
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.tree.kinematics import place

DTYPES = (torch.float64, torch.float32)


def actions(env: PbfdEnv, steps: int, seed: int = 0, size: float = 1.0) -> Tensor:
    """`[steps, worlds, nu]`, uniform within ±size."""
    generator = torch.Generator().manual_seed(seed)
    return size * (2 * torch.rand(steps, *env.action_spec.shape, generator=generator) - 1)


def played(env: Any, held: Tensor, start: Any = None) -> Any:
    """A rollout `[worlds, steps]` under given actions; worlds that end are reset."""
    given = iter(held)

    def policy(tensordict: Any) -> Any:
        return tensordict.set("action", next(given))

    return env.rollout(len(held), policy, break_when_any_done=False, auto_reset=start is None, tensordict=start)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_specs(name: str, dtype: torch.dtype) -> None:
    """torchrl's own check; observations are float32 whatever the simulation's type."""
    env = make_env(name, num_envs=2, dtype=dtype)
    check_env_specs(env)
    start = env.reset()
    assert start["observation"].dtype == torch.float32
    assert start["state", "q"].dtype == dtype
    assert start.batch_size == torch.Size([2])


def test_accuracy_instead_of_a_step() -> None:
    """Worlds choose their own steps: nearer to fine steps than the control step is, of the same kind of state from the start on."""
    env = HopperEnv(num_envs=3, accuracy=1e-5, control_dt=0.02, seed=1)
    check_env_specs(env)
    held, ends = actions(env, 10, size=0.3), []
    start = HopperEnv(num_envs=3, control_dt=0.02, seed=1).reset()["state", "q"]
    v = torch.zeros(3, 6, dtype=torch.float64)
    choices: tuple[dict[str, Any], ...] = ({"accuracy": 1e-5}, {"dt": 0.02}, {"dt": 0.02 / 128})
    for choice in choices:
        env = HopperEnv(num_envs=3, control_dt=0.02, integrator=EnergyMomentum(), seed=1, **choice)
        ends.append(played(env, held, env.set_state(start, v))["next", "state", "q"][:, -1])
    ours, coarse, fine = ends
    assert float((ours - fine).abs().max()) < 0.5 * float((coarse - fine).abs().max())


def test_accuracy_or_a_step() -> None:
    with pytest.raises(InputError, match=r"^dt is 0.004 s and accuracy 0.0001 m: only one of them may be given$"):
        HopperEnv(accuracy=1e-4, dt=0.004)


def test_importing_the_library_does_not_import_torchrl() -> None:
    code = "import sys, pbfd_torch; assert not {'torchrl', 'tensordict', 'gymnasium'} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode == 0


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_seed_gives_the_same_episode_again(name: str) -> None:
    """Bit by bit, in a new environment and after seeding anew; another seed starts elsewhere."""
    env, other = make_env(name, num_envs=3, seed=5), make_env(name, num_envs=3, seed=5)
    held = actions(env, 4)
    first = played(env, held)["next", "observation"]
    torch.testing.assert_close(played(other, held)["next", "observation"], first, rtol=0, atol=0)
    env.set_seed(5)
    torch.testing.assert_close(played(env, held)["next", "observation"], first, rtol=0, atol=0)
    assert not bool((make_env(name, num_envs=3, seed=6).reset()["observation"] == other.reset()["observation"]).all(0).all())


@pytest.mark.parametrize("integrator", [ImplicitEuler(), EnergyMomentum()])
def test_a_batch_is_so_many_single_worlds(integrator: Integrator[Any]) -> None:
    """The hopper falls onto its foot: 25 steps from the same starts, alone and together."""
    many, one = (HopperEnv(num_envs=n, integrator=integrator, max_episode_steps=100) for n in (4, 1))
    start = many.reset()
    held = actions(many, 25, size=0.2)
    together = played(many, held, start.clone())["state", "q"]
    for k in range(4):
        alone = played(one, held[:, k : k + 1], start[k : k + 1].clone())["state", "q"]
        torch.testing.assert_close(alone[0], together[k], rtol=0, atol=1e-9)


def test_reset_touches_only_the_rows_that_are_asked_for() -> None:
    env = HopperEnv(num_envs=4)
    last = env.step(env.reset().set("action", actions(env, 1)[0]))["next"].exclude("reward")
    mask = torch.tensor([False, True, False, True])[:, None]
    after = env.reset(last.clone().set("_reset", mask))
    for key in ("observation", "done", "terminated", ("state", "q"), ("state", "time"), ("state", "steps")):
        kept = after[key][~mask[:, 0]]
        torch.testing.assert_close(kept, last[key][~mask[:, 0]], rtol=0, atol=0)
    assert after["state", "steps"].flatten().tolist() == [1, 0, 1, 0]
    assert after["state", "time"][mask[:, 0]].tolist() == [0.0, 0.0]
    assert bool((after["state", "q"][1] != last["state", "q"][1]).any())


def test_worlds_that_end_are_reset_in_a_rollout_and_the_others_are_not() -> None:
    """One world is put on its side: it ends at once, and goes on from a new start, while the other one's time runs on."""
    env = HopperEnv(num_envs=2)
    q = env.setup.q.expand(2, -1).clone()
    q[0, 2] = 0.5
    start = env.set_state(q, torch.zeros_like(q))
    seen = played(env, actions(env, 3, size=0.1), start)
    assert seen["next", "terminated"][0].flatten().tolist() == [True, False, False]
    assert seen["next", "terminated"][1].flatten().tolist() == [False, False, False]
    torch.testing.assert_close(seen["state", "time"][0], torch.tensor([0.0, 0.0, 0.008], dtype=torch.float64))
    torch.testing.assert_close(seen["state", "time"][1], torch.tensor([0.0, 0.008, 0.016], dtype=torch.float64))
    assert abs(float(seen["state", "q"][0, 1, 2])) < 0.01


def test_truncation_is_not_termination() -> None:
    env = HopperEnv(num_envs=2, max_episode_steps=3)
    seen = played(env, actions(env, 4, size=0.0))
    assert seen["next", "truncated"][..., 0].tolist() == [[False, False, True, False]] * 2
    assert not bool(seen["next", "terminated"].any())
    torch.testing.assert_close(seen["next", "done"], seen["next", "truncated"])


def test_any_tensordict_can_be_gone_on_from() -> None:
    """The environment remembers nothing: a step made again from an old tensordict is the same to the bit."""
    env = HopperEnv(num_envs=3)
    seen = played(env, actions(env, 6))
    again = env.step(seen[:, 2].exclude("next").clone())["next"]
    for key in ("observation", "reward", ("state", "q")):
        torch.testing.assert_close(again[key], seen["next", key][:, 2], rtol=0, atol=0)


def bent(env: PbfdEnv) -> Tensor:
    """Hoppers in the air with joints within their limits, `[worlds, 6]`."""
    q = env.setup.q.expand(*env.batch_size, -1).clone()
    q[:, 1] += 1.0
    q[:, 3:5] -= 0.5 + 0.1 * torch.arange(len(q), dtype=q.dtype)[:, None]
    return q


def test_set_state_puts_worlds_there() -> None:
    env = HopperEnv(num_envs=2, integrator=EnergyMomentum())  # whose velocity is that of the time itself
    q = bent(env)
    v = 0.1 * torch.ones_like(q)
    start = env.set_state(q, v)
    torch.testing.assert_close(start["observation"], torch.cat((q[:, 1:], v), -1).float(), rtol=1e-5, atol=1e-5)
    with pytest.raises(InputError, match=r"q has shape \(1, 6\): must be \(2, 6\)"):
        env.set_state(q[:1], v)
    with pytest.raises(InputError, match="NaN"):
        env.set_state(q.log(), v)


def test_a_free_fall_is_a_free_fall() -> None:
    """A hopper one metre up falls by ½ g t² exactly, the start being of second order, and is not rewarded for moving."""
    env = HopperEnv(num_envs=1)
    q, steps = bent(env), 25
    seen = played(env, actions(env, steps, size=0.0), env.set_state(q, torch.zeros_like(q)))
    start, end = (center_of_mass(place(env.scene.articulation, x))[2] for x in (q[0], seen["next", "state", "q"][0, -1]))
    torch.testing.assert_close(start - end, torch.tensor(0.5 * 9.81 * (steps * 0.008) ** 2, dtype=torch.float64), rtol=1e-7, atol=0)
    torch.testing.assert_close(seen["next", "reward"], torch.ones_like(seen["next", "reward"]), rtol=0, atol=1e-6)


def test_forward_reward_is_the_mean_velocity_of_the_step() -> None:
    env = HopperEnv(num_envs=1)
    q, v = env.setup.q.clone(), torch.zeros_like(env.setup.q)
    q[:, 1] += 0.5
    v[:, 0] = 1.5
    held = torch.full((1, 1, 3), 0.5)
    seen = played(env, held, env.set_state(q, v))
    moved = float(seen["next", "state", "q"][0, 0, 0] - q[0, 0])
    assert float(seen["next", "reward"]) == pytest.approx(moved / 0.008 + 1 - 1e-3 * 3 * 0.25, abs=1e-5)


def test_transforms() -> None:
    """Step counter, reward sum and running normalisation, over worlds that end and are reset."""
    env = TransformedEnv(HopperEnv(num_envs=8), Compose(StepCounter(), RewardSum(), VecNormV2(["observation"])))
    check_env_specs(env)
    seen = env.rollout(60, break_when_any_done=False)
    ended = seen["next", "done"][..., 0]
    assert bool(ended.any())
    world, step = (int(x[0]) for x in ended.nonzero(as_tuple=True))
    assert int(seen["next", "step_count"][world, step]) == step + 1
    assert int(seen["next", "step_count"][world, step + 1]) == 1
    summed = seen["next", "reward"][world, : step + 1].sum()
    torch.testing.assert_close(seen["next", "episode_reward"][world, step, 0], summed, rtol=1e-5, atol=1e-5)
    assert bool(torch.isfinite(seen["observation"]).all())
    assert float(seen["observation"][:, 30:].mean().abs()) < 1.5


# bad actions ---------------------------------------------------------------------------------------------------------


def test_actions_out_of_range_are_clipped() -> None:
    env = HopperEnv(num_envs=2)
    start = env.reset()
    far, near = (env.step(start.clone().set("action", torch.full((2, 3), x)))["next"] for x in (7.0, 1.0))
    torch.testing.assert_close(far["state", "q"], near["state", "q"], rtol=0, atol=0)
    torch.testing.assert_close(far["reward"], near["reward"], rtol=0, atol=0)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_one_bad_action_ends_its_own_world_at_most(bad: float) -> None:
    """NaN ends the episode with a flag; infinity counts as the end of the range; observations stay finite, others do not notice."""
    env = HopperEnv(num_envs=2)
    start, held = env.reset(), actions(env, 1)[0]
    good = env.step(start.clone().set("action", held))["next"]
    held[0, 1] = bad
    after = env.step(start.clone().set("action", held))["next"]
    assert after["unsolved"].flatten().tolist() == [bad != bad, False]
    assert after["terminated"].flatten().tolist() == [bad != bad, False]
    assert bool(torch.isfinite(after["observation"]).all())
    assert bool(torch.isfinite(after["reward"]).all())
    torch.testing.assert_close(after["state", "q"][1], good["state", "q"][1], rtol=0, atol=1e-9)


def test_actions_of_another_shape_are_refused() -> None:
    env = HopperEnv(num_envs=2)
    step = env.reset().to_dict() | {"action": torch.zeros(2, 4)}
    with pytest.raises(InputError, match=r"action has shape \(2, 4\): must be \(2, 3\)"):
        env._step(TensorDict(step, [2]))


def test_an_unsolved_world_ends_with_a_flag_and_finite_numbers() -> None:
    """A solver that may evaluate once only solves nothing that touches the ground."""
    env = HopperEnv(num_envs=3)
    env.simulator = Simulator(env.scene, env.dt, ImplicitEuler(), Descent(max_evaluations=1), halvings=0)
    after = env.step(env.reset().set("action", actions(env, 1)[0]))["next"]
    assert bool(after["unsolved"].all())
    assert bool(after["terminated"].all())
    assert not bool(after["truncated"].any())
    assert bool(torch.isfinite(after["observation"]).all())
    assert float(after["reward"].abs().max()) == 0


# arguments -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"num_envs": 0}, "num_envs is 0: must be from 1 to"),
        ({"dt": 0.003}, "dt is 0.003 s: must divide the control step, 0.008 s"),
        ({"max_episode_steps": 0}, "max_episode_steps is 0: must be ≥ 1"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        HopperEnv(**arguments)


def test_half_precision_is_refused() -> None:
    with pytest.raises(ModelError, match=r"must be torch\.float32 or torch\.float64"):
        HopperEnv(dtype=torch.float16)


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InputError, match="no environment named 'fly': must be one of hopper, walker"):
        make_env("fly")


def test_smaller_steps_than_the_control_step() -> None:
    """Four steps of 2 ms under one action come near one step of 8 ms, in the air."""
    coarse, fine = (HopperEnv(num_envs=1, dt=dt, integrator=EnergyMomentum()) for dt in (None, 0.002))
    q = bent(coarse)
    ends = []
    for env in (coarse, fine):
        start = env.set_state(q, torch.zeros_like(q))
        ends.append(env.step(start.set("action", torch.full((1, 3), 0.3)))["next"])
    assert (coarse.substeps, fine.substeps) == (1, 4)
    torch.testing.assert_close(ends[0]["state", "time"], ends[1]["state", "time"])
    torch.testing.assert_close(ends[0]["state", "q"], ends[1]["state", "q"], rtol=0, atol=2e-4)


# randomisation -------------------------------------------------------------------------------------------------------


def test_randomisation_changes_what_it_names_and_is_kept_for_the_episode() -> None:
    env = HopperEnv(num_envs=64, randomization=Randomization((0.5, 2.0), (0.3, 1.0), (0.9, 1.1)))
    check_env_specs(env)
    seen = played(env, actions(env, 3, size=0.1))
    factors = seen["state", "world_factors"]
    for k, (low, high) in enumerate(((0.5, 2.0), (0.3, 1.0), (0.9, 1.1))):
        assert low <= float(factors[..., k].min()) < float(factors[..., k].max()) <= high
    torch.testing.assert_close(factors[:, 0], factors[:, 2], rtol=0, atol=0)
    scene = env._of(dict(seen["state"][:, 0].items())).scene
    torch.testing.assert_close(scene.articulation.mass, env.scene.articulation.mass * factors[:, 0, :1])


def test_twice_the_gain_is_twice_the_torque() -> None:
    strong, plain = (HopperEnv(num_envs=1, randomization=Randomization(gain=(x, x))) for x in (2.0, 1.0))
    q = plain.setup.q.clone()
    q[:, 1] += 0.5
    ends = []
    for env, size in ((strong, 0.2), (plain, 0.4)):
        step = env.set_state(q, torch.zeros_like(q)).set("action", torch.full((1, 3), size))
        ends.append(env.step(step)["next", "state", "q"])
    torch.testing.assert_close(ends[0], ends[1], rtol=0, atol=1e-9)


def test_a_push_pushes_by_force_over_mass() -> None:
    """In the air the centre of mass gains F Δt/m a step: implicit Euler moves it by F Δt²/m · n (n + 1)/2 in n steps."""
    env = HopperEnv(num_envs=2, randomization=Randomization(push=40.0, push_probability=0.0))
    q = env.setup.q.expand(2, -1).clone()
    q[:, 1] += 1.0
    start = env.set_state(q, torch.zeros_like(q))
    start["state", "world_push"][0, 0] = 40.0
    seen = played(env, actions(env, 10, size=0.0), start)
    com = center_of_mass(place(env.scene.articulation, seen["next", "state", "q"][:, -1]))[:, 0]
    moved = 40.0 * 0.008**2 * 55 / env.scene.articulation.mass.sum()
    torch.testing.assert_close(com[0] - com[1], moved, rtol=2e-3, atol=0)


def test_pushes_begin_and_end() -> None:
    env = HopperEnv(num_envs=32, randomization=Randomization(push=30.0, push_probability=0.5))
    push = played(env, actions(env, 5, size=0.1))["state", "world_push"]
    sizes = torch.linalg.vector_norm(push, dim=-1)
    assert set(sizes.round(decimals=6).flatten().tolist()) == {0.0, 30.0}
    assert float(push[..., 1:].abs().max()) < 1e-12
    assert (push[..., 0].min(), push[..., 0].max()) == (-30.0, 30.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"mass": (0.0, 1.0)}, "mass range"),
        ({"friction": (1.0, 0.5)}, "friction range"),
        ({"gain": (1.0, float("inf"))}, "gain range"),
        ({"push": -1.0}, "push is -1.0 N"),
        ({"push_probability": 1.5}, "push_probability is 1.5"),
    ],
)
def test_bad_ranges(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Randomization(**arguments)


def test_a_foot_that_sticks_is_found_in_float32() -> None:
    """Two steps of a hopper that pushes off, in which the foot slips at the start of a direction and sticks 1e-5 of it further on:
    solved the direct way in float32 too, and there within 1.5 mm and mrad of float64's end."""
    before = [
        [5.946944e-03, 1.230572581, 7.738652639e-03, 9.609882254e-04, 2.717711031e-04, 1.680854410e-01],
        [8.227091283e-02, 1.260704160, 8.117239177e-02, 5.372703308e-04, -9.938505292e-02, 6.550372839e-01],
    ]
    now = [
        [9.321433492e-03, 1.232172608, 1.113993116e-02, 1.027087099e-03, -4.704860505e-03, 2.120026499e-01],
        [8.709133416e-02, 1.257790089, 8.610339463e-02, 7.983435644e-04, -1.050269976e-01, 6.627528667e-01],
    ]
    push = [[7.900460958e-01, -1.466383785e-01, 3.196732104e-01], [-2.545027733e-01, -4.702630341e-01, 2.304562628e-01]]
    ends = {}
    for dtype in (torch.float64, torch.float32):
        env = HopperEnv(num_envs=2, dtype=dtype)
        state, _ = env.starts(2)
        q, q_previous, action = (torch.tensor(x, dtype=dtype) for x in (now, before, push))
        end, solution = env.simulator.step(replaced(state, q=q, q_previous=q_previous), action)
        assert solution.status.tolist() == [0, 0]
        ends[dtype] = end.q.double()
    torch.testing.assert_close(ends[torch.float32], ends[torch.float64], rtol=0, atol=1.5e-3)
