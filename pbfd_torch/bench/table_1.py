"""Table I of the paper: what one iteration costs, substep by substep, over the number of degrees of freedom."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective, EnergyObjective
from pbfd_torch.bench.timing import Progress, exponent, fit_sizes, timed, worst
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.models.chains import GRAVITY, RADIUS, STIFFNESS, chain_colliders, chain_links
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.directions import Direction, GaussNewtonLm, JtjLm, Lm, Model, Newton, times
from pbfd_torch.solvers.lbfgs import Lbfgs
from pbfd_torch.solvers.objective import Objective
from pbfd_torch.solvers.squared import Squared
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation

DT = 0.01  # [s]
DAMPING = 1e-3
STEADY_S = 0.1  # [s] that short calls are repeated for: longer than what disturbs them
AUTODIFF_SHARE = 16  # the batch is smaller by this where third derivatives are taken: they need that much more memory and time

SUBSTEPS = {
    "gradient_E": "∂E/∂θ",
    "gauss_newton_E": "Gauss–Newton matrix K of E",
    "hessian_E": "exact Hessian of E (J of GE)",
    "gradient_GE": "∂GE/∂θ = Jᵀr",
    "jtj_GE": "product JᵀJ",
    "hessian_GE": "exact Hessian of GE (autodiff)",
    "lu": "linear solve, LU",
    "qr": "linear solve of JTJ-LM, QR",
    "two_loop": "L-BFGS two-loop recursion",
}
NOTES = (
    (
        "an iteration is evaluation, merit, model and step of our implementation, without its search, and takes only the "
        "substeps that it needs: JTJ-LM's QR factorises [J; √λ D] and needs no JᵀJ; LM and the default solve with exact and convex "
        "matrix at once"
    ),
    "the paper's exponents are for a GPU with one core per degree of freedom; on a CPU its inversion is O(n³)",
    "exponents are fitted over the larger sizes only; where they are below the paper's, overhead and cheap arithmetic still rule",
    (
        "errors: gradient against the differences of E, Hessians against those of the gradients, solves by what they leave over, "
        "the two-loop recursion by its secant equation; the worst of all sizes, in one world"
    ),
)


class Row(NamedTuple):
    """A row of Table I: the substep that plays each part, and the paper's exponents of gradient, Hessian, inversion and total;
    None: '/'."""

    gradient: str
    hessian: str | None
    solve: str
    paper: tuple[int, int | None, int | None, int]
    paper_cpu_total: int


ROWS = {
    "LM, E": Row("gradient_E", "hessian_E", "lu", (1, 2, 2, 2), 3),
    "JTJ-LM, E": Row("gradient_E", "gauss_newton_E", "lu", (1, 2, 2, 2), 3),
    "L-BFGS, E": Row("gradient_E", None, "two_loop", (1, None, None, 1), 1),
    "LM, GE": Row("gradient_GE", "hessian_GE", "lu", (2, 3, 2, 3), 3),
    "JTJ-LM, GE": Row("gradient_GE", "jtj_GE", "qr", (2, 2, 2, 2), 3),
    "L-BFGS, GE": Row("gradient_GE", None, "two_loop", (2, None, None, 2), 2),
}
DIRECTIONS: dict[str, Direction] = {
    "LM, E": Lm(),
    "JTJ-LM, E": GaussNewtonLm(),
    "L-BFGS, E": Lbfgs(),
    "LM, GE": Lm(),
    "JTJ-LM, GE": JtjLm(),
    "L-BFGS, GE": Lbfgs(),
    "default": Newton(),
}


@dataclass(frozen=True)
class Variant:
    """Attributes:
    worlds: in the batch.
    contact: whether the chain touches the ground, with two points per link.
    """

    worlds: int
    contact: bool

    @property
    def key(self) -> str:
        """Its name in the results."""
        return f"{self.worlds} world{'s' if self.worlds > 1 else ''}, {'contact' if self.contact else 'no contact'}"


def variants(batch: int) -> list[Variant]:
    """What is measured: a batch without and with contact, and a single world."""
    return list(dict.fromkeys((Variant(batch, False), Variant(batch, True), Variant(1, False))))


def units(sizes: Sequence[int]) -> int:
    """Calls of `progress` with one unit of work that a variant makes."""
    return len(sizes) * (len(SUBSTEPS) + len(DIRECTIONS))


class Problem:
    """A step of a fixed chain of n hinges, a little bent, all its links just above or in the ground."""

    def __init__(self, n: int, worlds: int, contact: bool) -> None:
        a = Articulation.from_links(chain_links(count=n, free=False))
        terms: list[Term] = [Inertia()]
        if contact:
            ground = HalfSpace(offset=-RADIUS)
            terms.append(Contact.between(a, chain_colliders(n), ground, NormalForce(STIFFNESS), CoulombFriction(0.5)))
        scheme = ImplicitEuler()
        simulator = Simulator(Scene(a, terms, a.rest.new_tensor([0.0, 0.0, -GRAVITY])), DT, scheme)
        generator = torch.Generator().manual_seed(0)
        bent, moved = (torch.randn(worlds, n, generator=generator, dtype=a.dtype) for _ in range(2))
        # bends add up along the chain: this keeps the tip's height within some tenths of a millimetre for every n
        start = 0.01 / n**1.5 * bent
        self.q = start + 0.001 / n**1.5 * moved
        state = scheme.at_rate(a, start, moved / n**1.5, torch.zeros_like(moved), simulator.step_size)
        self.balance: BalanceObjective = simulator.objective(state)
        self.energy: EnergyObjective = self.balance.lagged(start)
        self.squared = Squared(self.balance)
        self.damping = torch.full((worlds,), DAMPING, dtype=a.dtype)
        self.aside = torch.randn(worlds, n, generator=generator, dtype=a.dtype)  # a direction for central differences

    @cached_property
    def pairs(self) -> Model:
        """A full memory of L-BFGS whose newest pair is (s, y) = (`aside`, `aside`/2)."""
        steps = torch.stack([self.aside.roll(k, -1) for k in range(Lbfgs().memory)], -2)
        changes = 0.5 * steps
        return 0.5 * self.aside, steps, changes, 1 / (steps * changes).sum(-1)

    def objective(self, case: str) -> Objective:
        """What the case's direction is asked about."""
        if case in ("LM, GE", "L-BFGS, GE"):
            return self.squared
        return self.energy if case.endswith(", E") else self.balance

    def iteration(self, case: str) -> Callable[[], Tensor]:
        """One iteration of a case."""
        direction, objective = DIRECTIONS[case], self.objective(case)
        previous = self.pairs if isinstance(direction, Lbfgs) else None
        going_on = torch.zeros_like(self.damping, dtype=torch.bool)

        def call() -> Tensor:
            evaluation = objective.evaluate(self.q)
            direction.merit(objective, evaluation)
            return direction.step(direction.model(objective, evaluation, previous, self.aside, going_on), self.damping)

        return call

    def substep(self, name: str) -> Callable[[], Tensor]:
        """A call that does the substep and nothing else."""
        if name == "gradient_E":
            return lambda: self.energy.evaluate(self.q).residual
        if name == "gradient_GE":
            return lambda: self.squared.evaluate(self.q).residual
        if name in ("gauss_newton_E", "hessian_E"):
            energy = self.energy.evaluate(self.q)
            return lambda: energy.stiffness if name == "gauss_newton_E" else energy.jacobian
        if name in ("jtj_GE", "hessian_GE"):
            squared = self.squared.evaluate(self.q)
            _ = squared.residual  # with it r and J are there
            return lambda: squared.stiffness if name == "jtj_GE" else squared.jacobian
        if name == "two_loop":
            return lambda: Lbfgs().step(self.pairs, self.damping)
        r, j, scale = self._linear
        if name == "lu":
            return lambda: torch.linalg.solve_ex(j, -r)[0]
        return lambda: JtjLm().step((r, j, j, scale), self.damping)

    @cached_property
    def _linear(self) -> tuple[Tensor, Tensor, Tensor]:
        balance = self.balance.evaluate(self.q)
        return balance.residual, balance.jacobian, self.balance.scale.expand_as(balance.residual)

    def error(self, name: str) -> float | None:
        """Relative error of a substep's result; None for K, which is an approximation by its nature."""
        found, d = self.substep(name)(), self.aside
        if name == "gradient_E":
            return _relative((found * d).sum(-1), self._difference(lambda q: self.energy.evaluate(q).value))
        if name == "hessian_E":
            return _relative(times(found, d), self._difference(lambda q: self.energy.evaluate(q).residual))
        if name == "hessian_GE":
            return _relative(times(found, d), self._difference(lambda q: self.squared.evaluate(q).residual))
        if name == "two_loop":
            return _relative(found, -d)
        r, j, scale = self._linear
        scaled = j / scale[..., None]
        if name == "gradient_GE":
            return _relative(found, times(scaled.mT, r / scale))
        if name == "jtj_GE":
            return _relative(times(found, d), times(scaled.mT, times(scaled, d)))
        if name == "lu":
            return _relative(times(j, found), -r)
        if name == "qr":
            damped = self.damping[..., None] * scaled.square().sum(-2) * found
            return _relative(times(scaled.mT, times(scaled, found)) + damped, -times(scaled.mT, r / scale))
        return None

    def _difference(self, function: Callable[[Tensor], Tensor], h: float = 1e-7) -> Tensor:
        ahead, behind = (function(self.balance.retract(self.q, sign * h * self.aside)) for sign in (1.0, -1.0))
        return (ahead - behind) / (2 * h)


