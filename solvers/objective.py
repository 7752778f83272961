"""What a solver sees of a problem, and what it returns. Solvers know only vectors and import nothing of the simulator."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, Self, runtime_checkable

import torch
from torch import Tensor


class Status(enum.IntEnum):
    """How one world's solve ended."""

    EXPLICIT = -1  # nothing touched: made without an equation to solve
    SOLVED = 0
    WARM_STARTED = 1  # solved, from a minimiser: of the energy with lagged friction, or of ½‖r‖²
    CONTINUED = 2  # solved, by continuation in the friction's width or in stiffness
    EASED = 3  # solved, but as a step of another integrator, which is easier
    HALVED = 4  # solved, as two or more shorter steps
    STALLED = 5  # no step along the search direction helps
    ITERATION_LIMIT = 6
    NON_FINITE = 7  # NaN or infinity in the guess or in the residual there


def is_solved(status: Tensor) -> Tensor:
    """Which of the statuses, values of `Status`, are those of a solved world; bool, same shape."""
    return status <= int(Status.HALVED)


class Evaluation(Protocol):
    """Values at one point, for every world of the batch; what is not asked for need not be computed."""

    @property
    def residual(self) -> Tensor:
        """r `[*batch, n]`; the gradient where the problem is a minimisation."""
        ...

    @property
    def jacobian(self) -> Tensor:
        """∂r/∂θ `[*batch, n, n]`, exact; the Hessian where the problem is a minimisation."""
        ...

    @property
    def stiffness(self) -> Tensor:
        """An approximation of the Jacobian `[*batch, n, n]` whose step descends where the exact one's does not."""
        ...


@runtime_checkable
class Valued(Protocol):
    """An evaluation of a problem that is a minimisation."""

    @property
    def value(self) -> Tensor:
        """What is minimised, `[*batch]`; its gradient is the residual."""
        ...


class Objective(Protocol):
    """A root-finding problem r(θ) = 0 on a manifold, one independent problem per world."""

    @property
    def scale(self) -> Tensor:
        """Size of a residual entry that counts as one, broadcastable to `[*batch, n]`."""
        ...

    def evaluate(self, q: Tensor) -> Evaluation:
        """Residual and Jacobian at q `[*batch, nq]`."""
        ...

    def error(self, evaluation: Evaluation, tolerance: float) -> Tensor:
        """‖r / (scale + rounding/tolerance)‖₂ `[*batch]`: at most `tolerance` where solved, nothing below rounding being asked
        for. Of a derived problem (GE for E): that of the original one."""
        ...

    def retract(self, q: Tensor, step: Tensor) -> Tensor:
        """q moved by a tangent vector `[*batch, n]`."""
        ...

    def turn(self, step: Tensor) -> Tensor:
        """Largest rotation [rad] in a tangent vector, `[*batch]`."""
        ...

    def take(self, index: Tensor) -> Self:
        """The problems of some worlds only: positions `[m]` in the flattened batch; the result has batch shape `[m]`."""
        ...


@runtime_checkable
class Foreseeing(Protocol):
    """An objective that can tell, for much less than evaluations, how a direction will go."""

    def outlook(self, evaluation: Any, direction: Tensor) -> Callable[[Tensor], Tensor]:
        """An estimate of the work r(q ⊕ a·d)·d from an evaluated point, as a function of lengths a: `[k, *batch] → [k, *batch]`."""
        ...


@runtime_checkable
class Sane(Protocol):
    """An objective that knows what is not worth a search."""

    def absurd(self, evaluation: Any) -> Tensor:
        """Worlds to be given up if they are like this where their last guess is evaluated, `[*batch]` bool."""
        ...


class Relaxable(Objective, Protocol):
    """An objective that knows easier problems close to it, for the fallbacks."""

    def softened(self, factor: float) -> Relaxable:
        """The same problem with its stiff one-sided forces scaled by `factor` ≤ 1."""
        ...

    def widened(self, factor: float) -> Relaxable:
        """The same problem with friction smooth over a `factor` ≥ 1 times wider range of slip."""
        ...

    def lagged(self, q: Tensor) -> Objective:
        """The minimisation that is left with the friction's normal forces frozen as they are at q."""
        ...

    def shortened(self, share: float) -> Relaxable:
        """The problem of a motion that has gone on for a `share` ≤ 1 of its time only; its root is the nearer to the start."""
        ...

    def strayed(self, q: Tensor) -> Tensor:
        """Whether a root at q is too far from the start to be trusted as where the motion leads, `[*batch]` bool."""
        ...


def weighted_error(residual: Tensor, scale: Tensor, rounding: Tensor | float, tolerance: float) -> Tensor:
    """‖r / (scale + rounding/tolerance)‖₂ `[*batch]`."""
    return torch.linalg.vector_norm(residual / (scale + rounding / tolerance), dim=-1)


FALLBACKS = ("warm start", "continuation", "easier step", "halving")


@dataclass(frozen=True, eq=False)
class Solution:
    """Attributes, each per world but the last:
    q: `[*batch, nq]` the best point found; the guess itself, bitwise, where it solves the problem.
    status: `[*batch]` int, values of `Status`.
    residual_norm: `[*batch]` ‖r / (scale + rounding/tolerance)‖₂.
    iterations: `[*batch]` int, steps taken.
    evaluations: `[*batch]` int, evaluations of the residual spent.
    fallbacks: `[*batch, 4]` int, how often each of `FALLBACKS` was tried.
    estimate: `[*batch]` [m], how far the end is off in worlds whose step was explicit, else 0; None: in none.
    strike: `[*batch]` the share of an explicit step after which something would have struck, so that another one was made; else 1.
    steps: `[*batch]` int, steps of a world that chooses their length itself; None: one for all.
    lanes: evaluations that the schedule spent on all worlds together, those on finished worlds included.
    """

    q: Tensor
    status: Tensor
    residual_norm: Tensor
    iterations: Tensor
    evaluations: Tensor
    fallbacks: Tensor
    estimate: Tensor | None = None
    strike: Tensor | None = None
    steps: Tensor | None = None
    lanes: int = 0

    @property
    def solved(self) -> Tensor:
        """`[*batch]` bool."""
        return is_solved(self.status)

    @cached_property
    def unsolved(self) -> Tensor:
        """Positions `[n]` in the flattened batch of the worlds that a fallback may help: unsolved, but from a finite start. Whoever
        asks first makes the host wait for a device; it is known after that."""
        return (~self.solved & (self.status != int(Status.NON_FINITE))).reshape(-1).nonzero().squeeze(-1)

    def marked(self, where: Tensor, status: Status) -> Solution:
        """The same with another status in the worlds in `where` `[*batch]` bool."""
        return dataclasses.replace(self, status=torch.where(where, int(status), self.status).to(torch.int32))

    def within(self, budget: int | Tensor | None, cost: int, index: Tensor | None = None) -> Tensor:
        """Those of the worlds at `index` (None: the `unsolved` ones) that may spend `cost` evaluations more: their budget is a
        number or `[*batch]`; None: they all may."""
        index = self.unsolved if index is None else index
        if budget is None or len(index) == 0:
            return index
        return index[((self.evaluations + cost) <= budget).reshape(-1)[index]]
