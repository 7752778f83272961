"""The hard cases of simulation, measured for every integrator and step: what holds, what does not, and what it took."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pbfd_torch.bench import cases_chains, cases_contact, cases_free_motion, cases_friction, cases_stacks
from pbfd_torch.bench.hard_cases_case import Case, Check, Run
from pbfd_torch.native.engine import Engine
from pbfd_torch.solvers.objective import Status

GROUPS = (cases_free_motion, cases_chains, cases_friction, cases_contact, cases_stacks)
CASES: Mapping[str, Case] = {case.name: case for group in GROUPS for case in group.CASES}
FALLBACKS = (Status.WARM_STARTED, Status.CONTINUED, Status.EASED, Status.HALVED)
NOTES = (
    "A limit that an integrator need not keep at a step never fails; where it is exceeded, the number is reported.",
    "Energies are kinetic and potential at one time: a velocity that is the average over a step meets the mean potential energy.",
    "Where Δt .001, or the smallest Δt of a case, would take minutes it is left out.",
    "Fallbacks, world-steps that ended so: w warm-started, c continued, e as an easier step (BDF2: also at impacts), h halved.",
)


@dataclass(frozen=True)
class Result:
    """One case with one integrator at one step.

    Attributes:
        case, integrator: names.
        dt: [s].
        checks: what was measured.
        steps, unsolved: world-steps, and those of them that nothing solved.
        fallbacks: world-steps that ended with each of `FALLBACKS`, by its name.
        engine: what made the steps: native, torch, or both.
        wall_s: [s].
    """

    case: str
    integrator: str
    dt: float
    checks: Sequence[Check]
    steps: int
    unsolved: int
    fallbacks: Mapping[str, int]
    engine: str
    wall_s: float

    @property
    def failed(self) -> list[Check]:
        return [check for check in self.checks if check.fails]

    def plain(self) -> dict[str, object]:
        """As plain data, with the verdict on every check."""
        checks = [dataclasses.asdict(check) | {"verdict": check.verdict} for check in self.checks]
        return dataclasses.asdict(self) | {"checks": checks}


def plan(
    names: Iterable[str], integrators: Sequence[str], steps: Sequence[float], quick: bool, engine: Engine | None = None
) -> list[tuple[Case, Run]]:
    """The runs of some cases that are tried with these integrators and at these steps, by an engine."""
    return [
        (case, Run(integrator, dt, quick, engine))
        for case in (CASES[name] for name in names)
        for integrator in integrators
        if integrator in case.integrators
        for dt in (case.brief if quick else case.steps)
        if dt in steps
    ]


def measure(case: Case, run: Run) -> Result:
    """Runs one case."""
    started = time.perf_counter()
    checks = case.measure(run)
    wall = time.perf_counter() - started
    status = [rollout.status for rollout in run.rollouts]
    return Result(
        case=case.name,
        integrator=run.integrator,
        dt=run.dt,
        checks=list(checks),
        steps=sum(x.numel() for x in status),
        unsolved=sum(int((x > int(Status.HALVED)).sum()) for x in status),
        fallbacks={kind.name.lower(): sum(int((x == int(kind)).sum()) for x in status) for kind in FALLBACKS},
        engine=" and ".join(sorted(run.engines)),
        wall_s=wall,
    )
