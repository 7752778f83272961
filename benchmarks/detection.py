"""Time and memory of detection in the scene `robot-arm`: from link poses to the candidates of a step, per world.

python benchmarks/detection.py
"""

from __future__ import annotations

import argparse
import time

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from pbfd_torch.contact.polytope_pairs import PolytopePairs
from pbfd_torch.models import SCENES
from pbfd_torch.simulator import Simulator
from pbfd_torch.terms.body_contact import BodyContact


class _Largest(TorchDispatchMode):
    """Remembers the bytes of the tensors that operations make, all of them and the largest."""

    def __init__(self) -> None:
        super().__init__()
        self.largest = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN204
        result = function(*args, **(kwargs or {}))
        for x in result if isinstance(result, tuple | list) else (result,):
            if isinstance(x, torch.Tensor):
                self.largest = max(self.largest, x.numel() * x.element_size())
        return result


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
        setup = SCENES["robot-arm"](worlds=1)
        simulator = Simulator(setup.scene, chosen.dt)
        state = simulator.initial_state(setup.q, setup.v, setup.controls(1)[0])
        unsolved = 0
        for _ in range(chosen.steps):
            state, solution = simulator.step(state, setup.controls(1)[0])
            unsolved += int((~solution.solved).sum())
        some = SCENES["robot-arm"](worlds=worlds)
        simulator = Simulator(some.scene, chosen.dt)
        state = simulator.initial_state(state.q.expand(worlds, -1).contiguous(), simulator.integrator.velocity(
            setup.scene.articulation, state, simulator.step_size).expand(worlds, -1).contiguous(), some.controls(1)[0])  # fmt: skip
        objective = simulator.objective(state, some.controls(1)[0])
        contacts = [x for x in some.scene.terms if isinstance(x, BodyContact)]
        prepared = [p for t, p in zip(objective.terms, objective.prepared, strict=True) if isinstance(t, BodyContact)]

        def detect(contacts=contacts, prepared=prepared) -> None:  # type: ignore[no-untyped-def] # noqa: ANN001
            for contact, p in zip(contacts, prepared, strict=True):
                contact.finder.find(p.bodies, p.reach)

        with _Largest() as memory:
            detect()
        best = min(_timed(detect) for _ in range(5))
        whole = min(_timed(lambda: simulator.step(state, some.controls(1)[0])) for _ in range(2))
        pairs = sum(len(x.finder.pair) for x in contacts if isinstance(x.finder, PolytopePairs))
        filled = sum(float(p.slots.filled.sum()) for p in prepared) / worlds
        kilobytes = memory.largest / worlds / 1024
        print(
            f"{worlds:6d} | {pairs:5d} | {1e6 * best / worlds:20.0f} | {best / whole:15.0%} | {kilobytes:25.0f} | {filled:20.1f} | {unsolved}"
        )


def _timed(call) -> float:  # type: ignore[no-untyped-def] # noqa: ANN001
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


if __name__ == "__main__":
    main()
