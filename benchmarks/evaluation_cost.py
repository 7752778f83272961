"""Cost of one residual + exact Jacobian + linear solve: free chain of ten links, 20 contact points, float64, one thread.

    python -m benchmarks.evaluation_cost [--json]

Beside the time stands the error of what was computed: the Jacobian against central differences, and the linear solve's residual.
Then what a round of the solver and a whole step would ask of a device: kernels launched, waits, and copies from and to the host.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.models import SCENES
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.tree.kinematics import retract
from tests.make_believe_device import DEVICE, Tally, make_believe, values

ON_DEVICE = ("hopper", "chain-ground", "stack", "robot-arm")
STEPS = 4
VIEWS = (
    "view",
    "expand",
    "unsqueeze",
    "squeeze",
    "slice",
    "select",
    "transpose",
    "as_strided",
    "unbind",
    "diagonal",
    "detach",
    "alias",
)


class CountOperations(TorchDispatchMode):
    """Counts torch operations, views apart from those that compute."""

    def __init__(self) -> None:
        super().__init__()
        self.computing = self.views = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if any(name in str(function) for name in VIEWS):
            self.views += 1
        else:
            self.computing += 1
        return function(*args, **(kwargs or {}))


def problem(worlds: int) -> tuple[BalanceObjective, Tensor]:
    """A step of the chain lying on the ground, bent at random, all points within reach of it."""
    setup = SCENES["chain-ground"](worlds)
    articulation = setup.scene.articulation
    simulator = Simulator(setup.scene, 0.02)
    q = articulation.rest.expand(worlds, -1).clone()
    q[:, 2] = 0.0195
    generator = torch.Generator().manual_seed(0)
    q[:, 7:] = 0.01 * torch.randn(worlds, 9, generator=generator, dtype=q.dtype)
    return simulator.objective(simulator.initial_state(q, setup.v)), q


def evaluate_and_solve(objective: BalanceObjective, q: Tensor) -> Tensor:
    balance = objective.evaluate(q)
    return torch.linalg.solve_ex(balance.jacobian, -balance.residual)[0]


def jacobian_error(objective: BalanceObjective, q: Tensor, h: float = 1e-7) -> float:
    """Relative difference of the exact Jacobian's hinge columns from central differences."""
    balance = objective.evaluate(q)
    articulation = objective.articulation
    columns = []
    for axis in torch.eye(articulation.nv, dtype=q.dtype):
        step = (h * axis).expand(*q.shape[:-1], -1)
        ends = [objective.evaluate(retract(articulation, q, sign * step)).residual for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * h))
    gap = torch.stack(columns, -1) - balance.jacobian
    return float(gap[..., 6:].abs().max() / balance.jacobian.abs().max())


def measure(worlds: int, repeats: int) -> dict[str, float]:
    objective, q = problem(worlds)
    with torch.no_grad():
        for _ in range(3):
            step = evaluate_and_solve(objective, q)
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            evaluate_and_solve(objective, q)
            times.append(time.perf_counter() - start)
        balance = objective.evaluate(q)
        leftover = (balance.jacobian @ step[..., None]).squeeze(-1) + balance.residual
        with CountOperations() as count:
            evaluate_and_solve(objective, q)
        return {
            "worlds": worlds,
            "us_per_world_median": 1e6 * statistics.median(times) / worlds,
            "us_per_world_best": 1e6 * min(times) / worlds,
            "operations": count.computing,
            "views": count.views,
            "solve_residual": float(leftover.abs().max() / balance.residual.abs().max()),
            "jacobian_error": jacobian_error(objective, q),
        }


def asked(tally: Tally, times: int) -> dict[str, float]:
    """Launches, waits and copies, each time on average."""
    return {
        "launches": tally.launches / times,
        "waits": tally.waits.total() / times,
        "copies": tally.copies.total() / times,
    }


def asked_of_device(scene: str) -> dict[str, Any]:
    """What the second round of a step and whole steps of 10 ms ask of a device, three steps after the start of three worlds."""
    with torch.no_grad(), make_believe():
        setup = SCENES[scene](3, device=DEVICE)
        simulator = Simulator(setup.scene, 0.01)
        state = simulator.initial_state(setup.q, setup.v)
        for _ in range(3):
            state, _ = simulator.step(state)
        solver, objective = Descent(), simulator.objective(state)
        progress = solver.advance(objective, solver.begin(objective, objective.guess, state.q))
        with make_believe() as of_round:
            solver.advance(objective, progress)
        rounds = 0
        with make_believe() as of_steps:
            for _ in range(STEPS):
                state, solution = simulator.step(state)
                rounds += int(values(solution.evaluations).amax())
    return {"scene": scene, "rounds": rounds / STEPS, "round": asked(of_round, 1), "step": asked(of_steps, STEPS)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    as_json = parser.parse_args().json
    torch.set_num_threads(1)
    rows = [measure(1, 300), measure(256, 20), measure(1024, 10)]
    device = [asked_of_device(scene) for scene in ON_DEVICE]
    if as_json:
        print(json.dumps({"evaluation": rows, "device": device}))
        return
    print("worlds   µs/world median   best   operations (views)   solve residual   Jacobian error")
    for r in rows:
        print(
            f"{r['worlds']:6.0f} {r['us_per_world_median']:17.1f} {r['us_per_world_best']:6.1f}"
            f" {r['operations']:11.0f} ({r['views']:.0f}) {r['solve_residual']:18.1e} {r['jacobian_error']:16.1e}"
        )
    print("\nof a device    round: launches  waits  copies    step: rounds  launches  waits  copies")
    for d in device:
        a, b = d["round"], d["step"]
        print(
            f"{d['scene']:14} {a['launches']:15.0f} {a['waits']:6.1f} {a['copies']:7.1f}"
            f" {d['rounds']:15.1f} {b['launches']:9.0f} {b['waits']:6.1f} {b['copies']:7.1f}"
        )


if __name__ == "__main__":
    main()
