"""Work–precision: how far off a motion is, and what it costs, for our integrators and MuJoCo's in one run, one thread, float64.

Errors come from a recorded motion from the scene's own start. Costs are those of bare steps: of MuJoCo over the same motion; ours
over short pieces of it that start at times spread evenly over it, since a batch of 256 worlds would take too long for all of it.
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
from pbfd_torch.bench.precision_scenes import CASES, FRAME, Case
from pbfd_torch.bench.precision_tracks import Track
from pbfd_torch.bench.stepped import solved
from pbfd_torch.bench.timing import Progress, timed
from pbfd_torch.integrators.integrator import State
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.native.engine import Engine
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import AdaptiveSimulator, Simulator
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.objective import FALLBACKS

OURS, PEER = "pbfd_torch", "MuJoCo"
ADAPTIVE = {"energy-momentum": "adaptive", "runge-kutta": "adaptive runge-kutta"}  # what rows are called
FINELY, SHORTEST = 1e-12, 2e-5  # tolerance and step [s] of what serves as a reference
OWN, OWN_PEER = "runge-kutta", "RK4"  # the integrators that are references, each of its own simulator
MOST_CALLS = 100  # of the core, to take the shortest
SLOW = 4.0  # a first step that takes this many times the time for all of them is taken for the rest
NOTES = (
    "error: root mean square of the distance from the reference over what is observed; Δt: held to it, but for `adaptive`",
    (
        "time of ours: bare steps, which the core makes many of in one call; each world of a batch starts from another time of the "
        "motion, spread evenly over it; a single world is timed from several such times (box: μ = .1)"
    ),
    (
        "adaptive: steps of every world's own choice for an accuracy, of energy–momentum or Runge–Kutta, in frames of .1 s; "
        "Δt: their mean"
    ),
    "time of MuJoCo: the whole motion in C, the shortest of up to 3 runs; it has no batch: one world's time stands for any number",
    (
        "MuJoCo's contacts: elliptic cones, impratio 100, time constant 2Δt, so as stiff as it takes them; the robots' as their "
        "files have them"
    ),
    (
        f"where the reference is each simulator's own, contact models differ and so do the motions: ours has steps of their own "
        f"choice by {OWN}, MuJoCo's is {OWN_PEER}; ±: by how much it still changed with a tenth of the accuracy or half the step, "
        "and no error below that counts"
    ),
    "diverged: MuJoCo found a bad state, or ours is not finite; unsolved: steps that ours left without a root",
    "an error counts as reached where all steps are solved and the energy rises by no more than .1 of the largest kinetic energy",
)


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        steps, peer_steps: time steps [s], ours and MuJoCo's.
        own_accuracy, own_peer_step: [m] and [s] of the motions that serve as references where there is no exact one.
        worlds: of the batch, beside a single world.
        seconds: spent on the time of a single world and of a batch.
        pieces: of the motion, that a single world is timed over; a batch is timed over as much, all at once.
        repeats: of MuJoCo's runs, at most.
        accuracies: [m] of the adaptive runs.
        scenes: that are run where none are asked for.
    """

    steps: tuple[float, ...] = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)
    peer_steps: tuple[float, ...] = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05)
    own_accuracy: float = 1e-9
    own_peer_step: float = 0.0001
    worlds: int = 256
    seconds: tuple[float, float] = (0.4, 0.6)
    pieces: int = 8
    repeats: int = 3
    scenes: tuple[str, ...] = tuple(CASES)
    accuracies: tuple[float, ...] = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)

    def steps_of(self, case: Case) -> tuple[float, ...]:
        """Ours for this scene [s]."""
        return tuple(dt for dt in self.steps if dt >= case.smallest_step)

    def adaptive(self, integrators: Sequence[str]) -> list[tuple[str, float]]:
        """The adaptive runs of these integrators, each with its accuracy [m]."""
        return [(name, accuracy) for name in integrators if name in ADAPTIVE for accuracy in self.accuracies]

    def units(self, case: Case, integrators: Sequence[str], peers: Sequence[str]) -> int:
        """How often `measure_scene` tells its progress."""
        ours = 2 * len(integrators) * len(self.steps_of(case))
        return ours + len(peers) * len(self.peer_steps) + len(self.adaptive(integrators))


