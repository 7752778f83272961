"""The solvers by name: which direction and search make which, on what they minimise.

LM and L-BFGS minimise a value. On GE (Eq. 13) that is ½‖r‖², for which `OnSquares` wraps the objective; on E (Eq. 6) it is the
objective's own, which must then have one. JTJ-LM serves both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.directions import GaussNewtonLm, JtjLm, Lm
from pbfd_torch.solvers.lbfgs import Lbfgs
from pbfd_torch.solvers.objective import Relaxable, Solution
from pbfd_torch.solvers.searches import FullStep, Secant, TrustRegion, WorkSearch
from pbfd_torch.solvers.squared import Squared


@dataclass(frozen=True)
class OnSquares:
    """A minimising solver, used on GE = ½‖r‖² of the objective that it is given."""

    solver: Descent

    def solve(self, objective: Relaxable, guess: Tensor, retreat: Tensor | None = None) -> Solution:
        """As `Descent.solve`."""
        return self.solver.solve(Squared(objective), guess, retreat)


@dataclass(frozen=True)
class OnLagged:
    """A minimising solver, used on E with the friction lagged: held at the normal forces of the retreat (or the guess). It solves
    that problem, not the one with the friction that follows the normal force."""

    solver: Descent

    def solve(self, objective: Relaxable, guess: Tensor, retreat: Tensor | None = None) -> Solution:
        """As `Descent.solve`."""
        return self.solver.solve(objective.lagged(guess if retreat is None else retreat), guess, retreat)


def jtj_lm() -> Descent:
    """JTJ-LM as the paper describes it, for roots: Eq. 14 with Marquardt's damping, on ½‖r‖²."""
    return Descent(JtjLm(), TrustRegion())


def energy_jtj_lm() -> Descent:
    """JTJ-LM for an energy: its Gauss–Newton matrix, damped."""
    return Descent(GaussNewtonLm(), TrustRegion())


def lm() -> Descent:
    """LM for a value: its exact Hessian, damped."""
    return Descent(Lm(), TrustRegion())


def lbfgs() -> Descent:
    """L-BFGS for a value, searched along by work from gradients alone."""
    return Descent(Lbfgs(), WorkSearch(first=FullStep(), interpolation=Secant()), max_evaluations=4000)


TABLE_1: dict[str, Callable[[], Descent | OnSquares | OnLagged]] = {
    "LM, E": lambda: OnLagged(lm()),
    "JTJ-LM, E": lambda: OnLagged(energy_jtj_lm()),
    "L-BFGS, E": lambda: OnLagged(lbfgs()),
    "LM, GE": lambda: OnSquares(lm()),
    "JTJ-LM, GE": jtj_lm,
    "L-BFGS, GE": lambda: OnSquares(lbfgs()),
}
