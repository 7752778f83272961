"""Engines that follow the steps back that they have made: derivatives of whole stretches in one call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from pbfd_torch.integrators.integrator import S
from pbfd_torch.solvers.objective import Solution


@dataclass(frozen=True, eq=False)
class Numbers:
    """What an engine knows of a scene and its steps: `shared` by all worlds `[n]`, `own` of each `[*batch, m]`, and Δt [s] `[]`, or
    `[*batch]`."""

    shared: Tensor
    own: Tensor
    step_size: Tensor


@dataclass(frozen=True, eq=False)
class Walked:
    """Steps that have been made.

    Attributes:
        found: the fields of the states after each, `[steps, *batch, ...]`; other: what else states have, without derivatives.
        solution: how each was solved.
        path: how they were made, as the engine knows it.
    """

    found: Mapping[str, Tensor]
    other: Mapping[str, Tensor]
    solution: Solution
    path: Any


@dataclass(frozen=True, eq=False)
class Pulled:
    """Derivatives, in double precision, of each of so many `rows`, by what steps were made of.

    Attributes:
        start: by the fields of the state before the first, `[rows, *batch, ...]`.
        control: `[rows, steps, *batch, nu]`.
        numbers: by these, where they are asked for, of one row.
        singular: which steps have a singular J, `[steps, *batch]` bool.
    """

    start: Mapping[str, Tensor]
    control: Tensor
    numbers: Numbers | None
    singular: Tensor


@runtime_checkable
class Descending(Protocol[S]):
    """A `Stepper` that may do so."""

    @property
    def descends(self) -> bool:
        """Whether it can, in this scene, by states and controls."""
        ...

    def fields(self, state: S) -> dict[str, Tensor]:
        """The numbers `[*batch, ...]` of a state that its steps depend on, as functions of it."""
        ...

    def restored(self, state: S, found: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> S:
        """The states after steps from a state, as functions of their fields."""
        ...

    def precise(self, stepper: Any, plain: Any) -> tuple[Descending[S], Numbers] | None:
        """What follows steps back of an `EagerStepper` in double precision, and what it knows of that, as functions of all in it
        that carries derivatives; `plain` is the same without these. None: something carries some of which it knows nothing."""
        ...

    def walk(self, state: S, controls: Tensor | None, steps: int) -> Walked:
        """So many steps of all worlds under controls `[steps, *, nu]`, or `[1, *, nu]` for all of them (None: zero)."""
        ...

    def back(
        self,
        path: Any,
        seen: Mapping[str, Tensor | None],
        last: Mapping[str, Tensor] | None = None,
        constant: Tensor | None = None,
        dropped: bool = False,
        numbers: bool = False,
    ) -> Pulled:
        """Follows steps back that a stepper has made of the same numbers, this one in double precision. seen: derivatives by the
        fields of the states after each step, `[steps, *batch, ...]`; last: by those after the last one, `[rows, *batch, ...]`
        besides. constant: `[steps, *batch]` bool, steps whose end counts as one; dropped: so does that of those with a singular
        J. numbers: whether derivatives by these are asked for."""
        ...

    def ahead(
        self,
        path: Any,
        start: Mapping[str, Tensor],
        control: Tensor,
        numbers: Numbers | None,
        constant: Tensor | None,
        dropped: bool,
    ) -> tuple[dict[str, Tensor], Tensor]:
        """The same ahead: how the fields of the states after each step change `[steps, *batch, ...]`, and which steps have a
        singular J `[steps, *batch]` bool, where the start's fields, the controls `[steps, *batch, nu]` and the numbers change like
        this."""
        ...
