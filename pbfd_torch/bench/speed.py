"""Control steps a second of our engines and of MuJoCo, on the same scenes in one run, and the error beside them.

Every contestant makes the same rollouts: `steps` control steps of many worlds, each from a start and under random controls of its
own. The contestants of a batch take turns, and the shortest time of each counts: CPU time for one thread, wall time for several.
Errors are those of `pbfd bench precision`: of one motion from the scene's own start.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.bench import mujoco_runs
from pbfd_torch.bench.mujoco_scenes import NAMES
from pbfd_torch.bench.precision import OURS, OWN, PEER, Reference, peer_reference, reference_of
from pbfd_torch.bench.precision_tracks import Track
from pbfd_torch.bench.speed_mujoco import INTEGRATORS, Peer, fewest
from pbfd_torch.bench.speed_ours import DTYPES, ENGINES, Call, Ours, Record, definition
from pbfd_torch.bench.speed_scenes import USUAL, Course, Work
from pbfd_torch.bench.timing import Progress
from pbfd_torch.solvers.objective import Solution

Contestant = Ours | Peer
TRIED = 8  # worlds of MuJoCo's that must not diverge
TRACKED = 16  # worlds whose motion short runs start from
PEERS = 64  # worlds that stand for a batch of MuJoCo's, at least
GROUPS = 8  # times of it that those of a single world start from
NOTES = (
    (
        "control steps/s: of all worlds together, the best of several rounds in which the contestants take turns; CPU time for one "
        "thread, wall time for several; µs: of one world's control step"
    ),
    (
        "a rollout: every world from a start of its own near the scene's, the first from the scene's own, robots under random "
        "controls; one world: the scene's own start, robots several rollouts, one after another"
    ),
    "ours where whole rollouts would take too long, as torch's do: a few steps from states spread evenly over their time",
    (
        "MuJoCo: `mujoco.rollout`, all in C, contacts on the chains as stiff as it takes them, those of robots as their files have "
        "them; mujoco-rk4: four steps of 2 ms on robots, as Gymnasium ships hopper and walker. It has no batch: where all worlds "
        "would take too long, fewer, 64 at least, stand for them"
    ),
    "steps: in a control step; on chains the fewest with which MuJoCo does not diverge, nor end too far off",
    (
        "error: over one motion from the scene's own start, of each simulator against itself at a fine step (robots: the root "
        "until .4 s under sines; chain-ground, mesh-terrain: centre of mass at .4 and .36 s, after the first impacts; later no "
        "reference is converged; gripper, turntable, robot-arm: links at .4 s), on chain-slope-drop against Coulomb's law after 5 "
        "s, on stack-10 and arch against rest; ±: by how much the reference changed as its step was halved"
    ),
    "warm-up: from nothing until the first step, and by how much the first run took longer than the best",
)


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        scenes: that are run where none are asked for.
        worlds: batches, of those that the scenes have.
        most_eager: torch is left out where there are more worlds times threads.
        steps: control steps of a rollout, at most.
        alone: rollouts of a single world, one after another.
        rounds: at most.
        enough_s: a contestant that has taken this long takes no further turn.
        patience_s: where rollouts would take longer, less stands for them: of ours few steps, of MuJoCo's fewer worlds.
        few: steps of single worlds, in all; one of each at least.
        own_step, own_peer_step: [s] of the motions that serve as references.
    """

    scenes: tuple[str, ...] = USUAL
    worlds: tuple[int, ...] = (1, 64, 256, 1024)
    most_eager: int = 1024
    steps: int = 1000
    alone: int = 8
    rounds: int = 7
    enough_s: float = 2.0
    patience_s: float = 5.0
    few: int = 128
    own_step: float = 0.0005
    own_peer_step: float = 0.0001

    def worlds_of(self, course: Course) -> tuple[int, ...]:
        """Batches of a scene."""
        return tuple(worlds for worlds in course.worlds if worlds in self.worlds)

    def units(self, course: Course, threads: Sequence[int], peers: bool) -> int:
        """How often `measure_scene` tells its progress."""
        contestants = len(ENGINES) * len(DTYPES) + len(INTEGRATORS) * (peers and course.scene in NAMES)
        return contestants * (1 + len(threads) * len(self.worlds_of(course)))


