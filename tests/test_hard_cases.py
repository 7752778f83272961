"""The hard cases: what must hold holds, for every integrator, at the steps of the quick run; and what a check, a run and a cell of
the table say."""

from __future__ import annotations

import math

import pytest
import torch

from pbfd_torch.bench.hard_cases import CASES, Result, measure, plan
from pbfd_torch.bench.hard_cases_case import ALL, MEAN_VELOCITY, TIME_STEPS, Case, Check, Run, drift
from pbfd_torch.bench.hard_cases_table import long, short, table
from pbfd_torch.models.boxes import box_slide
from pbfd_torch.solvers.objective import Status
from tests.finite_differences import relative_error

QUICK = plan(CASES, ALL, TIME_STEPS, quick=True)
EXPECTED = {
    *("free-fall", "rotation-oracle", "pendulum-energy", "pendulum-order", "tumbling-box", "middle-axis", "dzhanibekov"),
    *("quadruped-momentum", "mass-ratio", "whip", "chain-heavy", "chain-flight", "joint-limit", "outside-limit"),
    *("stopping-distance", "ramp-grid", "critical-slope", "creep", "straight-path", "rolling-sphere"),
    *("rest-depth", "rest-without-drift", "inelastic-drop", "fast-impact", "painleve-rod", "far-away"),
    *("chain-ground", "chain-on-slope", "sphere-stack", "heavy-on-light", "stack-of-5", "stack-of-10"),
}


@pytest.mark.parametrize(("case", "run"), QUICK, ids=[f"{case.name}-{run.integrator}-{run.dt:g}" for case, run in QUICK])
def test_what_must_hold(case: Case, run: Run) -> None:
    """The case's law: see its docstring."""
    result = measure(case, run)
    assert [(check.name, check.value, check.limit) for check in result.failed] == []


@pytest.mark.parametrize("dt", [0.01, 0.02])
def test_tip_of_the_heavy_chain(dt: float) -> None:
    """1000 : 1, energy–momentum: within 1 mm at Δt .01 and 10 mm at .02, every step solved without help."""
    result = measure(CASES["chain-heavy"], Run("energy-momentum", dt))
    assert result.failed == []
    assert not any(result.fallbacks.values())


def test_cases() -> None:
    """Every row is there; each has a law, steps from the list, and quick ones among or beside them for each of its integrators."""
    assert set(CASES) == EXPECTED
    for case in CASES.values():
        assert len(case.law) > 40
        assert set(case.steps) <= set(TIME_STEPS)
        assert 0 < len(case.brief) <= len(case.steps)
        assert set(case.brief) <= set(case.steps)
    assert {run.integrator for _, run in QUICK} == set(ALL)
    assert [run.dt for _, run in plan(["free-fall"], ["bdf2"], TIME_STEPS[:3], quick=False)] == list(TIME_STEPS[1:3])
    assert plan(["rotation-oracle"], ["bdf2"], TIME_STEPS, quick=False) == []


@pytest.mark.parametrize(
    ("value", "limit", "must", "verdict", "strain"),
    [
        (1.0, 2.0, True, "pass", 0.5),
        (2.0, 2.0, True, "pass", 1.0),
        (3.0, 2.0, True, "fail", 1.5),
        (3.0, 2.0, False, "reported", 1.5),
        (math.nan, 2.0, True, "fail", math.inf),
        (math.inf, 2.0, True, "fail", math.inf),
        (0.0, 0.0, True, "pass", 0.0),
        (1.0, 0.0, True, "fail", math.inf),
    ],
)
def test_verdicts(value: float, limit: float, must: bool, verdict: str, strain: float) -> None:
    """A limit is inclusive; NaN keeps none; what need not hold does not fail."""
    check = Check("number", value, limit, must)
    assert (check.verdict, check.strain) == (verdict, strain)
    assert check.fails == (verdict == "fail")


def test_drift() -> None:
    """The largest change, relative to the start; NaN stays."""
    vectors = torch.tensor([[[3.0, 0, 4]], [[3.0, 0, 4]], [[3.0, 1, 4]], [[3.0, 0.5, 4]]], dtype=torch.float64)
    assert drift(vectors) == pytest.approx(0.2)
    vectors[2, 0, 1] = math.nan
    assert math.isnan(drift(vectors))


@pytest.mark.parametrize("integrator", ALL)
def test_energy_at_one_time(integrator: str) -> None:
    """A body in free fall keeps its energy to round-off, whichever time its velocity is of. In the middle of a step the parabola is
    above its chord by g Δt²/8, and so the mean height is too low."""
    setup = box_slide(1)
    q = setup.q.clone()
    q[:, 2] += 100.0
    run = Run(integrator, 0.05)
    rollout = run.roll(setup.scene, 1.0, q, setup.v)
    start = setup.scene.energy(q, setup.v)
    expected = start.expand(20, 1)
    below = 9.81**2 * rollout.dt**2 / 8 if integrator in MEAN_VELOCITY else 0.0
    assert relative_error(run.energy(rollout) + below, expected) <= 1e-12
    assert run.gained(rollout, start) == pytest.approx(-below, abs=1e-9)


def test_measure_counts_what_it_took() -> None:
    """World-steps over all rollouts, and how they ended."""

    def thrown(run: Run) -> list[Check]:
        """A box that slides to rest, in five worlds."""
        setup = box_slide(5)
        rollout = run.roll_setup(setup, 0.2)
        rollout.status[0, 0], rollout.status[1, :2] = int(Status.STALLED), int(Status.HALVED)
        return [Check("speed [m/s]", 1.0, 2.0), run.solved()]

    case = Case(thrown, (0.05,), (0.05,))
    result = measure(case, Run("implicit-euler", 0.05))
    assert (result.case, result.steps, result.unsolved) == ("thrown", 20, 1)
    assert result.fallbacks == {"warm_started": 0, "continued": 0, "eased": 0, "halved": 2}
    assert [check.name for check in result.failed] == ["unsolved steps"]
    assert [check["verdict"] for check in result.plain()["checks"]] == ["pass", "fail"]  # type: ignore[attr-defined]


def made(dt: float, *checks: Check, integrator: str = "bdf2", unsolved: int = 0, eased: int = 0) -> Result:
    fallbacks = {"warm_started": 0, "continued": 0, "eased": eased, "halved": 0}
    return Result("fall", integrator, dt, checks, 10, unsolved, fallbacks, "native", 1.0)


def test_cells() -> None:
    """A cell shows a failing number before one that is reported, and that before the one nearest to its limit; the steps of the
    first two; and what it took."""
    calm, near = Check("a", 1e-3, 1.0), Check("b", 0.9, 1.0)
    assert long([made(0.1, calm, near), made(0.05, calm, calm)]) == "pass<br>b: 0.9 ≤ 1"
    over = Check("c", 7.0, 1.0, must=False)
    reported = [made(0.1, calm, over, eased=3), made(0.05, near, eased=1)]
    assert long(reported) == "pass (.1 over)<br>c: 7 > 1<br>e 4"
    assert short(reported) == "pass (.1 over) 7/1 e 4"
    failed = [made(0.1, over, Check("d", 2.0, 1.0), unsolved=2), made(0.05, Check("d", 3.0, 1.0))]
    assert long(failed) == "FAIL .05 .1<br>d: 3 > 1<br>2 unsolved"
    assert table([made(0.1, calm)], ["implicit-euler", "bdf2"], short) == [["fall", "–", "pass 0.001/1"]]
