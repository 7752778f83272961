"""How often a step stays unsolved, and what a step costs: named scenes × time steps, each from many random starts.

    python benchmarks/unsolved_steps.py --out unsolved.json

The starts are scattered around the scene's own, see `pbfd_torch.bench.starts`. Robots are driven by random controls, new ones every
step. Prints a table in Markdown: evaluations of the residual per step (mean, 95th percentile, largest), how many steps a fallback
solved, how many none did, and the largest residual; and the same as JSON.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from pbfd_torch import Simulator, Status
from pbfd_torch.bench.starts import scattered
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES

NAMES = ("box-slide", "chain-fixed", "chain-ground", "chain-slope", "chain-slope-drop", "chain-heavy", "hopper", "walker")
STEPS = (0.002, 0.01, 0.02, 0.05, 0.1)


def measured(name: str, dt: float, integrator: str, worlds: int, dtype: torch.dtype, bend: float, speed: float) -> dict[str, Any]:
    """One scene at one step."""
    setup = SCENES[name](worlds=worlds, dtype=dtype)
    q, v = scattered(setup, 0, bend, speed)
    steps = round((1.0 if dt < 0.01 else 2.0) / dt)
    random = torch.Generator().manual_seed(1)
    controls = 2 * torch.rand(steps, worlds, setup.scene.nu, dtype=torch.float64, generator=random) - 1
    simulator = Simulator(setup.scene, dt, INTEGRATORS[integrator]())
    started = time.perf_counter()
    state = simulator.initial_state(q, v, controls[0].to(dtype))
    solutions = []
    for control in controls.to(dtype):
        state, solution = simulator.step(state, control)
        solutions.append(solution)
    wall = time.perf_counter() - started
    evaluations = torch.stack([s.evaluations for s in solutions]).double().flatten()
    status = torch.bincount(torch.stack([s.status for s in solutions]).flatten(), minlength=len(Status)).tolist()
    spent = sum(s.lanes for s in solutions)
    return {
        "scene": name,
        "dt": dt,
        "integrator": integrator,
        "dtype": str(dtype).removeprefix("torch."),
        "steps": steps * worlds,
        "evaluations_mean": float(evaluations.mean()),
        "evaluations_p95": float(evaluations.quantile(0.95)),
        "evaluations_max": int(evaluations.max()),
        "status": {s.name.lower(): status[s] for s in Status},
        "unsolved": sum(status[Status.STALLED :]),
        "residual_max": max(float(s.residual_norm.max()) for s in solutions),
        "lane_utilisation": float(evaluations.sum()) / spent,
        "wall_s": wall,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=NAMES, choices=NAMES)
    parser.add_argument("--dt", nargs="+", type=float, default=STEPS)
    parser.add_argument("--integrator", default="energy-momentum", choices=tuple(INTEGRATORS))
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--dtype", choices=("float64", "float32"), default="float64")
    parser.add_argument("--bend", type=float, default=0.3, help="[rad]")
    parser.add_argument("--speed", type=float, default=1.0, help="[rad/s, m/s]")
    parser.add_argument("--out", type=Path, default=Path("unsolved_steps.json"))
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    print("| scene | Δt | evaluations mean / p95 / max | warm-started, continued, eased, halved | unsolved | largest residual |")
    print("|---|---|---|---|---|---|", flush=True)
    for name, dt in tqdm([(n, d) for n in chosen.scenes for d in chosen.dt], disable=None):
        row = measured(name, dt, chosen.integrator, chosen.worlds, getattr(torch, chosen.dtype), chosen.bend, chosen.speed)
        rows.append(row)
        s = row["status"]
        helped = f"{s['warm_started']}, {s['continued']}, {s['eased']}, {s['halved']}"
        cost = f"{row['evaluations_mean']:.2f} / {row['evaluations_p95']:.0f} / {row['evaluations_max']}"
        print(
            f"| {name} | {dt} | {cost} | {helped} | {row['unsolved']} of {row['steps']} | {row['residual_max']:.1e} |", flush=True
        )
        chosen.out.write_text(json.dumps({"worlds": chosen.worlds, "bend": chosen.bend, "speed": chosen.speed, "rows": rows}))


if __name__ == "__main__":
    main()