FULL = Effort()
QUICK = Effort((0.01, 0.02), (0.002, 0.01, 0.05), 1e-6, 0.0005, 8, (0.1, 0.1), 1, 1, ("chain-fixed", "box-slide"), (1e-2, 1e-3))


@dataclass(frozen=True, eq=False)
class Motion:
    """A recorded motion of one of our integrators, by one of our engines."""

    integrator: str
    dt: float
    track: Track
    rollout: Rollout
    engine: str


@dataclass(frozen=True, eq=False)
class Reference:
    """What should be observed; `uncertainty`: by how much it still changed as it was made finer, 0 where it is exact."""

    value: Tensor
    uncertainty: float = 0.0
    source: str = ""


def step_count(duration: float, dt: float) -> int:
    """Steps in a duration that they divide."""
    return round(duration / dt)


def our_motion(case: Case, integrator: str, dt: float, duration: float, engine: Engine | None = None) -> Motion:
    """From the scene's start, recorded."""
    scheme = INTEGRATORS[integrator]()
    return Motion(integrator, dt, *recorded(case, lambda scene: Simulator(scene, dt, scheme, engine=engine), duration))


def recorded(case: Case, make: Callable[[Scene], Simulator[State]], duration: float) -> tuple[Track, Rollout, str]:
    """The motion by what steps a scene, its record, and the engine that made the steps."""
    setup = case.setup(case.tracked_worlds)
    simulator = make(setup.scene)
    dt, steps = simulator.dt, step_count(duration, simulator.dt)
    controls = case.controls(dt, dt * torch.arange(steps, dtype=torch.float64)[:, None].expand(-1, setup.worlds))
    start = simulator.initial_state(setup.q, setup.v, None if controls is None else controls[0])
    rollout = simulator.rollout(start, controls, steps if controls is None else None)
    return Track.of_rollout(setup, rollout), rollout, simulator.engine


def peer_motion(case: Case, integrator: str, dt: float, duration: float, repeats: int = 1) -> tuple[Track, float, bool]:
    """MuJoCo's from the same start, its wall time per world [s], and whether it diverged."""
    setup = case.setup(case.tracked_worlds)
    steps = step_count(duration, dt)
    controls = case.controls(dt, dt * torch.arange(steps, dtype=torch.float64))
    runs = [
        mujoco_runs.run(mujoco_runs.loaded(case.scene, dt, integrator, k), setup.q[k], setup.v[k], steps, controls, repeats)
        for k in range(setup.worlds)
    ]
    q, v = torch.stack([run.q for run in runs], 1), torch.stack([run.v for run in runs], 1)
    track = Track.of_states(setup.scene, dt * torch.arange(steps + 1, dtype=torch.float64), q, v)
    return track, sum(run.seconds for run in runs) / len(runs), any(run.diverged for run in runs)