def _relative(found: Tensor, exact: Tensor) -> float:
    return float(torch.linalg.vector_norm(found - exact) / torch.linalg.vector_norm(exact))


def measure_variant(variant: Variant, sizes: Sequence[int], repeats: int, progress: Progress) -> dict[str, Any]:
    """Costs in µs per world over the sizes, with exponents and errors, as plain data."""
    fewer = max(1, variant.worlds // AUTODIFF_SHARE)
    costs: dict[str, dict[str, list[float]]] = {"substeps": {x: [] for x in SUBSTEPS}, "iterations": {x: [] for x in DIRECTIONS}}
    errors: dict[str, list[float]] = {x: [] for x in SUBSTEPS}
    with torch.no_grad():
        for n in sizes:
            whole, part, single = (Problem(n, worlds, variant.contact) for worlds in (variant.worlds, fewer, 1))
            for kind, dear in (("substeps", "hessian_GE"), ("iterations", "LM, GE")):
                for name, found in costs[kind].items():
                    problem = part if name == dear else whole
                    found.append(1e6 * _cost(problem, kind, name, repeats) / len(problem.q))
                    progress(1)
            for name, seen in errors.items():
                error = single.error(name)
                seen += [] if error is None else [error]
    fitted = [sizes.index(n) for n in fit_sizes(sizes)]
    result: dict[str, Any] = {"worlds": variant.worlds, "contact": variant.contact, "worlds_of_autodiff": fewer}
    for kind, table in costs.items():
        result[kind] = {
            name: {"us_per_world": found, "exponent": exponent([sizes[k] for k in fitted], [found[k] for k in fitted])}
            for name, found in table.items()
        }
    for name, seen in errors.items():
        result["substeps"][name] |= {"label": SUBSTEPS[name], "error_max": worst(seen) if seen else None}
    return result


def _cost(problem: Problem, kind: str, name: str, repeats: int) -> float:
    """Seconds of one call: the shortest of about `repeats`, and of more where they are over before `STEADY_S`. The first one, which
    may load things, counts only where it is long."""
    prepare = (lambda: problem.substep(name)) if kind == "substeps" else (lambda: problem.iteration(name))
    _, first = timed(prepare, 1)
    return first if first > 1.0 else timed(prepare, 40 * repeats, enough_s=max(STEADY_S, repeats * first))[1]
