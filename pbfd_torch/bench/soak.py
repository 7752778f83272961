"""The soak: random robots are dropped and pushed for as long as is asked, and everything that ought not to happen is counted."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.bench.random_robots import RandomRobot
from pbfd_torch.integrators.energy_momentum import NOISE, EnergyMomentum, Velocities
from pbfd_torch.native.engine import Engine
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.stepping.eager import MOST_EVALUATIONS

WORLDS, STEPS, PUSHED = 128, 30, 10  # of a robot: worlds, steps, and steps after which it is pushed otherwise
SHOWN = 30  # findings of a kind that are listed one by one


@dataclass
class Soak:
    """What has happened so far.

    Attributes:
        seeds: robots; world_steps: steps of single worlds; engines: how many robots each engine has stepped, by its name.
        status: how many of these ended with each `Status`.
        not_finite_unsaid: states with NaN or infinity that no status tells of.
        energy_rises: steps after which all together have gained more than the integrator's account allows.
        over_budget: steps that took more evaluations than they may.
        hazards: steps with any hazard.
        slowest_s, slowest: the longest step of a batch [s], and where it was.
        evaluations: the most that a world spent on a step.
        memory: resident [bytes] after a tenth of all world-steps, and at the end; None: not known here.
        findings: what was unsolved, not finite or over, with the robot's seed, the step and the world.
    """

    seeds: int = 0
    world_steps: int = 0
    engines: dict[str, int] = field(default_factory=dict)
    status: dict[str, int] = field(default_factory=lambda: dict.fromkeys((x.name for x in Status), 0))
    not_finite_unsaid: int = 0
    energy_rises: int = 0
    over_budget: int = 0
    hazards: int = 0
    slowest_s: float = 0.0
    slowest: dict[str, Any] = field(default_factory=dict)
    evaluations: int = 0
    memory: dict[str, int | None] = field(default_factory=dict)
    findings: list[dict[str, Any]] = field(default_factory=list)

    @property
    def unsolved(self) -> int:
        """Steps that were left unsolved, but for those of worlds that stand still."""
        return self.status["STALLED"] + self.status["ITERATION_LIMIT"]

    def count(self, seed: int, step: int, wall: float, state: Velocities, solution: Solution) -> None:
        """Adds a step of a robot's worlds, which took so long [s]."""
        where = {"seed": seed, "step": step}
        for status in Status:
            found = solution.status == int(status)
            self.status[status.name] += int(found.sum())
            if status > Status.HALVED:
                self._find(found, "unsolved", where, solution)
        finite = torch.isfinite(state.q).all(-1) & torch.isfinite(state.v).all(-1)
        self.not_finite_unsaid += self._find(~finite & (solution.status != int(Status.NON_FINITE)), "not finite", where, solution)
        account = EnergyMomentum().surplus
        risen = solution.solved & (state.surplus > account * state.peak) & (state.gained > NOISE * state.peak)
        self.energy_rises += self._find(risen, "energy", where, solution)
        self.over_budget += self._find(solution.evaluations > MOST_EVALUATIONS, "over budget", where, solution)
        self.hazards += int((state.hazards != 0).sum())
        self.evaluations = max(self.evaluations, int(solution.evaluations.max()))
        self.world_steps += solution.status.numel()
        if wall > self.slowest_s:
            self.slowest_s, self.slowest = wall, {**where, "evaluations": int(solution.evaluations.max())}

    def _find(self, worlds: Tensor, what: str, where: dict[str, Any], solution: Solution) -> int:
        for world in worlds.nonzero().flatten().tolist():
            status = Status(int(solution.status[world])).name
            if sum(x["what"] == what for x in self.findings) < SHOWN:
                self.findings.append({"what": what, "world": world, "status": status, **where})
        return int(worlds.sum())

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        first, last = self.memory.get("tenth_bytes"), self.memory.get("end_bytes")
        growth = last / first - 1 if first and last else None
        return {**vars(self), "unsolved": self.unsolved, "memory_growth": growth}


def soak(world_steps: int, seed: int, dt: float, progress: Callable[[int], object], engine: Engine | None = None) -> Soak:
    """Robots from this seed on, until an engine has made so many steps of single worlds; progress: called with those of every step.
    An interruption ends it early, and keeps what was counted."""
    found = Soak()
    try:
        while found.world_steps < world_steps:
            _robot(found, seed + found.seeds, dt, world_steps, progress, engine)
            found.seeds += 1
    except KeyboardInterrupt:
        pass
    found.memory["end_bytes"] = resident()
    return found


def _robot(found: Soak, seed: int, dt: float, world_steps: int, progress: Callable[[int], object], engine: Engine | None) -> None:
    """One robot, for as many steps as are left to it."""
    robot = RandomRobot(seed)
    simulator = Simulator(robot.pushed(WORLDS), dt, EnergyMomentum(), engine=engine)
    found.engines[simulator.engine] = found.engines.get(simulator.engine, 0) + 1
    state = simulator.initial_state(*robot.start(WORLDS))
    for step in range(STEPS):
        if found.world_steps >= world_steps:
            return
        if step and step % PUSHED == 0:
            simulator = simulator.with_scene(robot.pushed(WORLDS))
        begun = time.perf_counter()
        state, solution = simulator.step(state)
        found.count(seed, step, time.perf_counter() - begun, state, solution)
        progress(WORLDS)
        if "tenth_bytes" not in found.memory and found.world_steps >= 0.1 * world_steps:
            found.memory["tenth_bytes"] = resident()


def resident() -> int | None:
    """Memory of this process [bytes], where the system tells it."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    sizes = [int(line.split()[1]) * 1024 for line in lines if line.startswith("VmRSS")]
    return sizes[0] if sizes else None
