"""What an integrator is: the history it keeps, and the step that it makes of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, Self, runtime_checkable

import torch
from torch import Tensor
from typing_extensions import TypeVar

from pbfd_torch.balance.dynamics import kinetic_energy
from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.load import StepContext, Term
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Motion, Placement


@dataclass(frozen=True, eq=False, kw_only=True)
class State:
    """Where every world is, and what its integrator needs to go on: the subclasses' own fields.

    Attributes:
        q: the configuration θ_n `[*batch, nq]`.
        time: t_n `[*batch]` [s]; obstacles move by it.
        hazards: `Hazard` bits of the step that ended here, `[*batch]` int.
        memory: what the terms that remember something have from it, each `[*batch, ...]`; empty: nothing yet.
        pace: the step [s] `[*batch]` that each world goes on with where they choose their own; None: they do not.
    """

    q: Tensor
    time: Tensor
    hazards: Tensor
    memory: tuple[Tensor, ...] = ()
    pace: Tensor | None = None

    def take(self, worlds: Worlds) -> Self:
        """The state of some worlds."""
        state: Self = mapped(worlds.rows, self)
        return state


S = TypeVar("S", bound=State, default=Any)

Refusal = Callable[[], Tensor]
"""Says which worlds `[*batch]` may not go on from the end of a step, although it was solved, but must take an easier one."""


@dataclass(frozen=True, eq=False)
class Trial:
    """How a step has ended that was made to feel the forces, stiff ones above all, as they are going to be.

    Attributes:
        end: where, `[*batch, nq]`.
        acceleration: M⁻¹ (f − h) at the start, with the forces f of the end but for those of an impact, `[*batch, nv]`; zero where
            it is unsolved.
        solved: `[*batch]`.
    """

    end: Tensor
    acceleration: Tensor
    solved: Tensor


class Starter(Protocol):
    """What an integrator may ask of the stepper that it starts in."""

    @property
    def articulation(self) -> Articulation: ...

    @property
    def step_size(self) -> Tensor:
        """Δt [s], a scalar tensor."""
        ...

    def trial(self, q: Tensor, v: Tensor, control: Tensor | None) -> Trial:
        """A step of implicit Euler that sets out from q with v."""
        ...

    def objective(self, state: Any, control: Tensor | None) -> BalanceObjective:
        """The step from a state."""
        ...


class Integrator(Protocol[S]):
    """A scheme with its own kind of state."""

    @property
    def easier(self) -> Sequence[Integrator[S]]:
        """Steps from the same kind of state that are easier to solve, in the order in which they are tried by the worlds whose own
        step is unsolved or refused."""
        ...

    @property
    def coordinates(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The state's fields that the next step depends on, besides what terms remember: configurations, and others."""
        ...

    def adapted(self, articulation: Articulation, terms: Sequence[Term], dt: Tensor) -> Sequence[Term]:
        """The terms as they act in a step, in the same order."""
        ...

    def start(self, starter: Starter, q: Tensor, v: Tensor, control: Tensor | None) -> S:
        """State at t = 0 at q `[*batch, nq]` with velocity v `[*batch, nv]`, of second order in the step."""
        ...

    def velocity(self, articulation: Articulation, state: S, dt: Tensor) -> Tensor:
        """`[*batch, nv]`."""
        ...

    def pose_rates(self, articulation: Articulation, state: S, dt: Tensor) -> Tensor:
        """Ṫ of the link poses `[*batch, nlink, 3, 4]`; its momentum is the one that is kept."""
        ...

    def context(self, articulation: Articulation, state: S, dt: Tensor, gravity: Tensor, control: Tensor | None) -> StepContext:
        """What is fixed during the step from `state`."""
        ...

    def advance(self, objective: BalanceObjective, state: S, q: Tensor) -> tuple[S, Refusal | None]:
        """The state after the step of an objective that ended at q, and who may not go on from there; None: no world."""
        ...

    def halves(self, objective: BalanceObjective, end: S, solved: Tensor) -> Tensor:
        """How often a world had better halve its step before it takes an easier one, `[*batch]` int, if that which ended like this
        is unsolved or refused; solved: which were, before they were refused."""
        ...

    def resized(self, articulation: Articulation, state: S, dt: Tensor, new: Tensor) -> S:
        """The state as seen by steps of another length: at the same place with the same velocity."""
        ...


@dataclass(frozen=True, eq=False)
class Leap(Generic[S]):
    """An explicit step of all worlds.

    Attributes:
        end: the state after it.
        kept: `[*batch]` bool, which may go on from there.
        error: `[*batch]` [m], how far its end is off, as estimated; see `apart`.
        strike: `[*batch]` the share of the step after which something strikes, where nothing else keeps a world from making
            it; else 1.
        evaluations: `[*batch]` int, of what moves the bodies, in worlds that might have made it; stages: for each of these.
    """

    end: S
    kept: Tensor
    error: Tensor
    strike: Tensor
    evaluations: Tensor
    stages: int


@runtime_checkable
class Leaping(Protocol[S]):
    """An integrator that can do without solving where nothing touches."""

    @property
    def otherwise(self) -> Integrator[S]:
        """What makes the steps of the other worlds, from the same kind of state."""
        ...

    def leap(self, terms: Sequence[Term], objective: BalanceObjective, state: S) -> Leap[S]:
        """The explicit step from a state, of the step and the loads that an objective is of; terms: of the scene."""
        ...


@dataclass(frozen=True, eq=False)
class Halved(Generic[S]):
    """A step that was made twice.

    Attributes:
        start: the state before it. whole: the state after it. middle, end: after its first half, and after both.
        off: how far `whole` and `end` are apart `[*batch]` [m]. accuracy: asked for [m].
    """

    start: S
    whole: S
    middle: S
    end: S
    off: Tensor
    accuracy: float


@runtime_checkable
class Extrapolating(Protocol[S]):
    """An integrator whose error has an expansion in the step."""

    def extrapolated(self, articulation: Articulation, terms: Sequence[Term], made: Halved[S]) -> S:
        """What the ends of a step and of its two halves say together. The halves' end where something has struck, and where they
        are further apart than the accuracy. terms: of the scene."""
        ...


def fresh(q: Tensor) -> dict[str, Any]:
    """The fields of a state at t = 0 at q."""
    time = torch.zeros_like(q[..., 0])
    return {"q": q, "time": time, "hazards": torch.zeros_like(time, dtype=torch.int32)}


def after(objective: BalanceObjective, now: Placement) -> dict[str, Any]:
    """The fields of the state after the step of an objective that ended at a placement."""
    step, aftermath = objective.step, objective.aftermath(now)
    return {"q": now.q, "time": step.time + step.dt, "hazards": aftermath.hazards, "memory": aftermath.memory}


HARDEST = 3.0


def fall(objective: BalanceObjective) -> Tensor:
    """Kinetic energy [J] `[*batch]` of the bodies' fall over one step, at 1 m/s² at least."""
    strength = torch.linalg.vector_norm(objective.step.gravity, dim=-1).clamp_min(1.0)
    return 0.5 * objective.articulation.mass.sum(-1) * (objective.step.dt * strength) ** 2


def calm(objective: BalanceObjective, placement: Placement, gained: Tensor) -> Tensor:
    """Where a velocity `[*batch, nv]` gained in a step is no impact's: it has no more energy than a fall of `HARDEST` steps,
    `[*batch]` bool."""
    rates = Motion(placement, gained).rates
    return kinetic_energy(objective.articulation, rates) <= HARDEST**2 * fall(objective)
