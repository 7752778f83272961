"""What derivatives cost beside the simulation that they are of, with their errors: the chain that lands on the ground.

    python benchmarks/gradients.py                       # time against error, MuJoCo's finite differences in the same run
    python benchmarks/gradients.py --memory 1024 1000    # a rollout of so many worlds and steps, with its peak memory

The derivative is that of where the chain ends by its start velocity, along a random direction: the error is against central
differences of the simulation itself, which is solved to rounding. MuJoCo (extra `bench`) has `mjd_transitionFD`, one forward
difference of a step by every coordinate; its error is that of one step against central differences of its own. Over the whole fall
the chain is chaotic: no difference is small enough, so the error is that of the parts.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pbfd_torch import Fallbacks, Simulator
from pbfd_torch.bench.starts import scattered
from pbfd_torch.integrators.integrator import State
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES
from pbfd_torch.tensors.structures import mapped_tensors, tensors_of
from pbfd_torch.tensors.worlds import Worlds, replaced

DT = 0.02
PHASES = {"whole": (0, 100), "landing": (12, 20), "lying": (90, 20)}  # steps before it, steps of it


PRECISE = Fallbacks.within(1e-13)  # to rounding, for differences


def moved(state: Any, direction: Tensor, h: float) -> Any:
    """The state with another velocity."""
    return replaced(state, v=state.v + h * direction) if hasattr(state, "v") else _moved_back(state, direction, h)


def _moved_back(state: Any, direction: Tensor, h: float) -> Any:
    """The state of a scheme on positions: the last one a step further back."""
    q = state.q_previous.clone()
    return replaced(state, q_previous=q - h * DT * torch.cat((direction[..., :3], 0 * q[..., :4], direction[..., 6:]), -1))


def path_end(simulator: Simulator[Any], state: State, steps: int) -> Tensor:
    """A number for each world."""
    return simulator.trajectory(state, steps=steps).q[-1].square().sum(-1)


def measured(name: str, phase: str, worlds: int, rounds: int) -> dict[str, float]:
    """The shortest times of `rounds`, and the error of the first world's derivative."""
    before, steps = PHASES[phase]
    setup = SCENES["chain-ground"](worlds=worlds)
    simulator = Simulator(setup.scene, DT, INTEGRATORS[name]())
    q, v = scattered(setup, 0, 0.05, 0.2) if worlds > 1 else (setup.q, setup.v)
    state = simulator.initial_state(q, v)
    for _ in range(before):
        state, _ = simulator.step(state)
    direction = torch.randn(setup.v.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    direction[:, 3:6] *= torch.tensor([0.0, 1.0, 0.0])
    plain, held, back = [], [], []
    for _ in range(rounds):
        with torch.no_grad():
            plain.append(_timed(lambda: path_end(simulator, state, steps))[1])
        h = torch.zeros((), dtype=torch.float64, requires_grad=True)
        end, spent = _timed(lambda: path_end(simulator, moved(state, direction, h), steps))  # noqa: B023
        held.append(spent)
        back.append(_timed(lambda: torch.autograd.grad(end.sum(), h)[0])[1])  # noqa: B023
    first = state.take(Worlds((worlds,), torch.zeros(1, dtype=torch.long)))
    strict = Simulator(SCENES["chain-ground"]().scene, DT, INTEGRATORS[name](), PRECISE)
    probes = [float(path_end(strict, moved(first, direction[:1], s * 1e-6), steps)) for s in (1, -1)]
    h = torch.zeros((), dtype=torch.float64, requires_grad=True)
    exact = float(torch.autograd.grad(path_end(strict, moved(first, direction[:1], h), steps)[0], h)[0])
    differences = (probes[0] - probes[1]) / 2e-6
    forward = min(plain)
    return {
        "forward_ms": 1e3 * forward / steps,
        "extra": max(0.0, (min(held) - forward) / forward),
        "backward": min(back) / forward,
        "error": abs(exact - differences) / max(abs(differences), 1e-3),
    }


def _timed(call: Callable[[], Tensor]) -> tuple[Tensor, float]:
    began = time.perf_counter()
    result = call()
    return result, time.perf_counter() - began


def mujoco_rows() -> None:
    """MuJoCo's step and its finite differences, one world."""
    try:
        import mujoco
    except ImportError:
        print("MuJoCo is not installed: pip install '.[bench]'")
        return
    from pbfd_torch.bench.mujoco_runs import loaded

    for dt in (0.001, 0.002):
        model = loaded("chain-ground", dt, "implicitfast")
        for phase, seconds in (("landing", 0.3), ("lying", 1.8)):
            data = mujoco.MjData(model)
            for _ in range(round(seconds / dt)):
                mujoco.mj_step(model, data)
            q, v = data.qpos.copy(), data.qvel.copy()
            nx = 2 * model.nv
            A, steps = np.zeros((nx, nx)), 50
            spent = {"step": float("inf"), "differences": float("inf")}
            for _ in range(5):
                for what in spent:
                    began = time.perf_counter()
                    for _ in range(steps):
                        if what == "step":
                            mujoco.mj_step(model, data)
                        else:
                            mujoco.mjd_transitionFD(model, data, 1e-6, False, A, None, None, None)
                    spent[what] = min(spent[what], (time.perf_counter() - began) / steps)
                    data.qpos, data.qvel = q, v
            direction = np.random.default_rng(0).standard_normal(model.nv)
            data.qpos, data.qvel = q, v
            mujoco.mjd_transitionFD(model, data, 1e-6, False, A, None, None, None)
            found = A[model.nv :, model.nv :] @ direction
            ends = []
            for sign in (1, -1):
                data.qpos, data.qvel = q, v + sign * 1e-5 * direction
                mujoco.mj_step(model, data)
                ends.append(data.qvel.copy())
            exact = (ends[0] - ends[1]) / 2e-5
            error = np.abs(found - exact).max() / np.abs(exact).max()
            ratio = spent["differences"] / spent["step"]
            name = f"MuJoCo implicitfast, {1e3 * dt:g} ms"
            print(f"{name:29s} | {phase:8s} | {1:6d} | {1e3 * spent['step']:9.3f} | {'':10s} | {ratio:15.2f} | {error:.1e}")


def remembered(worlds: int, steps: int, checkpoint: int) -> None:
    """A rollout that carries derivatives, from the chain at rest on the ground, and its peak memory."""
    setup = SCENES["chain-ground"]()
    single = Simulator(setup.scene, DT)
    state = single.initial_state(setup.q, setup.v)
    for _ in range(90):
        state, _ = single.step(state)
    many = SCENES["chain-ground"](worlds=worlds)
    simulator = Simulator(many.scene, DT)
    state = mapped_tensors(state, lambda x: x.expand(worlds, *x.shape[1:]).clone())
    size = sum(x.numel() * x.element_size() for x in tensors_of(state)) / worlds
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    v = state.v.clone().requires_grad_()
    began = time.perf_counter()
    path = simulator.trajectory(replaced(state, v=v), steps=steps, checkpoint=checkpoint)
    forward = time.perf_counter() - began
    (by_v,) = torch.autograd.grad(path.q[-1].square().sum(), v)
    backward = time.perf_counter() - began - forward
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    kept = 1024**2 * (peak - base) / worlds / steps
    print(f"{worlds} worlds × {steps} steps, checkpoints every {checkpoint}: peak {peak:.0f} MiB, {base:.0f} before")
    print(f"{kept:.0f} bytes a step and world, where a state has {size:.0f}; forward {forward:.0f} s, derivative {backward:.0f} s")
    print(f"the derivative is finite: {bool(torch.isfinite(by_v).all())}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, nargs="+", default=(1, 256))
    parser.add_argument("--integrators", nargs="+", default=("energy-momentum", "implicit-euler"), choices=tuple(INTEGRATORS))
    parser.add_argument("--phases", nargs="+", default=tuple(PHASES), choices=tuple(PHASES))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--memory", type=int, nargs=2, metavar=("WORLDS", "STEPS"))
    parser.add_argument("--checkpoint", type=int, default=1)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    if chosen.memory:
        remembered(*chosen.memory, chosen.checkpoint)
        return
    print(f"chain-ground, 20 contact points, Δt {DT} s, float64, one thread, eager; times beside the simulation's own")
    print("simulator                     | phase    | worlds | step [ms] | taping     | derivative      | its error")
    for name in chosen.integrators:
        for phase in chosen.phases:
            for worlds in chosen.worlds:
                r = measured(name, phase, worlds, chosen.rounds if worlds == 1 else 1)
                error = "chaotic" if phase == "whole" else f"{r['error']:.1e}"
                print(
                    f"pbfd_torch {name:18s} | {phase:8s} | {worlds:6d} | {r['forward_ms']:9.2f} | {r['extra']:10.2f} |"
                    f" {r['backward']:15.2f} | {error}",
                    flush=True,
                )
    mujoco_rows()


if __name__ == "__main__":
    main()
