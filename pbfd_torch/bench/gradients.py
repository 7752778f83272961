"""How far off a gradient is, and what it costs, for our simulators and MuJoCo's finite differences in one run, one thread, float64.

Ours follow a whole trajectory back by autograd. Beside them stand central differences, of MuJoCo's rollouts and of ours, which for
the one or two inputs of these problems are cheap. An error is that of the whole method: of the derivative, and of the simulation
that it is of.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.bench import mujoco_runs
from pbfd_torch.bench.gradients_scenes import Problem, Reported
from pbfd_torch.bench.precision import OURS, PEER, Reference
from pbfd_torch.bench.stepped import stepped
from pbfd_torch.bench.timing import Progress, timed, worst
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.runge_kutta import RungeKutta
from pbfd_torch.native.engine import Engine
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import AdaptiveSimulator, EventSimulator, Simulator
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.objective import Solution

Make = Callable[[Scene], Simulator[Any]]  # what steps a scene
FRAME, SHORTEST = 0.1, 2e-5  # of steps that a simulator chooses itself: the longest, and one that is never refused [s]
EXACTLY = 1e-13  # of the weight, to which steps are solved whose differences are taken
OWN_STEP, OWN_PEER = 1e-3, "RK4"  # of inputs, for differences that serve as references; the integrator of MuJoCo's
NARROW = 1e-6  # of inputs, for differences that check a derivative of ours at the same Δt
DERIVATIVE = "derivative"  # the method of the rows that are none of differences
NOTES = (
    "time: CPU time of one thread, the shortest of a few; forward: the motion, ours recorded; together: motion and gradient",
    "derivative: reverse mode through the whole trajectory; it yields the derivatives by all inputs, were there a hundred",
    "differences: central ones of whole motions, two for each input, each input moved by ±h; ours as a batch, MuJoCo's all in C",
    "AdaptiveSimulator: steps of its own choice by Runge–Kutta, to 1e-6 … 1e-9 m; it has no derivatives; Δt: their mean",
    "its own differences: by how much the derivative is off those of the same simulation at the same Δt, of ±1e-6",
    "error: of the gradient, relative to the reference; of several inputs the largest",
    (
        "toss: each simulator is measured against itself, for contact models differ, and so do the motions; ours: differences at "
        "three fine Δt, extrapolated to Δt = 0 as errors ∝ Δt; MuJoCo's: of RK4; ±: by how much that still changed with twice the "
        "Δt or ten times h, and no error below that counts"
    ),
    "box: the reference is Coulomb's law, v/(μg) and −v²/(2μ²g); MuJoCo's contacts as in `pbfd bench precision`",
)


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        steps: ours, whose derivatives are taken, by problem [s].
        difference_steps: ours, whose differences are taken [s].
        peer_steps: MuJoCo's [s].
        accuracies: of our steps of their own choice, whose differences are taken [m].
        moved: by how much inputs are moved for differences, MuJoCo's and ours.
        own_step, own_peer_step: of the references [s].
        repeats, enough_s: how often a time is taken, at most, and no more once that long was spent.
    """

    steps: Mapping[str, Sequence[float]]
    difference_steps: Mapping[str, Sequence[float]]
    peer_steps: Mapping[str, Sequence[float]]
    accuracies: Sequence[float] = (1e-6, 1e-7, 1e-8, 1e-9)
    moved: Sequence[float] = (1e-2, 1e-4)
    own_step: float = 2e-5
    own_peer_step: float = 1e-5
    repeats: int = 5
    enough_s: float = 3.0

    def units(self, problem: Problem, peers: bool) -> int:
        """How often `measure` tells its progress."""
        theirs = len(problem.peers) * len(self.peer_steps[problem.name]) if peers else 0
        ours = 2 * len(self.steps[problem.name]) + len(self.difference_steps[problem.name]) + len(self.accuracies)
        return ours + theirs


