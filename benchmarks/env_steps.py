"""Environment steps per second of the hopper at several numbers of worlds, beside Gymnasium's with MuJoCo in the same run, and the
share of the time that is spent outside of Simulator.step. Random actions; worlds that fall are reset. One thread.

    python benchmarks/env_steps.py [--seconds 4]

Error beside speed: the fraction of unsolved steps."""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium
import torch

from pbfd_torch.envs import HopperEnv
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler


def ours(worlds: int, dtype: torch.dtype, integrator: Any, seconds: float) -> str:
    env = HopperEnv(num_envs=worlds, dtype=dtype, seed=0, integrator=integrator)
    inside, step = 0.0, env.simulator.step

    def timed(*arguments: Any) -> Any:
        nonlocal inside
        begin = time.perf_counter()
        result = step(*arguments)
        inside += time.perf_counter() - begin
        return result

    env.simulator.step = timed  # type: ignore[method-assign]
    torch.manual_seed(0)
    now, steps, unsolved, resets = env.reset(), 0, 0.0, 0.0
    inside, begin, resetting = 0.0, time.perf_counter(), 0.0
    while time.perf_counter() - begin < seconds or steps < 2:
        now = env.rand_action(now)
        end = env.step(now)["next"]
        unsolved += float(end["unsolved"].float().mean())
        resets += float(end["done"].float().mean())
        now, mark = end.exclude("reward"), time.perf_counter()
        if bool(end["done"].any()):
            now["_reset"] = end["done"]
            now = env.reset(now)
        resetting += time.perf_counter() - mark
        steps += 1
    wall = time.perf_counter() - begin
    name = f"pbfd_torch {type(integrator).__name__}, {str(dtype)[6:]}"
    other = 1 - (inside + resetting) / wall
    return row(name, worlds, steps * worlds / wall, f"{other:.1%}", f"{resetting / wall:.1%}", f"{unsolved / steps:.2%}")


def mujoco(worlds: int, seconds: float) -> str:
    env = gymnasium.make_vec("Hopper-v5", num_envs=worlds, vectorization_mode="sync")
    env.reset(seed=0)
    env.action_space.seed(0)
    steps, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds or steps < 2:
        env.step(env.action_space.sample())
        steps += 1
    return row("Gymnasium Hopper-v5 (MuJoCo)", worlds, steps * worlds / (time.perf_counter() - begin), "", "", "")


def row(*cells: Any) -> str:
    return "| " + " | ".join(f"{x:.0f}" if isinstance(x, float) else str(x) for x in cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=4.0, help="for each row")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64, 1024])
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| environment | worlds | steps/s | time outside Simulator.step and resets | resets | unsolved |")
    print("|---|---|---|---|---|---|")
    for worlds in options.worlds:
        for dtype in (torch.float64, torch.float32):
            for integrator in (EnergyMomentum(), ImplicitEuler()):
                print(ours(worlds, dtype, integrator, options.seconds), flush=True)
        print(mujoco(worlds, options.seconds), flush=True)


if __name__ == "__main__":
    main()
