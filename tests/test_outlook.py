"""What a direction promises: the estimated work against the true one, and the lengths that a search tries first."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.bench.starts import scattered
from pbfd_torch.models import SCENES
from pbfd_torch.solvers.directions import Newton
from pbfd_torch.solvers.searches import Foreseen, FullStep, Trial
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Term
from pbfd_torch.tree.kinematics import Motion, place
from tests.random_trees import SEEDS
from tests.solver_points import Point
from tests.solver_problems import FunctionObjective
from tests.states import implicit
from tests.term_cases import CONTACTS, TERMS, Situation, TermCase, situation
from tests.test_kinematics import tangent

all_terms = pytest.mark.parametrize("case", TERMS, ids=str)
all_trees = pytest.mark.parametrize("seed", SEEDS)
NONE = torch.zeros(1, dtype=torch.float64)


def objective(s: Situation, terms: tuple[Term, ...]) -> BalanceObjective:
    context = s.context(s.q)
    scale = torch.ones(s.articulation.nv, dtype=torch.float64)
    prepared = [term.prepare(context) for term in terms]
    return BalanceObjective(s.articulation, terms, context, (), prepared, scale, scale, 0 * scale)


def rolls(term: Term) -> bool:
    return isinstance(term, Contact) and term.rounded and term.friction is not None


@all_terms
@all_trees
def test_outlook_starts_with_the_true_work_and_slope(case: TermCase, seed: int) -> None:
    """φ(0) = r·d and φ'(0) = d·J d, to 1e-10 relative, of every term beside inertia. Of rolling contacts with friction φ(0) only:
    their slip is taken to grow by ω × n, not by the derivative of the rotation vector."""
    s = situation(seed, (3,))
    balanced = objective(s, (Inertia(), case.build(s)))
    balance, d = balanced.evaluate(s.q), tangent(s.articulation, seed, (3,))
    outlook = balanced.outlook(balance, d)
    work = (balance.residual * d).sum(-1)
    slope = (d * (balance.jacobian @ d[..., None]).squeeze(-1)).sum(-1)
    h = 1e-4
    found = outlook(torch.tensor([0.0, h, -h, h / 2, -h / 2], dtype=torch.float64)[:, None].expand(-1, 3))
    size = float((balance.residual.abs() * d.abs()).sum(-1).max())
    torch.testing.assert_close(found[0], work, rtol=0, atol=1e-12 * size)
    if not rolls(case.build(s)):
        extrapolated = (4 * (found[3] - found[4]) / h - (found[1] - found[2]) / (2 * h)) / 3
        torch.testing.assert_close(extrapolated, slope, rtol=1e-6, atol=1e-6 * float(slope.abs().max()))


@pytest.mark.parametrize("case", [c for c in CONTACTS if not rolls(c.build(situation(0)))], ids=str)
def test_points_move_to_second_order(case: TermCase) -> None:
    """The contact's own work along the true motion, and along the parabolas: the error is of second order in the length (forces are
    right to third order, velocities to second), and below 1e-4 of the work at a length of 1e-3."""
    s = situation(0, (3,))
    term = case.build(s)
    alone = objective(s, (term,))
    prepared = alone.prepared[0]
    d = tangent(s.articulation, 3, (3,))
    assert isinstance(term, Contact)
    placement = place(s.articulation, s.q)
    foretell = term.load(prepared, placement).outlook
    assert foretell is not None
    outlook = foretell(Motion(placement, d))
    with_inertia, only_inertia = objective(s, (Inertia(), term)), objective(s, (Inertia(),))

    def true(a: float) -> Tensor:
        q = alone.retract(s.q, a * d)
        return ((with_inertia.evaluate(q).residual - only_inertia.evaluate(q).residual) * d).sum(-1)

    errors = [float((outlook(torch.full((1, 3), a, dtype=torch.float64))[0] - true(a)).abs().max()) for a in (1e-3, 5e-4)]
    assert errors[0] <= 1e-4 * float(true(0.0).abs().max())
    assert errors[1] <= errors[0] / 3.5


class Told(FunctionObjective):
    """An objective that foretells a given work."""

    def __init__(self, work: Callable[[Tensor], Tensor]) -> None:
        super().__init__(lambda q, ease: q, torch.ones(1, dtype=torch.float64))
        object.__setattr__(self, "work", work)

    def outlook(self, evaluation: object, direction: Tensor) -> Callable[[Tensor], Tensor]:
        return self.work  # type: ignore[attr-defined]


def first_length(work: Callable[[Tensor], Tensor], at_zero: Tensor, rule: Foreseen | FullStep) -> Tensor:
    start = Point(at_zero[..., None], torch.ones(*at_zero.shape, 1, 1, dtype=torch.float64))
    return rule.length(Trial(Told(work), Newton(), start, (), torch.ones_like(at_zero)[..., None]))


def test_first_length_is_the_first_zero_of_the_work() -> None:
    """Worlds `[2, 2]` with a line, a contact met at .3, two zeros after the first, and none up to the full step: each its own
    length, exact for the line and within 1/512 of the others' zeros."""

    def work(a: Tensor) -> Tensor:
        line = 4 * a[..., 0, 0] - 1
        contact = -1 + 1e5 * (a[..., 0, 1] - 0.3).clamp_min(0) ** 2
        wave = torch.sin(2 * math.pi * (1.5 * a[..., 1, 0] + 0.6))
        never = -1 + 0.5 * a[..., 1, 1]
        return torch.stack((torch.stack((line, contact), -1), torch.stack((wave, never), -1)), -2)

    at_zero = work(torch.zeros(1, 2, 2, dtype=torch.float64))[0]
    found = first_length(work, at_zero, Foreseen())
    exact = torch.tensor([[0.25, 0.3 + 10**-2.5], [0.4 / 1.5, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(found, exact, rtol=0, atol=1 / 512)
    assert float(found[0, 0]) == pytest.approx(0.25, abs=1e-12)
    assert float(found[1, 1]) == 1.0
    assert first_length(work, at_zero, FullStep()).tolist() == [[1.0, 1.0], [1.0, 1.0]]


def test_whole_step_where_its_end_will_do() -> None:
    """Worlds whose work ends below zero, though it was above in between, or at a hundredth of the start's, take the whole step; one
    at two hundredths takes the zero. Each does alone what it does among the others, which need no look in between."""

    def works(a: Tensor) -> Tensor:
        return torch.stack(((a[..., 0] - 0.3) * (0.7 - a[..., 0]), 1.009 * a[..., 1] - 1, 1.02 * a[..., 2] - 1), -1)

    at_zero = works(torch.zeros(1, 3, dtype=torch.float64))[0]
    assert first_length(works, at_zero, Foreseen()).tolist() == [1.0, 1.0, pytest.approx(1 / 1.02, abs=1e-12)]
    looked_at: list[int] = []

    def first_two(a: Tensor) -> Tensor:
        looked_at.append(len(a))
        return works(torch.cat((a, a[..., :1]), -1))[..., :2]

    assert first_length(first_two, at_zero[:2], Foreseen()).tolist() == [1.0, 1.0]
    assert looked_at == [1]


def test_first_length_where_the_outlook_fails() -> None:
    """A work that turns NaN counts as past the zero; a zero at once gives the shortest length; an objective that cannot tell gives
    the full step."""
    minus = -torch.ones(1, dtype=torch.float64)
    found = first_length(lambda a: torch.where(a > 0.5, math.nan, -1.0), minus, Foreseen())
    assert 0.49 <= float(found) <= 0.51
    assert float(first_length(lambda a: 1e9 * a - 1, minus, Foreseen())) == 1e-4
    silent = FunctionObjective(lambda q, ease: q, torch.ones(1, dtype=torch.float64))
    start = Point(minus[:, None], torch.ones(1, 1, 1, dtype=torch.float64))
    assert float(Foreseen().length(Trial(silent, Newton(), start, (), torch.ones(1, 1, dtype=torch.float64)))) == 1.0


@pytest.mark.parametrize(("dt", "most"), [(0.02, 6.0), (0.05, 8.0)])
def test_landing_chains_take_few_evaluations(dt: float, most: float) -> None:
    """64 chains from random starts, 2 s: mean evaluations a step, every one of them solved."""
    setup = SCENES["chain-ground"](worlds=64)
    simulator = implicit(setup.scene, dt)
    rollout = simulator.rollout(simulator.initial_state(*scattered(setup)), steps=round(2.0 / dt))
    assert bool(rollout.solved.all())
    assert float(rollout.evaluations.double().mean()) <= most