FULL = Effort(
    {"toss": (0.01, 0.005, 0.002, 0.001), "box": (0.05, 0.02, 0.01, 0.005)},
    {"toss": (0.01, 0.005, 0.002, 0.001, 0.0005, 0.0002, 0.0001), "box": (0.05, 0.02, 0.01, 0.005)},
    {"toss": (0.01, 0.001, 0.0001), "box": (0.05, 0.02, 0.01, 0.005, 0.001)},
)
QUICK = Effort(
    {"toss": (0.01,), "box": (0.02, 0.01)},
    {"toss": (0.01, 0.002), "box": (0.02, 0.01)},
    {"toss": (0.001, 0.0001), "box": (0.01, 0.001)},
    (1e-7,),
    own_step=1e-4,
    own_peer_step=5e-5,
    repeats=1,
)


def simulators(dt: float, engine: Engine | None, solver: Fallbacks | None = None) -> Mapping[str, Make]:
    """Ours by name, whose derivatives are taken. solver: None: the default."""
    return {
        "Simulator": lambda scene: Simulator(scene, dt, solver=solver, engine=engine),
        "EventSimulator": lambda scene: EventSimulator(scene, dt, solver=solver, engine=engine),
    }


def for_differences(dt: float, engine: Engine | None) -> Make:
    """Solved to rounding, and without an account of energy, so that motions close to each other are stepped alike."""
    return lambda scene: Simulator(scene, dt, EnergyMomentum(math.inf), Fallbacks.within(EXACTLY), engine=engine)


def adaptive(accuracy: float, engine: Engine | None) -> Make:
    """Frames of .1 s of steps of Runge–Kutta, each off by so much [m] at most."""
    return lambda scene: AdaptiveSimulator(scene, FRAME, accuracy, RungeKutta(), Fallbacks.within(EXACTLY), SHORTEST, engine)


def _placed(problem: Problem, make: Make, values: Tensor) -> tuple[Simulator[Any], Tensor, Tensor, int]:
    """The simulator for these inputs `[worlds, n]`, with its engine, the start, and how many steps there are."""
    scene, q, v = problem.start(values)
    simulator = make(scene)
    assert simulator.engine  # it is made when asked for: not within the time
    return simulator, q, v, round(problem.duration / simulator.dt)


def _apart(problem: Problem, h: float) -> Tensor:
    """The inputs with each in turn moved by +h and −h, `[2n, n]`: those moved up first."""
    moves = h * torch.eye(len(problem.at), dtype=torch.float64)
    return problem.values() + torch.cat((moves, -moves))


def _quotient(ends: Tensor, h: float) -> Tensor:
    """Of what was observed where the inputs are `_apart`, `[2n]` → `[n]`."""
    up, down = ends.chunk(2)
    return (up - down) / (2 * h)


def _motion(problem: Problem, make: Make, values: Tensor) -> Callable[[], tuple[Tensor, Solution]]:
    """What makes the motions, without derivatives: what is observed of them `[worlds]`, and how their steps were solved."""
    simulator, q, v, steps = _placed(problem, make, values)

    def moved() -> tuple[Tensor, Solution]:
        with torch.no_grad():
            states, solution = stepped(simulator, simulator.initial_state(q, v), steps)
        return states.q[-1, :, problem.coordinate] - q[:, problem.coordinate], solution

    return moved


def our_differences(problem: Problem, make: Make, moved: Sequence[float]) -> list[Tensor]:
    """Central differences `[n]` for each h, of motions that are one batch."""
    ends, _ = _motion(problem, make, torch.cat([_apart(problem, h) for h in moved]))()
    return [_quotient(part, h) for part, h in zip(ends.chunk(len(moved)), moved, strict=True)]


