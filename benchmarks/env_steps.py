"""Environment steps a second at several numbers of worlds, beside Gymnasium's environment with MuJoCo in the same run, with errors.

Random actions, worlds that end are reset; one thread, eager. "outside": the share of the time spent neither in steps of the
simulator nor in resets. The error is how far the torso is from where the same simulator takes it with steps 8 times shorter, after
.24 s of falling, landing and pushing under one held action: each against itself, because the two have different contacts.

    python benchmarks/env_steps.py [hopper | walker] [--seconds 4] [--worlds 1 64 1024]"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from torch import Tensor
from torchrl.envs.utils import step_mdp

from pbfd_torch.envs import make_env
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler

PEERS = {"hopper": "Hopper-v5", "walker": "Walker2d-v5"}
HELD, TIME, FINER = -0.2, 0.24, 8  # action, [s], times


def ours(name: str, worlds: int, dtype: torch.dtype, integrator: Any, seconds: float, error: float) -> str:
    env = make_env(name, num_envs=worlds, dtype=dtype, seed=0, integrator=integrator)
    inside, step = 0.0, env.simulator.step

    def timed(*arguments: Any) -> Any:
        nonlocal inside
        begin = time.perf_counter()
        result = step(*arguments)
        inside += time.perf_counter() - begin
        return result

    env.simulator.step = timed  # type: ignore[method-assign]
    torch.manual_seed(0)
    now, steps, unsolved, resetting = env.reset(), 0, 0, 0.0
    inside, begin = 0.0, time.perf_counter()
    while time.perf_counter() - begin < seconds or steps < 2:
        end = env.step(env.rand_action(now))["next"]
        unsolved += int(end["unsolved"].sum())
        now, mark = end.exclude("reward"), time.perf_counter()
        if bool(end["done"].any()):
            now = env.reset(now.set("_reset", end["done"]))
            resetting += time.perf_counter() - mark
        steps += 1
    wall = time.perf_counter() - begin
    kind = f"pbfd_torch {type(integrator).__name__}, {str(dtype)[6:]}"
    shares = f"{1 - (inside + resetting) / wall:.1%}", f"{resetting / wall:.1%}"
    return row(kind, worlds, steps * worlds / wall, *shares, f"{unsolved / (steps * worlds):.2%}", f"{1e3 * error:.2f} mm")


def theirs(name: str, worlds: int, seconds: float, error: float) -> str:
    env = gymnasium.make_vec(PEERS[name], num_envs=worlds, vectorization_mode="sync")
    env.reset(seed=0)
    env.action_space.seed(0)
    steps, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds or steps < 2:
        env.step(env.action_space.sample())
        steps += 1
    rate = steps * worlds / (time.perf_counter() - begin)
    return row(f"Gymnasium {PEERS[name]} (MuJoCo)", worlds, rate, "", "", "", f"{1e3 * error:.2f} mm")


def our_place(name: str, dtype: torch.dtype, integrator: Any, finer: int) -> Tensor:
    env = make_env(name, dtype=dtype, dt=0.008 / finer, integrator=integrator)
    now = env.set_state(env.setup.q, torch.zeros_like(env.setup.v))
    for _ in range(round(TIME / env.control_dt)):
        now = step_mdp(env.step(now.set("action", torch.full(env.action_spec.shape, HELD))))
    return now["state", "q"][0, :2].double()


def their_place(name: str, finer: int) -> Tensor:
    env: Any = gymnasium.make(PEERS[name]).unwrapped
    env.reset(seed=0)
    env.set_state(env.init_qpos, np.zeros_like(env.init_qvel))
    env.model.opt.timestep /= finer
    env.data.ctrl[:] = HELD
    mujoco.mj_step(env.model, env.data, round(TIME / env.model.opt.timestep))
    return torch.tensor(env.data.qpos[:2])


def row(*cells: Any) -> str:
    return "| " + " | ".join(f"{x:.0f}" if isinstance(x, float) else str(x) for x in cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", nargs="?", default="hopper", choices=PEERS)
    parser.add_argument("--seconds", type=float, default=4.0, help="for each row")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64, 1024])
    options = parser.parse_args()
    torch.set_num_threads(1)
    name = options.name
    kinds = [(dtype, scheme) for dtype in (torch.float64, torch.float32) for scheme in (EnergyMomentum(), ImplicitEuler())]
    exact = our_place(name, torch.float64, EnergyMomentum(), FINER)
    errors = [float((our_place(name, *kind, 1) - exact).norm()) for kind in kinds]
    error = float((their_place(name, 1) - their_place(name, FINER)).norm())
    print("| environment | worlds | steps/s | outside | resets | unsolved | error |\n|---|---|---|---|---|---|---|")
    for worlds in options.worlds:
        for kind, off in zip(kinds, errors, strict=True):
            print(ours(name, worlds, *kind, options.seconds, off), flush=True)
        print(theirs(name, worlds, options.seconds, error), flush=True)


if __name__ == "__main__":
    main()
