"""Fallbacks: the detours of unsolved worlds, their order, their counts, and what they leave alone; and halved steps."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.models.boxes import box_slide
from pbfd_torch.models.chains import chain_slope_drop
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import STIFFNESSES, WIDTHS, Continuation, Fallbacks, WarmStart
from pbfd_torch.solvers.objective import Relaxable, Solution, Status
from pbfd_torch.terms.inertia import Inertia
from tests.solver_problems import FULL, SECANT, Ease, FunctionObjective, problem
from tests.states import implicit

SHORT, LONG = Descent(search=SECANT, max_evaluations=8), Descent(search=SECANT, max_evaluations=50)
LANDING = problem("stiff contact")
ROOT = LANDING.root[0]
HARD, EASY = 0.05, -0.0031  # starts from which 8 evaluations do not and do suffice


def landing(helps: str) -> FunctionObjective:
    """The stiff contact, whose easier problems of one kind ("lagged", "wide", "soft") are linear with a root close to its own; all
    others of them have their root far away."""

    def residual(q: Tensor, ease: Ease) -> Tensor:
        if ease == FULL:
            force = (-q).clamp_min(0) ** 2 * 1e5
            return 10 * (q + 0.1) - force
        kind = "lagged" if ease.lagged else "wide" if ease.width > 1 else "soft"
        return 100 * (q - (ROOT * 1.001 if kind == helps else HARD))

    return FunctionObjective(residual, torch.ones(1, dtype=torch.float64))


def starts(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


@pytest.mark.parametrize(
    ("helps", "status", "tried"),
    [
        ("lagged", Status.WARM_STARTED, [1, 0, 0, 0]),
        ("wide", Status.CONTINUED, [1, 1, 0, 0]),
        ("soft", Status.CONTINUED, [1, 2, 0, 0]),
    ],
)
def test_detours_in_their_order(helps: str, status: Status, tried: list[int]) -> None:
    """Warm start, then continuation in width, then in stiffness, each only if those before did not solve; status and `fallbacks`
    say which. The evaluations are those of all tries."""
    objective = landing(helps)
    solution = Fallbacks(SHORT, SHORT).solve(objective, starts(HARD))
    assert solution.status.tolist() == [status]
    assert bool(solution.solved.all())
    assert solution.fallbacks.tolist() == [tried]
    assert float(solution.q) == pytest.approx(ROOT, rel=1e-9)
    assert int(solution.evaluations) == len(objective.calls) == solution.lanes
    order = [k for k, call in enumerate(objective.calls) if k == 0 or call != objective.calls[k - 1]]
    stages = [objective.calls[k] for k in order]
    lagged, wide = [Ease(lagged=True), FULL], [*(Ease(width=w) for w, _ in WIDTHS.ladder), FULL]
    soft = [*(Ease(share=s) for _, s in STIFFNESSES.ladder), FULL]
    assert stages == [FULL, *lagged, *(wide if tried[1] > 0 else []), *(soft if tried[1] > 1 else [])]


def test_solved_worlds_are_left_alone() -> None:
    """Only the unsolved world takes detours: the others keep bitwise what the direct way gave, with its counts."""
    guess = starts(EASY, HARD, EASY * 1.01)
    alone = SHORT.solve(landing("wide"), guess)
    assert alone.status.tolist() == [Status.SOLVED, Status.ITERATION_LIMIT, Status.SOLVED]
    solution = Fallbacks(SHORT, SHORT).solve(landing("wide"), guess)
    assert solution.status.tolist() == [Status.SOLVED, Status.CONTINUED, Status.SOLVED]
    assert solution.fallbacks.tolist() == [[0, 0, 0, 0], [1, 1, 0, 0], [0, 0, 0, 0]]
    for k in (0, 2):
        assert torch.equal(solution.q[k], alone.q[k])
        for name in ("residual_norm", "iterations", "evaluations"):
            assert torch.equal(getattr(solution, name)[k], getattr(alone, name)[k])
    assert int(solution.evaluations[1]) > int(alone.evaluations[1])
    assert solution.lanes >= int(solution.evaluations.sum())


def test_detours_keep_the_batch_shape() -> None:
    """Worlds `[2, 2]`: the same as `[4]`, and as each alone."""
    guess = starts(EASY, HARD, HARD * 1.1, EASY)
    flat = Fallbacks(SHORT, SHORT).solve(landing("soft"), guess)
    shaped = Fallbacks(SHORT, SHORT).solve(landing("soft"), guess.view(2, 2, 1))
    single = Fallbacks(SHORT, SHORT).solve(landing("soft"), guess[1])
    for name in ("q", "status", "residual_norm", "iterations", "evaluations", "fallbacks"):
        value = getattr(shaped, name)
        assert value.shape[:2] == (2, 2)
        assert torch.equal(value.flatten(0, 1), getattr(flat, name))
        assert torch.equal(value[0, 1], getattr(single, name))


def test_climbing_the_ladder() -> None:
    """Where the direct way fails, stages run with the softened problem at the ladder's shares, then the full one."""
    soft = Continuation(((1.0, 1e-3), (1.0, 1e-1)), tolerance=1e-2)
    objective = LANDING.objective(torch.float64)
    solution = Fallbacks(SHORT, LONG, detours=(soft,)).solve(objective, starts(HARD, EASY))
    alone = SHORT.solve(LANDING.objective(torch.float64), starts(HARD, EASY))
    assert alone.status.tolist() == [Status.ITERATION_LIMIT, Status.SOLVED]
    assert solution.status.tolist() == [Status.CONTINUED, Status.SOLVED]
    assert float(solution.q[0]) == pytest.approx(ROOT, rel=1e-9)
    assert torch.equal(solution.q[1], alone.q[1])
    assert int(solution.evaluations[1]) == int(alone.evaluations[1])
    assert sorted({call.share for call in objective.calls}) == [1e-3, 1e-1, 1.0]
    assert int(alone.evaluations[0]) < int(solution.evaluations[0]) <= len(objective.calls)