def peer_differences(problem: Problem, integrator: str, dt: float, h: float, repeats: int = 1) -> tuple[Tensor, float]:
    """Those of MuJoCo `[n]`, NaN where it diverges, and the CPU time of all its motions [s]."""
    ends, seconds = [], 0.0
    for values in _apart(problem, h):
        model, q, v = problem.peer(values, dt, integrator)
        run = mujoco_runs.run(model, q, v, round(problem.duration / dt), repeats=repeats, clock=time.process_time)
        ends.append(run.q[-1, problem.coordinate] - run.q[0, problem.coordinate])
        seconds += run.seconds
    return _quotient(torch.stack(ends), h), seconds


def our_reference(problem: Problem, dt: float, engine: Engine | None = None) -> Reference:
    """Differences at dt, 2dt and 4dt, extrapolated to Δt = 0 as if errors were proportional to it; exact where that is known."""
    if problem.exact is not None:
        return Reference(torch.tensor(problem.exact, dtype=torch.float64))
    moved = (OWN_STEP, 10 * OWN_STEP)
    fine, wide = zip(*(our_differences(problem, for_differences(k * dt, engine), moved) for k in (1, 2, 4)), strict=True)
    value, before = 2 * fine[0] - fine[1], 2 * fine[1] - fine[2]
    change = torch.maximum((value - before).abs(), (value - 2 * wide[0] + wide[1]).abs())
    return Reference(value, float(change.amax()), f"differences of ±{OWN_STEP:g} at {1e3 * dt:g}, {2e3 * dt:g}, {4e3 * dt:g} ms")


def peer_reference(problem: Problem, dt: float) -> Reference:
    """RK4's at dt."""
    if problem.exact is not None:
        return Reference(torch.tensor(problem.exact, dtype=torch.float64))
    pairs = ((dt, OWN_STEP), (2 * dt, OWN_STEP), (dt, 10 * OWN_STEP))
    value, *others = (peer_differences(problem, OWN_PEER, *pair)[0] for pair in pairs)
    change = max(float((value - other).abs().amax()) for other in others)
    return Reference(value, change, f"differences of ±{OWN_STEP:g} of {OWN_PEER} at {1e3 * dt:g} ms")


def derivative_row(
    problem: Problem, name: str, dt: float, reference: Reference, effort: Effort, engine: Engine | None = None
) -> dict[str, Any]:
    """The derivative by one of our simulators as plain data."""
    make = simulators(dt, engine)[name]
    forward: list[float] = []
    backward: list[float] = []
    while not forward or (len(forward) < effort.repeats and sum(forward) + sum(backward) < effort.enough_s):
        values = problem.values().requires_grad_()
        simulator, q, v, steps = _placed(problem, make, values)
        began = time.process_time()
        path = simulator.trajectory(simulator.initial_state(q, v), steps=steps)
        end = (path.q[-1] - path.q[0])[:, problem.coordinate].sum()
        forward.append(time.process_time() - began)
        (gradient,) = torch.autograd.grad(end, values)
        backward.append(time.process_time() - began - forward[-1])
    (own,) = our_differences(problem, simulators(dt, engine, Fallbacks.within(EXACTLY))[name], (NARROW,))
    row = _row(OURS, name, DERIVATIVE, dt, gradient[0], reference, min(forward), min(forward) + min(backward))
    unsolved = int((~path.solved).sum())
    return {**row, "engine": simulator.engine, "unsolved_steps": unsolved, "own_differences": _relative(gradient[0], own)}


def difference_row(problem: Problem, name: str, make: Make, h: float, reference: Reference, effort: Effort) -> dict[str, Any]:
    """Differences of one of our simulators; dt: the mean of steps that it chooses itself."""
    values = _apart(problem, h)
    (ends, solution), together = timed(lambda: _motion(problem, make, values), effort.repeats, effort.enough_s, time.process_time)
    simulator, *_, steps = _placed(problem, make, values)
    whole = len(values) * steps if solution.steps is None else int(solution.steps.sum())
    dt = problem.duration * len(values) / whole
    row = _row(OURS, name, _method(h), dt, _quotient(ends, h), reference, math.nan, together)
    return {**row, "engine": simulator.engine, "unsolved_steps": int((~solution.solved).sum())}


