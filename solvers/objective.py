"""What a solver sees of a problem, and what it returns. Solvers know only vectors and import nothing of the simulator."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor


class Status(enum.IntEnum):
    """How one world's solve ended."""

    SOLVED = 0
    CONTINUED = 1  # solved, by continuation in stiffness
    STALLED = 2  # no step along the search direction helps
    ITERATION_LIMIT = 3
    NON_FINITE = 4  # NaN or infinity in the guess or in the residual there


def is_solved(status: Tensor) -> Tensor:
    """Which of the statuses, values of `Status`, are those of a solved world; bool, same shape."""
    return status <= int(Status.CONTINUED)


class Evaluation(Protocol):
    """Values at one point, for every world of the batch."""

    @property
    def residual(self) -> Tensor:
        """r `[*batch, n]`."""
        ...

    @property
    def jacobian(self) -> Tensor:
        """∂r/∂θ `[*batch, n, n]`, exact."""
        ...

    @property
    def stiffness(self) -> Tensor:
        """An approximation of the Jacobian `[*batch, n, n]` whose step descends where the exact one's does not."""
        ...


class Objective(Protocol):
    """A root-finding problem r(θ) = 0 on a manifold, one independent problem per world."""

    @property
    def scale(self) -> Tensor:
        """Size of a residual entry that counts as one, broadcastable to `[*batch, n]`."""
        ...

    @property
    def rounding(self) -> Tensor:
        """Size of the rounding error in a residual entry, likewise; nothing smaller can be asked for."""
        ...

    def evaluate(self, q: Tensor) -> Evaluation:
        """Residual and Jacobian at q `[*batch, nq]`."""
        ...

    def retract(self, q: Tensor, step: Tensor) -> Tensor:
        """q moved by a tangent vector `[*batch, n]`."""
        ...

    def turn(self, step: Tensor) -> Tensor:
        """Largest rotation [rad] in a tangent vector, `[*batch]`."""
        ...

    def softened(self, factor: float) -> Objective:
        """The same problem with its stiff one-sided forces scaled by `factor` ≤ 1."""
        ...


@dataclass(frozen=True, eq=False)
class Solution:
    """Attributes, each per world:
    q: `[*batch, nq]` the best point found; the guess itself, bitwise, where it solves the problem.
    status: `[*batch]` int, values of `Status`.
    residual_norm: `[*batch]` ‖r / (scale + rounding/tolerance)‖₂.
    iterations: `[*batch]` int, steps taken.
    evaluations: `[*batch]` int, evaluations of the residual spent.
    """

    q: Tensor
    status: Tensor
    residual_norm: Tensor
    iterations: Tensor
    evaluations: Tensor

    @property
    def solved(self) -> Tensor:
        """`[*batch]` bool."""
        return is_solved(self.status)
