"""Every solver on steps of the simulator: a swinging pendulum, sliding boxes, landing chains. All that solve a step agree; what
does not is listed, with the reason."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective, EnergyObjective
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.models.boxes import box_slide
from pbfd_torch.models.chains import STIFFNESS, chain_colliders, chain_ground, chain_links
from pbfd_torch.models.setup import tilted
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import place
from tests.random_trees import generator
from tests.solver_problems import METHODS, ROOT_METHODS, changed
from tests.states import implicit

both_dtypes = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
AGREEMENT = 1e-8
TIGHT = 1e-11  # of the force scale: at the default tolerance, a chain's soft modes leave more than AGREEMENT to move
ENOUGH = 800  # evaluations; L-BFGS needs 400 to 600 to that tolerance, as rounding has it


@dataclass(frozen=True, eq=False)
class Step:
    """A step to be solved: `guess` and the safer `retreat` of its solvers, and Newton's `root`."""

    objective: BalanceObjective
    guess: Tensor
    retreat: Tensor
    root: Tensor

    @property
    def energy(self) -> EnergyObjective:
        """The minimisation with the friction lagged at the root, whose minimiser is therefore the root again."""
        return self.objective.lagged(self.root)


def _chain(links: int, dtype: torch.dtype, free: bool) -> Simulator:
    articulation = Articulation.from_links(chain_links(links, free=free), dtype, torch.device("cpu"))
    terms: list[Term] = [Inertia()]
    if free:
        ground = HalfSpace()
        terms.append(Contact.between(articulation, chain_colliders(links), ground, NormalForce(STIFFNESS), CoulombFriction(0.5)))
    return implicit(Scene(articulation, tuple(terms), torch.tensor([0.0, 0.0, -9.81], dtype=dtype)), 0.02)


def _step(simulator: Simulator, q: Tensor, v: Tensor | None, steps: int) -> Step:
    state = simulator.initial_state(q, v)
    for _ in range(steps):
        state, _ = simulator.step(state)
    objective = simulator.objective(state)
    fine = Descent(tolerance=1e-13) if q.dtype == torch.float64 else Descent()
    solution = fine.solve(objective, objective.guess, state.q)
    assert bool(solution.solved.all())
    return Step(objective, objective.guess, state.q, solution.q)


def _landing(simulator: Simulator, q: Tensor, v: Tensor | None) -> Step:
    """The first step that ends in contact."""
    contact = next(term for term in simulator.scene.terms if isinstance(term, Contact))
    for steps in range(40):
        step = _step(simulator, q, v, steps)
        if bool((contact.depth(place(simulator.scene.articulation, step.root)) > 0).any()):
            return step
    raise AssertionError("it does not land")


def _pendulum(dtype: torch.dtype) -> Step:
    simulator = _chain(1, dtype, free=False)
    return _step(simulator, torch.tensor([[0.3], [1.4]], dtype=dtype), None, 5)


def _boxes(dtype: torch.dtype) -> Step:
    setup = box_slide(5, dtype)
    return _step(implicit(setup.scene, setup.dt), setup.q, setup.v, 5)


def _short_landing(links: int, dtype: torch.dtype) -> Step:
    simulator = _chain(links, dtype, free=True)
    q = simulator.scene.articulation.rest.clone()
    q[2] = 0.04 + 0.05 * links
    q[3:7] = tilted(math.radians(30), dtype, torch.device("cpu"))
    return _landing(simulator, q[None], None)


def _long_landing(dtype: torch.dtype) -> Step:
    setup = chain_ground(1, dtype)
    return _landing(implicit(setup.scene, setup.dt), setup.q, setup.v)


STEPS: dict[str, Callable[[torch.dtype], Step]] = {
    "pendulum": _pendulum,
    "sliding boxes": _boxes,
    "two links landing": lambda dtype: _short_landing(2, dtype),
    "three links landing": lambda dtype: _short_landing(3, dtype),
    "ten links landing": _long_landing,
}


@functools.cache
def step_of(name: str, dtype: torch.dtype) -> Step:
    """The step, made once."""
    return STEPS[name](dtype)