def peer_row(problem: Problem, integrator: str, dt: float, h: float, reference: Reference, effort: Effort) -> dict[str, Any]:
    """Differences of MuJoCo."""
    gradient, together = peer_differences(problem, integrator, dt, h, effort.repeats)
    forward = together / (2 * len(problem.at))
    row = _row(PEER, integrator, _method(h), dt, gradient, reference, forward, together)
    return {**row, "engine": mujoco_runs.ENGINE, "unsolved_steps": 0}


def _method(h: float) -> str:
    return f"differences ±{h:g}"


def _row(
    simulator: str,
    scheme: str,
    method: str,
    dt: float,
    gradient: Tensor,
    reference: Reference,
    forward_s: float,
    together_s: float,
) -> dict[str, Any]:
    found = gradient.detach()
    return {
        "simulator": simulator,
        "scheme": scheme,
        "method": method,
        "dt": dt,
        "gradient": found.tolist(),
        "absolute_error": (found - reference.value).abs().tolist(),
        "error": _relative(found, reference.value),
        "forward_s": forward_s,
        "together_s": together_s,
        "own_differences": math.nan,
    }


def _relative(found: Tensor, right: Tensor) -> float:
    """The largest relative error; NaN where any is."""
    return worst(((found - right).abs() / right.abs()).tolist())


def measure(problem: Problem, effort: Effort, peers: bool, progress: Progress, engine: Engine | None = None) -> dict[str, Any]:
    """All rows of one problem, its references and what others report, as plain data. peers: with MuJoCo."""
    reference = our_reference(problem, effort.own_step, engine)
    references = {OURS: reference}
    rows = []
    for name in simulators(1.0, engine):
        for dt in effort.steps[problem.name]:
            rows.append(derivative_row(problem, name, dt, reference, effort, engine))
            progress(1)
    differenced = [("Simulator", for_differences(dt, engine)) for dt in effort.difference_steps[problem.name]]
    differenced += [("AdaptiveSimulator", adaptive(accuracy, engine)) for accuracy in effort.accuracies]
    for name, make in differenced:
        rows += [difference_row(problem, name, make, h, reference, effort) for h in effort.moved]
        progress(1)
    if peers:
        references[PEER] = other = peer_reference(problem, effort.own_peer_step)
        for integrator in problem.peers:
            for dt in effort.peer_steps[problem.name]:
                rows += [peer_row(problem, integrator, dt, h, other, effort) for h in effort.moved]
                progress(1)
    right = torch.tensor(problem.reported_reference, dtype=torch.float64)
    return {
        "title": problem.title,
        "inputs": list(problem.inputs),
        "units": list(problem.units),
        "exact": problem.exact is not None,
        "references": {name: _told(found) for name, found in references.items()},
        "rows": rows,
        "reported_note": problem.reported_note,
        "reported": [_reported(found, right) for found in problem.reported],
    }


def _told(reference: Reference) -> dict[str, Any]:
    size = float(reference.value.abs().amin())
    relative = reference.uncertainty / size
    return {
        "value": reference.value.tolist(),
        "uncertainty": reference.uncertainty,
        "relative": relative,
        "source": reference.source,
    }


def _reported(found: Reported, right: Tensor) -> dict[str, Any]:
    """The error is that of the inputs that it is known for; NaN where it is known for none."""
    gradient = torch.tensor(found.gradient, dtype=torch.float64)
    known = gradient.isfinite()
    error = _relative(gradient[known], right[known]) if bool(known.any()) else math.nan
    return {
        "name": found.name,
        "gradient": list(found.gradient),
        "error": error,
        "forward_s": found.forward_s,
        "together_s": found.total_s,
        "ratio": found.ratio,
    }