def test_both_sides_of_a_stage_count() -> None:
    """A rung that is wide and soft makes the problem both; a rung of (1, 1) is the problem itself."""
    objective = landing("wide")
    ladder = Continuation(((10.0, 0.1), (1.0, 1.0)))
    once = Descent(max_evaluations=1)
    Fallbacks(once, once, detours=(ladder,), stage=once).solve(objective, starts(HARD))
    assert objective.calls == [FULL, Ease(share=0.1, width=10.0), FULL, FULL]


def test_failure_is_reported() -> None:
    """Where the detours fail as well, the world stays unsolved, all tries are counted, and the point with the smallest residual
    stays."""
    objective = FunctionObjective(lambda q, ease: q * q + 1, torch.ones(1, dtype=torch.float64))
    brief = Descent(max_evaluations=10)
    first = brief.solve(objective, torch.tensor([3.0], dtype=torch.float64))
    before = len(objective.calls)
    solution = Fallbacks(brief, brief).solve(objective, torch.tensor([3.0], dtype=torch.float64))
    assert int(solution.status) in (Status.STALLED, Status.ITERATION_LIMIT)
    assert solution.fallbacks.tolist() == [1, 2, 0, 0]
    assert float(solution.residual_norm) <= float(first.residual_norm)
    assert float(solution.residual_norm) == pytest.approx(float(solution.q) ** 2 + 1, rel=1e-12)
    assert int(solution.evaluations) == len(objective.calls) - before


def test_worse_end_of_a_detour_is_dropped() -> None:
    """A detour that leads away, to where the last solver gets no better: q, status and residual are those of the direct way."""

    def residual(q: Tensor, ease: Ease) -> Tensor:
        return q * q + 1 if ease == FULL else q - 1e6

    objective = FunctionObjective(residual, torch.ones(1, dtype=torch.float64))
    direct = SHORT.solve(objective, starts(3.0))
    solution = Fallbacks(SHORT, Descent(max_evaluations=1), detours=(WarmStart(),)).solve(objective, starts(3.0))
    for name in ("q", "status", "residual_norm"):
        assert torch.equal(getattr(solution, name), getattr(direct, name))
    assert solution.fallbacks.tolist() == [[1, 0, 0, 0]]
    assert int(solution.evaluations) > int(direct.evaluations)


def test_non_finite_worlds_take_no_detour() -> None:
    """NaN at the start: NON_FINITE, and nothing else is tried."""
    solution = Fallbacks(SHORT, SHORT).solve(landing("wide"), starts(float("nan"), EASY))
    assert solution.status.tolist() == [Status.NON_FINITE, Status.SOLVED]
    assert solution.fallbacks.tolist() == [[0, 0, 0, 0], [0, 0, 0, 0]]


