"""`pbfd simulate`: runs a setup, reports it, saves it."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from pbfd_torch import memory
from pbfd_torch.cli.options import Choices, Schedule, with_friction
from pbfd_torch.cli.outputs import check_file
from pbfd_torch.contact.hazards import Hazard
from pbfd_torch.errors import InputError
from pbfd_torch.models import Setup
from pbfd_torch.native.engine import Torch
from pbfd_torch.records.recording import least_bytes
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.schedules.asynchronous import AsynchronousRollout
from pbfd_torch.schedules.workers import Workers
from pbfd_torch.solvers.objective import Status

MAX_STEPS = 10_000_000
FRAME = 0.05  # [s] of the records where worlds choose their own steps


@dataclass(frozen=True, eq=False)
class Result:
    """A rollout with what was asked for and how long it took."""

    setup: Setup
    rollout: Rollout
    choices: Choices
    wall_s: float
    engine: str
    engine_reason: str

    def summary(self) -> dict[str, Any]:
        """The numbers of the report; energies and the centre of mass are world 0's, extremes are over all worlds."""
        r = self.rollout
        duration = r.steps * r.dt
        start = self.setup.scene.energy(self.setup.q, self.setup.v)
        iterations = r.iterations.to(torch.float64).flatten()
        metrics = self.setup.metrics(r)
        return {
            "scene": self.setup.scene.name,
            "worlds": self.setup.worlds,
            "dt": r.dt,
            "duration": duration,
            "steps": r.steps,
            "accuracy": self.choices.accuracy,
            "substeps_mean": float(r.substeps.sum(0).to(torch.float64).mean()),
            "integrator": self.choices.integrator.value,
            "solver": self.choices.solver.value,
            "engine": self.engine,
            "engine_reason": self.engine_reason,
            "dtype": self.choices.dtype.value,
            "device": self.choices.device.value,
            "wall_s": self.wall_s,
            "ms_per_simulated_s_per_world": 1e3 * self.wall_s / duration / self.setup.worlds,
            "solved_fraction": float(r.solved.to(torch.float64).mean()),
            "unsolved_steps": int((~r.solved).sum()),
            "explicit_steps": int((r.status == int(Status.EXPLICIT)).sum()),
            "warm_started_steps": int((r.status == int(Status.WARM_STARTED)).sum()),
            "continued_steps": int((r.status == int(Status.CONTINUED)).sum()),
            "eased_steps": int((r.status == int(Status.EASED)).sum()),
            "halved_steps": int((r.status == int(Status.HALVED)).sum()),
            **{f"{bit.name.lower()}_steps": int((r.hazards & int(bit)).bool().sum()) for bit in Hazard if bit.name},
            "most_hazards": [f"{name}: {steps}" for name, steps in r.hazardous().items()],
            "iterations_mean": float(iterations.mean()),
            "iterations_p95": float(iterations.sort().values[math.ceil(0.95 * len(iterations)) - 1]),
            "iterations_max": int(iterations.max()),
            "evaluations_mean": float(r.evaluations.to(torch.float64).mean()),
            "schedule": self.choices.schedule.value,
            "lane_utilisation": r.utilisation,
            "max_penetration_m": float(r.penetration.max()),
            "energy_start_J": float(start[0]),
            "energy_end_J": float(r.energy[-1, 0]),
            "energy_max_gain_J": max(0.0, float((r.energy[1:] - start).max())),
            "final_com_m": r.center_of_mass[-1, 0].tolist(),
            "metrics": metrics,
            "notes": list(self.setup.notes),
        }


def run(setup: Setup, choices: Choices, duration: float | None, dt: float | None, out: Path | None, as_json: bool) -> int:
    """Runs and reports; the exit status: 0, or 1 where some world has an unsolved step."""
    if out is not None:
        check_file("--out", out, ".npz")
    result = simulated(setup, choices, duration, dt)
    if out is not None:
        result.rollout.save(out)
    if as_json:
        print(json.dumps(result.summary()))
    else:
        print_summary(result, out)
    return 0 if bool(result.rollout.solved.all()) else 1


def simulated(setup: Setup, choices: Choices, duration: float | None = None, dt: float | None = None) -> Result:
    """Runs a setup with a progress bar on a terminal. Interrupted, it keeps the steps done."""
    duration = setup.duration if duration is None else duration
    if dt is None:
        dt = setup.dt if choices.accuracy is None else min(FRAME, duration)
    if dt > duration:
        raise InputError(f"--dt is {dt:g} s: must be at most the duration, {duration:g} s")
    steps = round(duration / dt)
    if steps > MAX_STEPS:
        raise InputError(f"--duration {duration:g} s at --dt {dt:g} s makes {steps} steps: must be at most {MAX_STEPS}")
    size, most = least_bytes(setup.scene, setup.worlds, steps), memory.share()
    if size > most:
        raise InputError(
            f"{steps} steps of {setup.worlds} worlds make a record of at least {memory.gibibytes(size)}: must be at most "
            f"{memory.gibibytes(most)}, half of the memory that is available; choose fewer --worlds or a shorter --duration"
        )
    setup = with_friction(setup, choices.friction, dt)
    simulator = choices.make_simulator(setup.scene, dt)
    controls = setup.controls(steps)
    if choices.workers > setup.worlds:
        raise InputError(f"--workers is {choices.workers}: must be at most the number of worlds, {setup.worlds}")
    started = time.perf_counter()
    state = simulator.initial_state(setup.q, setup.v, controls[0])
    if choices.workers > 1:
        with Workers(choices.workers) as workers:
            rollout = workers.rollout(simulator, state, controls)
    elif choices.schedule is Schedule.ASYNCHRONOUS and simulator.engine == Torch.name:  # in the core no world waits anyway
        with tqdm(total=steps * setup.worlds, unit="step", disable=not sys.stderr.isatty(), leave=False) as bar:
            rollout = AsynchronousRollout(simulator, state, steps, controls).finish(bar.update)
    else:
        with tqdm(total=steps, unit="step", disable=not sys.stderr.isatty(), leave=False) as bar:
            rollout = simulator.rollout(state, controls, progress=lambda done: bar.update())
    wall = time.perf_counter() - started
    if rollout.steps < steps:
        print(f"pbfd: interrupted after {rollout.steps} of {steps} steps; reporting those", file=sys.stderr)
    return Result(setup, rollout, choices, wall, simulator.engine, simulator.engine_reason)


def print_summary(result: Result, out: Path | None) -> None:
    """The report as a table."""
    summary = result.summary()
    metrics, notes = summary.pop("metrics"), summary.pop("notes")
    table = Table(title=f"pbfd simulate {summary.pop('scene')}", show_header=False, title_justify="left")
    table.add_column(style="cyan")
    table.add_column()
    for key, value in (summary | metrics).items():
        table.add_row(key, _text(value))
    console = Console(markup=False, emoji=False)
    console.print(table)
    for note in notes:
        print(f"note: {note}")
    if not bool(result.rollout.solved.all()):
        bad = int((~result.rollout.solved).any(0).sum())
        console.print(
            f"{bad} of {summary['worlds']} worlds have unsolved steps: their motion after those is not to be trusted", style="red"
        )
    if out is not None:
        print(f"rollout written to {out}")


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        if len(value) > 8 and all(isinstance(x, float) for x in value):
            middle = sorted(value)[len(value) // 2]
            return f"min {min(value):.4g}, median {middle:.4g}, max {max(value):.4g}"
        return ", ".join(_text(x) for x in value)
    return str(value)
