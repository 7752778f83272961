"""Smooth loads on joints between the trapezoidal rule, which is accurate, and implicit Euler, which is calm when they are stiff."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import mass_matrix
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.load import JointLoad, StepContext, Term
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Placement


@runtime_checkable
class Fittable(Protocol):
    """A term with smooth loads on joints that may be taken anywhere in the step."""

    def slope(self, articulation: Articulation, dt: Tensor) -> Tensor:
        """How its residual grows with each coordinate over a step, `[*batch, nv]`."""
        ...

    def taken_at(self, share: Tensor) -> Self:
        """θ of the term, θ `[*, nv]`, at the coordinates q_n + θ (q − q_n)."""
        ...

    def prepare(self, step: StepContext) -> Any: ...

    def load(self, prepared: Any, placement: Placement) -> JointLoad: ...

    def energy(self, prepared: Any, placement: Placement) -> Tensor: ...

    def take(self, worlds: Worlds) -> Self: ...


@dataclass(frozen=True, eq=False)
class Fitted:
    """A term that moves the bodies by θ Δt² a over a step, a its acceleration: as the trapezoidal rule has it with θ = ½, as
    implicit Euler with θ = 1.

    Attributes:
        term: already `taken_at` θ.
        share: θ `[*, nv]`.
    """

    term: Fittable
    share: Tensor

    def prepare(self, step: StepContext) -> Any:
        return self.term.prepare(step)

    def load(self, prepared: Any, placement: Placement) -> JointLoad:
        return self.term.load(prepared, placement)

    def energy(self, prepared: Any, placement: Placement) -> Tensor:
        """See `Potential`."""
        return self.term.energy(prepared, placement)

    def take(self, worlds: Worlds) -> Self:
        """The same with the parameters of some worlds."""
        return replaced(self, term=self.term.take(worlds), share=worlds.pick(self.share, 1))


def fitted(articulation: Articulation, terms: Sequence[Term], dt: Tensor) -> Sequence[Term]:
    """The terms, with those that can be `Fitted` to the stiffness z = Δt² (∂r/∂q)/m that all of them have together, m as in
    `felt_inertia`."""
    z = stiffness(articulation, terms, dt)
    if z is None:
        return terms
    turning = torch.zeros_like(articulation.topology.turns).index_fill(0, articulation.topology.turning_v.flatten(), True)
    share = torch.where(turning & (z > 0), 1.0, fit(z))  # where coordinates do not add up
    return [Fitted(term.taken_at(share), share) if isinstance(term, Fittable) else term for term in terms]


def stiffness(articulation: Articulation, terms: Sequence[Term], dt: Tensor) -> Tensor | None:
    """z `[*, nv]` of all `Fittable` terms; None: there are none."""
    able = [term for term in terms if isinstance(term, Fittable)]
    if not able:
        return None
    felt = felt_inertia(articulation, terms)
    slope = sum((term.slope(articulation, dt) for term in able), torch.zeros_like(felt))
    return (dt * dt)[..., None] * slope / felt


def felt_inertia(articulation: Articulation, terms: Sequence[Term]) -> Tensor:
    """What the other joints, free to move, let each coordinate feel of its inertia in the rest configuration, `[*, nv]`."""
    inertia = mass_matrix(articulation, articulation.rest, terms)
    return 1 / torch.linalg.inv_ex(inertia).inverse.diagonal(dim1=-2, dim2=-1)


def fit(stiffness: Tensor) -> Tensor:
    """θ(z) = 1/(1 − e^{−z}) − 1/z, from ½ at z = 0 to 1: with it a damped joint slows down by exactly e^{−z} in a step."""
    whole = stiffness.double()  # in float32 the difference would lose four digits
    small = whole < 1e-3
    z = torch.where(small, torch.ones_like(whole), whole)
    return torch.where(small, 0.5 + whole / 12, -1 / torch.expm1(-z) - 1 / z).to(stiffness.dtype)
