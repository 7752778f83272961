"""Fig. 4 of the paper: iterations and time of every step, for the six cases of Table I and our default, on two chains.

Every case solves the same steps, each from the state where the default's rollout had come to, so that iterations compare. The
rollout is the engine's; the cases, whose solvers are compared, are solved in PyTorch, all of them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.bench.timing import Progress, timed, worst
from pbfd_torch.integrators.integrator import State
from pbfd_torch.models.chains import LENGTH
from pbfd_torch.models.setup import Setup
from pbfd_torch.native.engine import Engine
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.named import TABLE_1, OnLagged, OnSquares
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.stepping.stepper import Solver
from pbfd_torch.tree.kinematics import place

CHAINS = ("chain-fixed", "chain-ground")
DEFAULT = "default"
CASES = (*TABLE_1, DEFAULT)
REFERENCE_TOLERANCE = 1e-12
# Evaluations that a case may spend on one step before it is given up. First-order steps are many and cheap; LM on GE pays for
# third derivatives, fifty evaluations' worth in each.
BUDGETS = {"L-BFGS, E": 1000, "L-BFGS, GE": 1000, "LM, GE": 50}
USUAL_BUDGET = 400
NOTES = (
    (
        "every case solves the same steps, in PyTorch, each from the state where the default's rollout had come to; the time is "
        "that of the solve"
    ),
    (
        "on E friction is lagged, i.e. held at the normal forces at the start of the step, because Coulomb friction is no energy: "
        "where something touches, these cases solve another problem, and their tip error says how far off that is"
    ),
    "tip error: distance of the chain's tip, after one step, from that of a solve of the same step to 1e-12 (or to rounding)",
    (
        "an unsolved step has the iterations and the time spent until it stalled or its budget of evaluations was used up: solving "
        "it would cost more"
    ),
    "a case is measured at steps spread evenly over the motion until its time is spent; '× default' compares the same steps",
)


@dataclass(frozen=True, eq=False)
class GivenStep:
    """A step that every case is to solve; `tip`: `[worlds, 3]` [m] where the chain's tip truly ends."""

    objective: BalanceObjective
    start: Tensor
    tip: Tensor
    reference_residual: float


@dataclass(frozen=True)
class StepCost:
    """How one case solved one step: `iterations` and `evaluations` are means over the worlds, errors the worst of them."""

    step: int
    seconds: float
    iterations: float
    most_iterations: int
    evaluations: float
    unsolved: int
    residual_norm: float
    tip_error_m: float


def solver_for(case: str) -> Solver:
    """The case's solver, with its budget."""
    return Fallbacks() if case == DEFAULT else with_budget(TABLE_1[case](), BUDGETS.get(case, USUAL_BUDGET))


def with_budget(solver: Solver, evaluations: int) -> Solver:
    """The same descent with another limit of evaluations per step and world; the default's fallbacks have their own."""
    if isinstance(solver, OnLagged | OnSquares):
        return dataclasses.replace(solver, solver=dataclasses.replace(solver.solver, max_evaluations=evaluations))
    return dataclasses.replace(solver, max_evaluations=evaluations) if isinstance(solver, Descent) else solver


def tip(objective: BalanceObjective, q: Tensor) -> Tensor:
    """Far end of the last link `[*batch, 3]` [m]."""
    last = place(objective.articulation, q).poses[..., -1, :3, :]
    return last[..., 3] + LENGTH * last[..., 0]


def given_steps(simulator: Simulator[Any], setup: Setup, steps: int) -> list[GivenStep]:
    """The steps of the default's rollout, with their reference solutions."""
    reference = Descent(tolerance=REFERENCE_TOLERANCE)
    state: State = simulator.initial_state(setup.q, setup.v)
    given = []
    for _ in range(steps):
        objective = simulator.objective(state)
        start = state.q
        state, found = simulator.step(state)
        exact, error = polished(objective, reference.solve(objective, found.q).q)
        given.append(GivenStep(objective, start, tip(objective, exact), float(error.max())))
    return given


def polished(objective: BalanceObjective, q: Tensor) -> tuple[Tensor, Tensor]:
    """One more step of Newton's, so that no case is compared with its own point, and ‖r/…‖ `[*batch]` there."""
    with torch.no_grad():
        balance = objective.evaluate(q)
        step, _ = torch.linalg.solve_ex(balance.jacobian, -balance.residual)
        q = objective.retract(q, step)
        return q, objective.error(objective.evaluate(q), REFERENCE_TOLERANCE)


