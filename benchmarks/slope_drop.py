"""Scene chain-slope-drop: speed beside error, ours and MuJoCo's in one run, one thread, float64.

    python benchmarks/slope_drop.py [--duration 5] [--json]

Error: the Coulomb margin (0: friction as Coulomb's law has it, < 0: too much), the deepest penetration, the largest gain of energy.
Speed: wall milliseconds per simulated second of one world. MuJoCo gets spheres of the chain's radius where our chain has points
with a skin of that radius.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from typing import Any

import mujoco
import numpy as np
import torch

from pbfd_torch.bench.mujoco_runs import loaded
from pbfd_torch.models import SCENES, chains
from pbfd_torch.simulator import Simulator


def ours(dt: float, worlds: int, duration: float) -> dict[str, Any]:
    setup = SCENES["chain-slope-drop"](worlds=worlds)
    simulator = Simulator(setup.scene, dt)
    state = simulator.initial_state(setup.q, setup.v)
    simulator.rollout(state, steps=1)  # what is made once is made
    start = time.perf_counter()
    rollout = simulator.rollout(state, steps=round(duration / dt))
    wall = time.perf_counter() - start
    margin = setup.metrics(rollout)["coulomb_margin_m"]
    assert isinstance(margin, list)
    return {
        "simulator": "pbfd_torch",
        "worlds": worlds,
        "dt": dt,
        "margin_m": margin[0],
        "penetration_mm": 1e3 * float(rollout.penetration.max()),
        "energy_gain_J": float((rollout.energy[1:] - setup.scene.energy(setup.q, setup.v)).max()),
        "unsolved": int((~rollout.solved).sum()),
        "ms_per_s": 1e3 * wall / duration / worlds,
    }


def theirs(dt: float, integrator: str, duration: float) -> dict[str, Any]:
    model = loaded("chain-slope-drop", dt, integrator)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    first, start_energy = data.subtree_com[0].copy(), sum(data.energy)
    depth = gain = 0.0
    start = time.perf_counter()
    for _ in range(round(duration / dt)):
        mujoco.mj_step(model, data)
    wall = time.perf_counter() - start
    # the same again for the errors, so that watching costs nothing above
    mujoco.mj_resetData(model, data)
    for _ in range(round(duration / dt)):
        mujoco.mj_step(model, data)
        if data.ncon:
            depth = max(depth, -float(data.contact.dist.min()))
        gain = max(gain, float(sum(data.energy)) - start_energy)
    moved = data.subtree_com[0] - first
    margin = moved[0] - 0.5 * chains.SLIDE * duration**2 + chains.SLOPE_FRICTION * moved[2]
    finite = bool(np.isfinite(data.qpos).all()) and not any(w.number for w in data.warning)
    return {
        "simulator": f"MuJoCo {integrator}",
        "worlds": 1,
        "dt": dt,
        "margin_m": float(margin) if finite else math.nan,
        "penetration_mm": 1e3 * depth,
        "energy_gain_J": gain,
        "unsolved": 0 if finite else 1,
        "ms_per_s": 1e3 * wall / duration,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=5.0, help="simulated seconds")
    parser.add_argument("--json", action="store_true", help="print one JSON list")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = [theirs(dt, kind, options.duration) for kind in ("implicitfast", "RK4") for dt in (0.001, 0.002, 0.005, 0.01)]
    rows += [ours(dt, worlds, options.duration) for worlds in (1, 256) for dt in (0.01, 0.02, 0.05, 0.1)]
    if options.json:
        print(json.dumps(rows))
        return
    print("simulator             worlds    Δt   margin [m]  penetration [mm]  energy gain [J]  unsolved  ms per s and world")
    for r in rows:
        print(
            f"{r['simulator']:20s} {r['worlds']:7d} {r['dt']:5g} {r['margin_m']:12.5f} {r['penetration_mm']:17.2f}"
            f" {r['energy_gain_J']:16.2g} {r['unsolved']:9d} {r['ms_per_s']:19.2f}"
        )


if __name__ == "__main__":
    main()