def test_steps_that_a_short_search_cannot_solve() -> None:
    """The first steps after an impact: with 10 evaluations the search alone leaves worlds unsolved, fallbacks with the same search
    solve them all."""
    setup = chain_slope_drop(worlds=1)
    short = Descent(max_evaluations=10)
    helped = implicit(setup.scene, 0.05, solver=Fallbacks(direct=short), halvings=0)
    alone = implicit(setup.scene, 0.05, solver=short, halvings=0)
    state = helped.initial_state(setup.q, setup.v)
    failures = 0
    for _ in range(20):
        failures += int((~alone.step(state)[1].solved).sum())
        state, solution = helped.step(state)
        assert bool(solution.solved.all())
    assert failures > 0


# Halved steps ---------------------------------------------------------------------------------------------------------

DT = 0.02
GRAVITY = 9.81


@dataclass
class Weak:
    """Solves steps up to `longest` [s] only, and worlds at x ≤ 10 m always. Where it fails it leaves a tenth of the weight; `asked`
    lists the steps asked for, by their length."""

    longest: float
    asked: list[float] = field(default_factory=list)

    def solve(self, objective: Relaxable, guess: Tensor, retreat: Tensor | None = None) -> Solution:
        assert isinstance(objective, BalanceObjective)
        dt = float(objective.step.dt)
        self.asked.append(dt)
        solution = Descent().solve(objective, guess, retreat)
        fails = (guess[..., 0] > 10) & (dt > self.longest)
        status = torch.where(fails, int(Status.STALLED), solution.status)
        return dataclasses.replace(solution, status=status, residual_norm=torch.where(fails, 0.1, solution.residual_norm))


def falling(solver: Weak, halvings: int) -> Simulator:
    """A box high above everything."""
    setup = box_slide(1)
    scene = Scene(setup.scene.articulation, (Inertia(),), setup.scene.gravity)
    return implicit(scene, DT, solver=solver, halvings=halvings)


def thrown(simulator: Simulator) -> tuple[Tensor, Tensor]:
    """Three boxes thrown and turning, the middle one at x = 11 m."""
    a = simulator.scene.articulation
    q, v = a.rest.repeat(3, 1), torch.zeros(3, a.nv, dtype=torch.float64)
    q[1, 0] = 11.0
    v[:, :3] = torch.tensor([1.0, -0.5, 2.0], dtype=torch.float64)
    v[:, 3:] = torch.tensor([0.3, 0.2, -0.4], dtype=torch.float64)
    return q, v


@pytest.mark.parametrize(("longest", "halved"), [(0.011, 1), (0.006, 2), (0.003, 3)])
def test_step_in_halves(longest: float, halved: int) -> None:
    """A world that only shorter steps solve is HALVED, 2, 4, 8 … at once; the others are bitwise what they are without halvings."""
    solver = Weak(longest)
    simulator, plain = falling(solver, 3), falling(Weak(longest), 0)
    state = simulator.initial_state(*thrown(simulator))
    solver.asked.clear()
    after, solution = simulator.step(state)
    expected, unhelped = plain.step(state)
    parts = [DT / 2**k for k in range(1, halved + 1) for _ in range(2**k)]
    assert solver.asked == pytest.approx([DT, *parts])
    assert solution.status.tolist() == [Status.SOLVED, Status.HALVED, Status.SOLVED]
    assert unhelped.status.tolist() == [Status.SOLVED, Status.STALLED, Status.SOLVED]
    assert solution.fallbacks.tolist() == [[0, 0, 0, 0], [0, 0, 0, halved], [0, 0, 0, 0]]
    assert unhelped.fallbacks.tolist() == [[0, 0, 0, 0]] * 3
    for k in (0, 2):
        assert torch.equal(after.q[k], expected.q[k])
        assert torch.equal(after.q_previous[k], expected.q_previous[k])
        assert torch.equal(solution.evaluations[k], unhelped.evaluations[k])
    assert int(solution.evaluations[1]) >= int(unhelped.evaluations[1]) + 2 ** (halved + 1) - 2
    assert float(solution.residual_norm[1]) <= 1e-9


