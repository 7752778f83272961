"""What an integrator is: the history it keeps, and the step that it makes of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import torch
from torch import Tensor
from typing_extensions import TypeVar

from pbfd_torch.articulation import Articulation
from pbfd_torch.objective import BalanceObjective
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.terms.load import StepContext, Term
from pbfd_torch.worlds import Worlds


@dataclass(frozen=True, eq=False, kw_only=True)
class State:
    """Where every world is, and what its integrator needs to go on: the subclasses' own fields.

    Attributes:
        q: the configuration θ_n `[*batch, nq]`.
        time: t_n `[*batch]` [s]; obstacles move by it.
        hazards: `Hazard` bits of the step that ended here, `[*batch]` int.
        memory: what the terms that remember something have from it, each `[*batch, ...]`; empty: nothing yet.
    """

    q: Tensor
    time: Tensor
    hazards: Tensor
    memory: tuple[Tensor, ...] = ()

    def take(self, worlds: Worlds) -> Self:
        """The state of some worlds."""
        state: Self = mapped(worlds.rows, self)
        return state


S = TypeVar("S", bound=State, default=Any)


class Integrator(Protocol[S]):
    """A scheme with its own kind of state."""

    @property
    def easier(self) -> Sequence[Integrator[S]]:
        """Steps from the same kind of state that are easier to solve, in the order in which they are tried by the worlds whose own
        step is unsolved or refused."""
        ...

    def adapted(self, articulation: Articulation, terms: Sequence[Term], dt: Tensor) -> Sequence[Term]:
        """The terms as they act in a step, in the same order."""
        ...

    def start(self, articulation: Articulation, q: Tensor, v: Tensor, acceleration: Callable[[], Tensor], dt: Tensor) -> S:
        """State at t = 0 of the motion with velocity v `[*batch, nv]` and the acceleration `[*batch, nv]` of a trial step."""
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

    def advance(self, objective: BalanceObjective, state: S, q: Tensor) -> S:
        """The state after the step of an objective that ended at q."""
        ...

    def resized(self, articulation: Articulation, state: S, dt: Tensor, new: Tensor) -> S:
        """The state as seen by steps of another length: at the same place with the same velocity."""
        ...

    def refused(self, objective: BalanceObjective, state: S, advanced: S) -> Tensor | None:
        """Worlds `[*batch]` whose step an easier one must replace although it was solved; None: no world."""
        ...


def fresh(q: Tensor) -> dict[str, Any]:
    """The fields of a state at t = 0 at q."""
    time = torch.zeros_like(q[..., 0])
    return {"q": q, "time": time, "hazards": torch.zeros_like(time, dtype=torch.int32)}


def after(objective: BalanceObjective, q: Tensor) -> dict[str, Any]:
    """The fields of the state after the step of an objective that ended at q."""
    step, aftermath = objective.step, objective.aftermath(q)
    return {"q": q, "time": step.time + step.dt, "hazards": aftermath.hazards, "memory": aftermath.memory}
