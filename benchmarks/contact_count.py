"""Fig. 6c: time of a step against the number of contact points of each link, on the chain that slides down a slope, with its error.

python benchmarks/contact_count.py --worlds 256
"""

from __future__ import annotations

import argparse
import time

import torch

from pbfd_torch.models.chains import chain_slope
from pbfd_torch.simulator import Simulator

POINTS = (2, 4, 8, 16, 32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--dt", type=float, default=0.05)
    parser.add_argument("--steps", type=int, default=10, help="per round; the least time of all rounds counts")
    parser.add_argument("--rounds", type=int, default=5)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    setups = [chain_slope(chosen.worlds, points=n) for n in POINTS]
    simulators = [Simulator(x.scene, chosen.dt) for x in setups]
    states = [s.initial_state(x.q, x.v) for s, x in zip(simulators, setups, strict=True)]
    best = [float("inf")] * len(POINTS)
    evaluations = [0.0] * len(POINTS)
    for _ in range(chosen.rounds):  # in turn, so that a busy machine is unfair to none
        for k, simulator in enumerate(simulators):
            started = time.perf_counter()
            for _ in range(chosen.steps):
                states[k], solution = simulator.step(states[k])
                evaluations[k] += float(solution.evaluations.double().mean()) / chosen.steps / chosen.rounds
            best[k] = min(best[k], (time.perf_counter() - started) / chosen.steps)
    print(f"chain-slope, {chosen.worlds} worlds, Δt {chosen.dt} s, eager, one thread, float64")
    print("points a link | ms a step | ratio to 2 | evaluations a step | error of the distance slid")
    duration = chosen.dt * chosen.steps * chosen.rounds
    for k, (n, setup) in enumerate(zip(POINTS, setups, strict=True)):
        moved = float(states[k].q[0, 0] - setup.q[0, 0])
        down = setup.scene.gravity
        slide = float(down[0]) - 0.3 * -float(down[2])
        error = moved / (0.5 * slide * duration**2) - 1
        print(f"{n:13d} | {1e3 * best[k]:9.2f} | {best[k] / best[0]:10.2f} | {evaluations[k]:18.2f} | {error:.1e}")


if __name__ == "__main__":
    main()
