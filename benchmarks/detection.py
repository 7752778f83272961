"""Time and memory of detection in the scene `robot-arm`: from link poses to the candidates of a step, per world.

python benchmarks/detection.py
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from pbfd_torch.contact.polytope_pairs import PolytopePairs
from pbfd_torch.models import SCENES
from pbfd_torch.simulator import Simulator
from pbfd_torch.terms.body_contact import BodyContact, PreparedBodyContact


class LargestTensor(TorchDispatchMode):
    """Remembers the bytes of the largest tensor that an operation makes."""

    def __init__(self) -> None:
        super().__init__()
        self.size = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        for x in result if isinstance(result, tuple | list) else (result,):
            if isinstance(x, torch.Tensor):
                self.size = max(self.size, x.numel() * x.element_size())
        return result


def timed(call: Callable[[], object]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def row(worlds: int, dt: float, steps: int) -> str:
    setup = SCENES["robot-arm"](worlds=1)
    control = setup.controls(1)[0]
    simulator = Simulator(setup.scene, dt)
    state = simulator.initial_state(setup.q, setup.v, control)
    unsolved = 0
    for _ in range(steps):
        state, solution = simulator.step(state, control)
        unsolved += int((~solution.solved).sum())
    velocity = simulator.integrator.velocity(setup.scene.articulation, state, simulator.step_size)
    many = simulator.initial_state(state.q.expand(worlds, -1), velocity.expand(worlds, -1), control.expand(worlds, -1))
    objective = simulator.objective(many, control.expand(worlds, -1))
    found: list[tuple[BodyContact, PreparedBodyContact]] = [
        (term, prepared)
        for term, prepared in zip(objective.terms, objective.prepared, strict=True)
        if isinstance(term, BodyContact)
    ]

    def detect() -> None:
        for contact, prepared in found:
            contact.finder.find(prepared.bodies, prepared.reach)

    with LargestTensor() as largest:
        detect()
    best = min(timed(detect) for _ in range(5))
    whole = min(timed(lambda: simulator.step(many, control.expand(worlds, -1))) for _ in range(2))
    pairs = sum(len(x.finder.pair) for x, _ in found if isinstance(x.finder, PolytopePairs))
    filled = sum(float(p.slots.filled.sum()) for _, p in found) / worlds
    microseconds, kilobytes = 1e6 * best / worlds, largest.size / worlds / 1024
    numbers = f"{worlds:6d} | {pairs:5d} | {microseconds:20.0f} | {best / whole:15.0%}"
    return f"{numbers} | {kilobytes:25.0f} | {filled:20.1f} | {unsolved}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64, 1024])
    parser.add_argument("--dt", type=float, default=0.01)
    parser.add_argument("--steps", type=int, default=20, help="simulated before detection is timed, so that things touch")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    print(f"robot-arm, Δt {chosen.dt} s, one thread, float64")
    print("worlds | pairs | detection µs a world | share of a step | largest tensor kB a world | filled slots a world | unsolved")
    for worlds in chosen.worlds:
        print(row(worlds, chosen.dt, chosen.steps))


if __name__ == "__main__":
    main()