def test_halved_free_fall() -> None:
    """Two steps of h = Δt/2 end where the whole step would have, z lower by g Δt² than the last average velocity leads to: the
    short ones know the acceleration. The next state goes on with the average velocity of a whole step, lower by g Δt."""
    simulator = falling(Weak(0.011), 1)
    q, v = thrown(simulator)
    v[:, 3:] = 0.0
    state = simulator.initial_state(q, v)
    after, solution = simulator.step(state)
    assert int(solution.status[1]) == Status.HALVED
    a, dt = simulator.scene.articulation, torch.tensor(DT, dtype=torch.float64)
    before, gone = (simulator.integrator.velocity(a, x, dt)[1, :3] for x in (state, after))
    gravity = torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64)
    torch.testing.assert_close(gone, before + DT * gravity, rtol=0, atol=1e-9)
    moved = after.q[1, :3] - state.q[1, :3]
    torch.testing.assert_close(moved, DT * before + DT * DT * gravity, rtol=0, atol=1e-10)
    exact = DT * v[1, :3] + 0.5 * DT * DT * gravity
    assert float((moved - exact).norm()) <= GRAVITY * DT * DT
    assert torch.equal(after.q, torch.where(solution.solved[:, None], after.q, solution.q))


def test_halving_that_does_not_help() -> None:
    """Still unsolved after the last halving: the state, status and residual of the whole step stay, and the tries are counted."""
    simulator, plain = falling(Weak(0.0), 2), falling(Weak(0.0), 0)
    state = plain.initial_state(*thrown(plain))
    after, solution = simulator.step(state)
    expected, unhelped = plain.step(state)
    assert solution.status.tolist() == unhelped.status.tolist() == [Status.SOLVED, Status.STALLED, Status.SOLVED]
    assert torch.equal(after.q, expected.q)
    assert torch.equal(after.q_previous, expected.q_previous)
    assert torch.equal(solution.residual_norm, unhelped.residual_norm)
    assert solution.fallbacks.tolist() == [[0, 0, 0, 0], [0, 0, 0, 2], [0, 0, 0, 0]]


def test_halves_are_never_shorter_than_the_shortest_step() -> None:
    """Δt = 1.5e-5 s: half of it would be refused as a step, so it is not tried."""
    setup = box_slide(1)
    scene = Scene(setup.scene.articulation, (Inertia(),), setup.scene.gravity)
    simulator = implicit(scene, 1.5e-5, solver=Weak(0.0), halvings=3)
    state = simulator.initial_state(*thrown(simulator))
    _, solution = simulator.step(state)
    assert solution.status.tolist() == [Status.SOLVED, Status.STALLED, Status.SOLVED]
    assert solution.fallbacks.tolist() == [[0, 0, 0, 0]] * 3


def test_guess_is_tried_after_all() -> None:
    """3 tanh q = 0: ‖r‖ = 2.3 at the guess 1 sends the search to the retreat, 20, where J is 1e-17 and the budget runs out.

    From the guess itself it takes a few evaluations, which are counted too; no fallback is. Without a retreat nothing is tried
    twice."""
    objective = FunctionObjective(lambda q, ease: 3 * torch.tanh(q), torch.ones(1, dtype=torch.float64))
    guess, retreat = (torch.tensor([x], dtype=torch.float64) for x in (1.0, 20.0))
    brief = Descent(max_evaluations=8)
    assert int(brief.solve(objective, guess, retreat).status) == Status.ITERATION_LIMIT
    solution = Fallbacks(brief, Descent(max_evaluations=20), detours=()).solve(objective, guess, retreat)
    alone = brief.solve(objective, guess)
    assert int(solution.status) == Status.SOLVED
    assert torch.equal(solution.q, alone.q)
    assert int(solution.evaluations) == 8 + int(alone.evaluations)
    assert solution.fallbacks.tolist() == [0, 0, 0, 0]
    once = Descent(max_evaluations=1)
    assert int(Fallbacks(once, once, detours=()).solve(objective, guess).evaluations) == 1


def test_halved_steps_of_a_chain() -> None:
    """An impact at Δt = .05 with 14 evaluations and no detours: halving solves steps that are unsolved without it."""
    setup = chain_slope_drop(worlds=1)
    hasty = Fallbacks(Descent(max_evaluations=14), Descent(max_evaluations=14), detours=())
    helped, alone = (implicit(setup.scene, 0.05, solver=hasty, halvings=n) for n in (3, 0))
    state = helped.initial_state(setup.q, setup.v)
    seen: set[int] = set()
    for _ in range(7):
        unhelped = alone.step(state)[1]
        state, solution = helped.step(state)
        seen |= set(solution.status.tolist())
        assert bool(torch.isfinite(state.q).all())
        assert bool(unhelped.solved.all()) == (int(solution.fallbacks[0, 3]) == 0)
    assert int(Status.HALVED) in seen