def spread(count: int) -> Iterator[int]:
    """0 … count − 1, each prefix spread evenly over the range (van der Corput's order)."""
    bits = max(1, (count - 1).bit_length())
    for k in range(1 << bits):
        place_of_k = int(f"{k:0{bits}b}"[::-1], 2)
        if place_of_k < count:
            yield place_of_k


def solve_step(solver: Solver, given: GivenStep, number: int, repeats: int) -> StepCost:
    """Times one step."""

    def call() -> Solution:
        return solver.solve(given.objective, given.objective.guess, given.start)

    solution, seconds = timed(lambda: call, repeats)
    away = torch.linalg.vector_norm(tip(given.objective, solution.q) - given.tip, dim=-1)
    return StepCost(
        step=number,
        seconds=seconds,
        iterations=float(solution.iterations.to(torch.float64).mean()),
        most_iterations=int(solution.iterations.max()),
        evaluations=float(solution.evaluations.to(torch.float64).mean()),
        unsolved=int((~solution.solved).sum()),
        residual_norm=float(solution.residual_norm.max()),
        tip_error_m=float(away.max()),
    )


def measure_cases(given: Sequence[GivenStep], seconds: float, repeats: int, progress: Progress) -> dict[str, list[StepCost]]:
    """Times the steps in a spread order, each case until `seconds` are spent on it, the default always. All cases take their turn
    at a step, so that they share what else the machine does. The results are in the steps' own order."""
    solvers = {case: solver_for(case) for case in CASES}
    costs: dict[str, list[StepCost]] = {case: [] for case in CASES}
    with torch.no_grad():
        for solver in solvers.values():  # a few evaluations load what is loaded once; a full solve may take seconds
            solve_step(with_budget(solver, 3), given[0], 0, repeats=1)
        for number in spread(len(given)):
            for case, solver in solvers.items():
                if case == DEFAULT or sum(cost.seconds for cost in costs[case]) < seconds:
                    costs[case].append(solve_step(solver, given[number], number, repeats))
                progress(1)
    return {case: sorted(found, key=lambda cost: cost.step) for case, found in costs.items()}


def summary(costs: Sequence[StepCost], beside: Sequence[StepCost]) -> dict[str, Any]:
    """Mean, 95th percentile and maximum over the measured steps, with the largest errors; beside: the default's steps."""
    times = [1e3 * cost.seconds for cost in costs]
    others = {cost.step: 1e3 * cost.seconds for cost in beside}
    solved = [cost.tip_error_m for cost in costs if cost.unsolved == 0]
    return {
        "measured_steps": len(costs),
        "unsolved_steps": sum(cost.unsolved > 0 for cost in costs),
        "iterations": _spread_of([cost.iterations for cost in costs]) | {"max": max(cost.most_iterations for cost in costs)},
        "time_ms": _spread_of(times),
        "time_of_default": sum(times) / sum(others[cost.step] for cost in costs),
        "residual_norm_max": worst([cost.residual_norm for cost in costs]),
        "tip_error_max_m": worst([cost.tip_error_m for cost in costs]),
        "tip_error_max_solved_m": worst(solved) if solved else None,
    }


def _spread_of(values: Sequence[float]) -> dict[str, float]:
    ascending = sorted(values)
    count = len(ascending)
    return {"mean": sum(ascending) / count, "p95": ascending[math.ceil(0.95 * count) - 1], "max": ascending[-1]}


def measure_chain(
    setup: Setup, dt: float, steps: int, seconds: float, repeats: int, progress: Progress, engine: Engine | None = None
) -> dict[str, Any]:
    """One column of Fig. 4 as plain data; `engine`: of the rollout that the cases are given steps of."""
    simulator = Simulator(setup.scene, dt, engine=engine)
    given = given_steps(simulator, setup, steps)
    costs = measure_cases(given, seconds, repeats, progress)
    return {
        "engine": simulator.engine,
        "dt": dt,
        "steps": steps,
        "worlds": setup.worlds,
        "reference_residual_norm_max": worst([step.reference_residual for step in given]),
        "cases": {case: summary(found, costs[DEFAULT]) | _details(case, found) for case, found in costs.items()},
    }


def _details(case: str, costs: Sequence[StepCost]) -> dict[str, Any]:
    """The case's budget of evaluations per step (None: the default's own, in its fallbacks) and its curves."""
    budget = None if case == DEFAULT else BUDGETS.get(case, USUAL_BUDGET)
    curves = {field.name: [getattr(cost, field.name) for cost in costs] for field in dataclasses.fields(StepCost)}
    return {"budget": budget, "per_step": curves}
