"""The balance of forces at the end of a step, as a solver sees it: residual, Jacobian, retract (the root of Eq. 13)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.articulation import Articulation, force_scale, reach
from pbfd_torch.assembly import Balance, assemble
from pbfd_torch.dynamics import armature_diagonal
from pbfd_torch.kinematics import place, retract
from pbfd_torch.terms.load import OneSided, StepContext, Term


@dataclass(frozen=True, eq=False)
class BalanceObjective:
    """r(θ) of one step for all worlds.

    Attributes:
        articulation, terms, prepared: what acts, and what each term prepared for this step.
        scale: `[*batch, nv]` the size of a force that counts as one, see `force_scale`.
        rounding: `[*batch, nv]` the size of the rounding error in r, see `inertia_rounding`.
        guess: `[*batch, nq]` where inertia alone would end the step.
    """

    articulation: Articulation
    terms: Sequence[Term]
    prepared: Sequence[Any]
    scale: Tensor
    rounding: Tensor
    guess: Tensor

    @staticmethod
    def of_step(articulation: Articulation, terms: Sequence[Term], step: StepContext, scale: Tensor) -> BalanceObjective:
        """Prepares every term for the step."""
        prepared = [term.prepare(step) for term in terms]
        return BalanceObjective(articulation, terms, prepared, scale, inertia_rounding(articulation, terms, step), step.target_q)

    def evaluate(self, q: Tensor) -> Balance:
        """Residual, Jacobian and stiffness at q."""
        placement = place(self.articulation, q)
        return assemble(placement, [t.load(p, placement) for t, p in zip(self.terms, self.prepared, strict=True)])

    def retract(self, q: Tensor, step: Tensor) -> Tensor:
        """q moved by the tangent vector `step`."""
        return retract(self.articulation, q, step)

    def turn(self, step: Tensor) -> Tensor:
        """Largest rotation [rad] of one joint in a tangent step, `[*batch]`."""
        return (step.abs() * self.articulation.topology.turns.to(step.dtype)).amax(-1)

    def softened(self, factor: float) -> BalanceObjective:
        """The same step with contacts and joint limits `factor` times as stiff."""
        softer = [term.softened(factor) if isinstance(term, OneSided) else term for term in self.terms]
        return dataclasses.replace(self, terms=softer)


def inertia_rounding(articulation: Articulation, terms: Sequence[Term], step: StepContext) -> Tensor:
    """Rounding error `[*batch, nv]` left in the inertial forces [N, N m]: they are κ m times differences of positions x that were
    rounded to ε|x|. It grows with 1/Δt² and with the distance from the world's origin."""
    far = step.previous.poses[..., :3, 3].abs().amax((-2, -1)) + reach(articulation)
    lever = force_scale(articulation, 1.0)
    moved = far[..., None] * lever + armature_diagonal(articulation, terms)
    return 8 * torch.finfo(far.dtype).eps * step.weight[..., None] * moved