FULL = Effort()
QUICK = Effort(("hopper", "chain-slope-drop"), (1, 64, 1024), 64, 50, 2, 2, 0.5, 0.5, 16, 0.001, 0.0005)


@dataclass
class Turns:
    """A contestant's runs of one batch."""

    call: Call
    world_steps: int
    ready_s: float
    solutions: Sequence[Solution] = ()
    times: list[float] = field(default_factory=list)

    def take(self, clock: Callable[[], float]) -> None:
        """One more."""
        began = clock()
        self.solutions = self.call()
        self.times.append(clock() - began)

    @property
    def warmup_s(self) -> float:
        """See `NOTES`."""
        return self.ready_s + self.times[0] - min(self.times)

    def mean(self, of: Callable[[Solution], Tensor]) -> float:
        """Over all steps of a call; NaN where nothing is known of them."""
        return float(torch.stack([of(x).double().mean() for x in self.solutions]).mean()) if self.solutions else math.nan


def all_threads() -> tuple[int, ...]:
    """One, and as many as there are processors to use."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return (1,) if usable == 1 else (1, usable)


def measure_scene(course: Course, effort: Effort, threads: Sequence[int], peers: bool, progress: Progress) -> dict[str, Any]:
    """All rows of one scene as plain data. peers: with MuJoCo, where it has the scene."""
    peers = peers and course.scene in NAMES
    course = replace(course, steps=min(course.steps, effort.steps))
    work = course.work(max(effort.worlds_of(course)))
    with mujoco_runs.silent() if peers else nullcontext():
        references = {OURS: _our_reference(course, effort.own_step)}
        if peers:
            references[PEER] = peer_reference(course.case, effort.own_peer_step)
        contestants = _contestants(course, work, peers)
        errors = {}
        for one in contestants:
            errors[one] = _error(one, references)
            progress(1)
        record = definition(course).record(work.of(0, TRACKED))
        rows: list[dict[str, Any]] = []
        for count in threads:
            torch.set_num_threads(count)
            for worlds in effort.worlds_of(course):
                turns = _measured(contestants, work, record, worlds, count, effort, progress)
                for one, notes in contestants.items():
                    note = _left_out(one, worlds, count, effort) or notes
                    rows.append(_row(one, course, worlds, count, turns.get(one), errors[one], note))
        torch.set_num_threads(1)
    own = {name: {"source": found.source, "uncertainty_m": found.uncertainty} for name, found in references.items()}
    about = {"dt_s": course.dt, "steps": course.steps, "error_of": course.case.title}
    return {**about, "references": {} if course.case.exact else own, "rows": rows}


def _our_reference(course: Course, dt: float) -> Reference:
    return reference_of(course.case, OWN, dt, lambda step, until: definition(replace(course, dt=step)).motion(course.case, until))


def _contestants(course: Course, work: Work, peers: bool) -> Mapping[Contestant, str]:
    """All, and what there is to say about each."""
    found: dict[Contestant, str] = {Ours(course, engine, dtype): "" for engine in ENGINES for dtype in DTYPES}
    for engine in INTEGRATORS if peers else ():
        peer, note = fewest(course, engine, work.of(0, TRIED))
        found[peer] = note
    return found


def _error(one: Contestant, references: Mapping[str, Reference]) -> float:
    """[m]; NaN where there is no such motion."""
    case = one.course.case
    if one.missing():
        return math.nan
    track: Track = one.motion(case, min(case.duration, case.observed_s))
    return case.error(track, references[OURS if isinstance(one, Ours) else PEER].value)


def _left_out(one: Contestant, worlds: int, threads: int, effort: Effort) -> str:
    """Why it is not timed in a batch; nothing where it is."""
    slow = one.engine == "torch" and worlds * threads > effort.most_eager
    return f"not timed where worlds times threads are over {effort.most_eager}" if slow else one.missing()


def _entered(one: Contestant, work: Work, record: Record, worlds: int, threads: int, effort: Effort) -> Turns:
    """A contestant with what it does in its turns: the whole work, or, where that would take too long, as much as does not. Ours
    then makes fewer steps of all worlds; of MuJoCo's, which knows no batch, fewer worlds stand for all."""
    whole = [work.of(k, 1) for k in range(min(one.course.alone, effort.alone))] if worlds == 1 else [work.of(0, worlds)]
    groups = GROUPS if worlds == 1 else 1

    def of_all(steps: int, ours: Ours) -> Turns:
        began = time.perf_counter()
        call = ours.ready_under_way(record, worlds, groups, steps, threads)
        return Turns(call, groups * worlds * steps, time.perf_counter() - began)

    def of_some(works: Sequence[Work]) -> Turns:
        began = time.perf_counter()
        return Turns(one.ready(works, threads), sum(x.world_steps for x in works), time.perf_counter() - began)

    few = max(1, min(one.course.steps, effort.few // (groups * worlds)))
    first = of_all(few, one) if isinstance(one, Ours) else of_some([work.of(0, min(worlds, PEERS))])
    first.take(_clock(threads))
    most = int(effort.patience_s / first.times[0] * first.world_steps)
    if most >= sum(x.world_steps for x in whole):
        return of_some(whole)
    if isinstance(one, Ours):
        steps = min(one.course.steps, most // (groups * worlds))
        return of_all(steps, one) if steps > 2 * few else first
    return of_some([work.of(0, most // len(work.controls))]) if most > first.world_steps else first


def _clock(threads: int) -> Callable[[], float]:
    return time.process_time if threads == 1 else time.perf_counter


def _measured(
    contestants: Mapping[Contestant, str],
    work: Work,
    record: Record,
    worlds: int,
    threads: int,
    effort: Effort,
    progress: Progress,
) -> Mapping[Contestant, Turns]:
    """Those that can run, in turns."""
    clock = _clock(threads)
    found: dict[Contestant, Turns] = {}
    for one in contestants:
        if not _left_out(one, worlds, threads, effort):
            found[one] = _entered(one, work, record, worlds, threads, effort)
        progress(1)
    for _ in range(effort.rounds):
        for turns in found.values():
            if not turns.times or sum(turns.times) < effort.enough_s:
                turns.take(clock)
    return found


def _row(
    one: Contestant, course: Course, worlds: int, threads: int, turns: Turns | None, error: float, note: str
) -> dict[str, Any]:
    """One line; without numbers where there is nothing to measure."""
    took = turns or Turns(tuple, 1, math.nan, times=[math.nan])
    seconds = min(took.times) / took.world_steps
    return {
        "scene": course.scene,
        "engine": one.engine,
        "dtype": one.dtype,
        "worlds": worlds,
        "threads": threads,
        "dt_s": course.dt,
        "substeps": one.substeps,
        "control_steps_per_s": 1 / seconds,
        "physics_steps_per_s": one.substeps / seconds,
        "us_per_step": 1e6 * seconds,
        "ms_per_simulated_s": 1e3 * seconds / course.dt,
        "evaluations_mean": took.mean(lambda x: x.evaluations),
        "solved_share": took.mean(lambda x: x.solved),
        "fallback_share": took.mean(lambda x: x.fallbacks.sum(-1) > 0),
        "error_m": error,
        "warmup_s": took.warmup_s,
        "timed_world_steps": 0 if turns is None else turns.world_steps,
        "note": note,
    }
