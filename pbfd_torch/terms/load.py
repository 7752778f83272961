"""What a term gives to the assembly: a load on links or on joints, and its stiffness; and what a term looks like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from pbfd_torch.kinematics import Placement


@dataclass(frozen=True, eq=False)
class StepContext:
    """What is known before a step is solved; a term's `prepare` reads it.

    Attributes:
        dt: step [s], a scalar tensor or `[*batch]`.
        previous: the placement at the start of the step, θ_n.
        weight: κ [1/s²] of the integrator, like dt.
        target_poses: T̂ `[*batch, nlink, 4, 4]`, gravity folded in: inertia pulls the link poses there.
        target_q: q̂ `[*batch, nq]`: where inertia pulls the joints' own rotors (armature).
        control: `[*batch, nu]` or None.
    """

    dt: Tensor
    previous: Placement
    weight: Tensor
    target_poses: Tensor
    target_q: Tensor
    control: Tensor | None


@dataclass(frozen=True, eq=False)
class LinkLoad:
    """Loads on links, in world coordinates about the world origin.

    Attributes:
        moment: `[*batch, nlink, 3, 4]` [G | g] of METHOD §3: minus the first moment Σ f p̄ᵀ of the forces [N m | N].
        stiffness: `[*batch, nlink, 6, 6]` A: how the wrench (torque, force) answers a twist (ω, v) of the link, axes held still.
    """

    moment: Tensor
    stiffness: Tensor


@dataclass(frozen=True, eq=False)
class JointLoad:
    """Loads on degrees of freedom: `residual` `[*batch, nv]` (minus the generalised force) and `stiffness` `[*batch, nv, nv]`."""

    residual: Tensor
    stiffness: Tensor


Load = LinkLoad | JointLoad


class Term(Protocol):
    """One physical effect: an immutable object with its parameters."""

    def prepare(self, step: StepContext) -> Any:
        """What stays fixed while θ_{n+1} is iterated."""
        ...

    def load(self, prepared: Any, placement: Placement) -> Load:
        """The load at a placement, and its stiffness; a pure function of its arguments."""
        ...


@runtime_checkable
class OneSided(Protocol):
    """A stiff term that pushes on one side only: contact, limits."""

    def softened(self, factor: float) -> Term:
        """The same term, `factor` times as stiff; works with what the original prepared."""
        ...


@runtime_checkable
class Conservative(Protocol):
    """A term that stores energy."""

    def potential(self, placement: Placement) -> Tensor:
        """Stored energy [J] `[*batch]`."""
        ...


def diagonal_load(residual: Tensor, stiffness: Tensor) -> JointLoad:
    """A joint load whose stiffness `[*batch, nv]` couples no two degrees of freedom."""
    return JointLoad(residual, torch.diag_embed(stiffness.expand_as(residual)))