FLAT = "½‖r‖² squares the condition number, here about 1e7: first-order progress only, the budget of 400 evaluations runs out"
SHALLOW = "½‖r‖² falls to a non-zero minimum first (the gap of Lemma 4.2), and further only along its bottom: the budget runs out"
MANY = "ten links pushed together: about 2000 evaluations, more than the budget"
ROOT_LIMITS = {("ten links landing", "L-BFGS on GE"): FLAT}
ENERGY_LIMITS = {
    ("two links landing", "JTJ-LM"): SHALLOW,
    ("three links landing", "JTJ-LM"): SHALLOW,
    ("ten links landing", "L-BFGS on GE"): FLAT,
    ("ten links landing", "L-BFGS"): MANY,
}
# One exact Hessian of ½‖r‖² costs a backward pass per degree of freedom, and LM on GE takes 90 to 400 of them from the guess of a
# landing: it is started near the root there.
COSTLY = [(case, "LM on GE") for case in STEPS if "landing" in case]


def start_of(step: Step, case: str, name: str) -> Tensor:
    """Where the method starts."""
    if (case, name) not in COSTLY:
        return step.guess
    away = 1e-6 * torch.randn(step.objective.scale.shape, dtype=torch.float64, generator=generator(3))
    return step.objective.retract(step.root, away.to(step.root.dtype))


def assert_reached(step: Step, solution: Solution, known: str | None) -> None:
    """The root to 1e-8, or, with a known limit, an honest ITERATION_LIMIT."""
    if known is not None:
        assert solution.status.tolist() == [Status.ITERATION_LIMIT] * len(step.root)
        assert float(solution.residual_norm.min()) > TIGHT
        assert not bool(solution.solved.any())
        return
    assert solution.status.tolist() == [Status.SOLVED] * len(step.root)
    assert float((solution.q - step.root).abs().max()) <= AGREEMENT


@pytest.mark.parametrize("name", ROOT_METHODS)
@pytest.mark.parametrize("case", STEPS)
def test_root_methods_agree(case: str, name: str) -> None:
    """Wherever GE reaches 0, all methods reach the same q to 1e-8; the others say that they did not solve it."""
    step = step_of(case, torch.float64)
    method = changed(ROOT_METHODS[name], tolerance=TIGHT, max_evaluations=ENOUGH)
    assert_reached(step, method.solve(step.objective, start_of(step, case, name), step.retreat), ROOT_LIMITS.get((case, name)))


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("case", STEPS)
def test_methods_agree_on_the_minimum(case: str, name: str) -> None:
    """With the friction lagged at the step's end, that end is the energy's minimiser: those that minimise E and those that look for
    the root of its gradient reach it to 1e-8."""
    step = step_of(case, torch.float64)
    method = changed(METHODS[name], tolerance=TIGHT, max_evaluations=ENOUGH)
    assert_reached(step, method.solve(step.energy, start_of(step, case, name), step.retreat), ENERGY_LIMITS.get((case, name)))


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("case", STEPS)
def test_single_precision_is_solved_or_says_so(case: str, name: str) -> None:
    """float32 at its default tolerance 1e-3: the force is balanced to that, or the world is unsolved; never NaN. Newton's methods
    and JTJ-LM solve all steps."""
    step = step_of(case, torch.float32)
    objective = step.objective if name in ROOT_METHODS else step.energy
    method = changed(METHODS[name], max_evaluations=10) if (case, name) in COSTLY else METHODS[name]
    solution = method.solve(objective, step.guess, step.retreat)
    error = objective.error(objective.evaluate(solution.q), 1e-3)
    assert solution.q.dtype == torch.float32
    assert bool(torch.isfinite(solution.q).all())
    assert torch.equal(solution.solved, error <= 1e-3)
    torch.testing.assert_close(error, solution.residual_norm, rtol=1e-2, atol=1e-5)
    if name not in ("LM on GE", "L-BFGS on GE", "L-BFGS"):
        assert bool(solution.solved.all())


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("case", STEPS)
@both_dtypes
def test_root_as_guess_comes_back_bitwise(case: str, name: str, dtype: torch.dtype) -> None:
    """Guess = solution: 0 iterations, 1 evaluation, and the guess itself."""
    step = step_of(case, dtype)
    objective = step.objective if name in ROOT_METHODS else step.energy
    solution = METHODS[name].solve(objective, step.root, step.retreat)
    count = len(step.root)
    assert torch.equal(solution.q, step.root)
    assert solution.status.tolist() == [Status.SOLVED] * count
    assert solution.iterations.tolist() == [0] * count
    assert solution.evaluations.tolist() == [1] * count