def starts(track: Track, worlds: int, first: int, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """`[worlds, nq]`, `[worlds, nv]` and times `[worlds]` [s] for one of `count` groups, `first` = 0 … count − 1. The starts of all
    groups together are spread evenly over the motion, as far as it is finite."""
    whole = torch.isfinite(track.q).all(-1).all(-1) & torch.isfinite(track.v).all(-1).all(-1)
    usable = max(1, int(whole.long().cumprod(0).sum()) - 1)
    world = torch.arange(worlds)
    row = (first + count * world) * usable // (count * worlds)
    copy = world % track.q.shape[1]
    return track.q[row, copy], track.v[row, copy], track.time[row]


def our_cost(case: Case, track: Track, make: Callable[[Scene], Simulator[Any]], worlds: int, seconds: float, pieces: int) -> float:
    """Wall time per simulated second and world [ms] of what steps a scene, over pieces of a motion of its own."""
    setup = case.setup(worlds)
    simulator = make(setup.scene)
    dt, groups = simulator.dt, pieces if worlds == 1 else 1
    span = max(2, (len(track.time) - 1) // pieces)
    each = []
    for group in range(groups):
        q, v, begin = starts(track, worlds, group, groups)
        controls = [case.controls(dt, begin + dt * k) for k in range(span + 1)]
        fresh, began = simulator.initial_state(q, v, controls[0]), time.perf_counter()
        # the first step does not count: a velocity that is an average over the last one makes it harder than others
        start, _ = simulator.step(fresh, controls[0])
        first = time.perf_counter() - began
        slow = first > SLOW * seconds / groups
        each.append(first if slow else _step_time(simulator, start, controls[1:], seconds / groups))
    return 1e3 * sum(each) / groups / dt / worlds


def _costs(case: Case, track: Track, make: Callable[[Scene], Simulator[Any]], effort: Effort) -> dict[str, float]:
    """The same of one world and of a batch, by their number."""
    batches = zip((1, effort.worlds), effort.seconds, strict=True)
    return {str(worlds): our_cost(case, track, make, worlds, seconds, effort.pieces) for worlds, seconds in batches}


def _step_time(simulator: Simulator[Any], start: Any, controls: Sequence[Tensor | None], seconds: float) -> float:
    """Wall time of a step [s] over the steps under these controls, as far as `seconds` reach, or as often: of the core, which makes
    them all in one call, the shortest."""
    span, given = len(controls), [x for x in controls if x is not None]
    if isinstance(simulator.stepper, NativeStepper):
        held = torch.stack(given) if given else None
        return timed(lambda: lambda: solved(simulator, start, span, held), MOST_CALLS, enough_s=seconds)[1] / span
    state, count, began = start, 0, time.perf_counter()
    while count < 2 or time.perf_counter() - began < seconds:
        state = start if count % span == 0 else state
        state, _ = simulator.step(state, controls[count % span])
        count += 1
    return (time.perf_counter() - began) / count


def reference_of(case: Case, integrator: str, dt: float, motion: Callable[[float, float], Track]) -> Reference:
    """What the motion (dt, duration) → track gives, and how far that is from what it gives at twice the step; exact where that is
    known."""
    if case.exact is not None:
        return Reference(case.exact())
    until = min(case.duration, case.observed_s)
    value = case.observe(motion(dt, until))
    return Reference(value, case.error(motion(2 * dt, until), value), f"{integrator} at {dt:g} s")


def our_reference(case: Case, accuracy: float, engine: Engine | None = None) -> Reference:
    """What steps of an accuracy [m] of their own choice, 20 μs at least, give, solved to 1e-12, and how far that is from what ten
    times the accuracy gives; exact where that is known."""
    if case.exact is not None:
        return Reference(case.exact())
    until = min(case.duration, case.observed_s)

    def motion(length: float) -> Track:
        def make(scene: Scene) -> Simulator[State]:
            return AdaptiveSimulator(scene, FRAME, length, INTEGRATORS[OWN](), Fallbacks.within(FINELY), SHORTEST, engine)

        return recorded(case, make, until)[0]

    value = case.observe(motion(accuracy))
    return Reference(value, case.error(motion(10 * accuracy), value), f"steps of {accuracy:g} m by {OWN}")


def peer_reference(case: Case, dt: float) -> Reference:
    """RK4's at dt."""
    return reference_of(case, OWN_PEER, dt, lambda *args: peer_motion(case, OWN_PEER, *args)[0])


def our_row(
    case: Case, motion: Motion, reference: Reference, other: Reference | None, effort: Effort, engine: Engine | None = None
) -> dict[str, Any]:
    """One time step of one integrator as plain data; other: MuJoCo's reference, where it has its own."""
    rollout = motion.rollout
    away = {} if other is None or case.exact is not None else {"error_to_mujoco": case.error(motion.track, other.value)}
    scheme = INTEGRATORS[motion.integrator]
    return {
        **_ours(case, motion.track, rollout, reference),
        "engine": motion.engine,
        "integrator": motion.integrator,
        "dt": motion.dt,
        "world_steps": rollout.status.numel(),
        "ms_per_s": _costs(case, motion.track, lambda scene: Simulator(scene, motion.dt, scheme(), engine=engine), effort),
        **_told(case, motion.track),
        **away,
    }


def adaptive_row(
    case: Case, integrator: str, accuracy: float, reference: Reference, effort: Effort, engine: Engine | None = None
) -> dict[str, Any]:
    """One run with steps of the worlds' own."""

    def made(scene: Scene) -> Simulator[State]:
        return AdaptiveSimulator(scene, FRAME, accuracy, INTEGRATORS[integrator](), engine=engine)

    track, rollout, name = recorded(case, made, case.duration)
    steps = int(rollout.substeps.sum())
    return {
        **_ours(case, track, rollout, reference),
        "engine": name,
        "integrator": ADAPTIVE[integrator],
        "dt": case.duration * case.tracked_worlds / steps,
        "accuracy_m": accuracy,
        "world_steps": steps,
        "ms_per_s": _costs(case, track, made, effort),
        **_told(case, track),
    }


def peer_row(case: Case, integrator: str, dt: float, reference: Reference, repeats: int) -> dict[str, Any]:
    """The same of MuJoCo."""
    track, seconds, diverged = peer_motion(case, integrator, dt, case.duration, repeats)
    return {
        "simulator": PEER,
        "engine": mujoco_runs.ENGINE,
        "integrator": integrator,
        "dt": dt,
        "error": case.error(track, reference.value),
        "diverged": diverged,
        "world_steps": (len(track.time) - 1) * case.tracked_worlds,
        "unsolved_steps": 0,
        "ms_per_s": {"1": math.nan if diverged else 1e3 * seconds / case.duration},
        **_told(case, track),
    }


def _ours(case: Case, track: Track, rollout: Rollout, reference: Reference) -> dict[str, Any]:
    """What is told of every motion of ours."""
    return {
        "simulator": OURS,
        "error": case.error(track, reference.value),
        "diverged": not bool(torch.isfinite(track.q).all()),
        "unsolved_steps": int((~rollout.solved).sum()),
        "fallbacks": dict(zip(FALLBACKS, rollout.fallbacks.sum((0, 1)).tolist(), strict=True)),
        "evaluations": float(rollout.evaluations.sum() / rollout.substeps.sum()),
    }


def _told(case: Case, track: Track) -> dict[str, float]:
    numbers = track.numbers()
    return {name: numbers[name] for name in case.numbers}


def measure_scene(
    case: Case, integrators: Sequence[str], peers: Sequence[str], effort: Effort, progress: Progress, engine: Engine | None = None
) -> dict[str, Any]:
    """All rows of one scene as plain data. peers: MuJoCo's integrators; none: without MuJoCo. engine: of our steps."""
    motions = []
    for name in integrators:
        for dt in effort.steps_of(case):
            motions.append(our_motion(case, name, dt, case.duration, engine))
            progress(1)
    reference = our_reference(case, effort.own_accuracy, engine)
    other = peer_reference(case, effort.own_peer_step) if peers else None
    rows = []
    for motion in motions:
        rows.append(our_row(case, motion, reference, other, effort, engine))
        progress(1)
    for name, accuracy in effort.adaptive(integrators):
        rows.append(adaptive_row(case, name, accuracy, reference, effort, engine))
        progress(1)
    if other is not None:
        for name in peers:
            for dt in effort.peer_steps:
                rows.append(peer_row(case, name, dt, other, effort.repeats))
                progress(1)
    return {
        "title": case.title,
        "unit": case.unit,
        "duration_s": case.duration,
        "levels": list(case.levels),
        "reference": case.reference,
        "own_references": _own({OURS: reference, PEER: other}) if case.exact is None else {},
        "rows": rows,
    }


def _own(references: Mapping[str, Reference | None]) -> dict[str, Any]:
    return {
        simulator: {"source": found.source, "uncertainty": found.uncertainty}
        for simulator, found in references.items()
        if found is not None
    }
