"""Inertia and gravity of the links (Eq. 5), integrated analytically over each body.

The links' pseudo-inertias are pulled to the integrator's target poses T̂, which hold gravity: D = T − T̂. What the pull does to a
degree of freedom is its virtual work along ∂T/∂θ_i = ŝ_i T. The paper takes that at the end of the step, where it is the gradient
of κ/2 Σ tr(D S Dᵀ). Taken on the chord between the start (w = 0) and the end (w = 1) of the step it is no gradient of anything,
but keeps what the paper's loses: at w = 0 it is a variational integrator's, at w = ½ energy and momentum are conserved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.tensors.vectors import trace_minus
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.load import ChordLoad, LinkLoad, StepContext
from pbfd_torch.tree.kinematics import Chord, Placement
from pbfd_torch.tree.rotations import skew


@dataclass(frozen=True, eq=False)
class PreparedInertia:
    weight: Tensor  # κ, shaped to multiply [*batch, nlink, 4, 4]
    target: Tensor
    start: Placement
    share: Tensor | None  # w, [*batch]; None: 1


@dataclass(frozen=True)
class Inertia:
    """r_i = κ Σ tr(D S (ŝ_i T)ᵀ), with ŝ_i T taken where the integrator says (`StepContext.share`). `length`: see `shortened`."""

    length: float = 1.0

    def prepare(self, step: StepContext) -> PreparedInertia:
        start, target = step.previous, step.target_poses
        if self.length < 1:
            target = torch.lerp(start.poses, target, self.length)
        return PreparedInertia((step.weight / self.length**2)[..., None, None, None], target, start, step.share)

    def shortened(self, share: float) -> Self:
        """See `Inert`."""
        return replaced(self, length=share * self.length)

    def load(self, prepared: PreparedInertia, placement: Placement) -> LinkLoad | ChordLoad:
        inertia = prepared.weight * placement.articulation.pseudo_inertia
        lag = (placement.poses - prepared.target)[..., :3, :]
        weighted = (placement.poses @ inertia).mT
        if prepared.share is None:
            return LinkLoad(lag @ weighted, lambda: inertia_stiffness(placement.poses @ weighted))
        chord = Chord(prepared.start, placement, prepared.share)
        on_chord = (chord.poses @ inertia).mT
        return ChordLoad(
            chord,
            moment=lag @ on_chord,
            stiffness=lambda: inertia_stiffness(placement.poses @ on_chord),
            moment_at_end=lambda: lag @ weighted,
        )

    def take(self, worlds: Worlds) -> Self:
        """Itself: the masses are the articulation's."""
        return self

    def energy(self, prepared: PreparedInertia, placement: Placement) -> Tensor:
        lag = (placement.poses - prepared.target)[..., :3, :]
        return 0.5 * ((lag @ (prepared.weight * placement.articulation.pseudo_inertia)) * lag).sum((-3, -2, -1))


def inertia_stiffness(second: Tensor) -> Tensor:
    """How the wrench on masses m at points q answers a twist of points p that they are tied to, from Σ m p̄ q̄ᵀ `[*, 4, 4]`:
    `[*, 6, 6]` in the order (ω, v). With p = q (T S Tᵀ) it is the spatial inertia about the world origin."""
    mass = second[..., 3:, 3:] * torch.eye(3, dtype=second.dtype, device=second.device)
    top = torch.cat((trace_minus(second[..., :3, :3]), skew(second[..., 3, :3])), -1)
    return torch.cat((top, torch.cat((-skew(second[..., :3, 3]), mass), -1)), -2)
