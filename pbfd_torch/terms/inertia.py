"""Inertia and gravity of the links (Eq. 5), integrated analytically over each body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.kinematics import Placement
from pbfd_torch.rotations import skew
from pbfd_torch.terms.load import LinkLoad, StepContext
from pbfd_torch.worlds import Worlds


@dataclass(frozen=True, eq=False)
class PreparedInertia:
    weight: Tensor  # κ, shaped to multiply [*batch, nlink, 4, 4]
    target: Tensor


@dataclass(frozen=True)
class Inertia:
    """I(θ) = κ/2 Σ tr(D S Dᵀ), D = T − T̂: the links' pseudo-inertias pulled to the integrator's target poses, which hold
    gravity."""

    def prepare(self, step: StepContext) -> PreparedInertia:
        return PreparedInertia(step.weight[..., None, None, None], step.target_poses)

    def load(self, prepared: PreparedInertia, placement: Placement) -> LinkLoad:
        weighted = (placement.poses @ (prepared.weight * placement.articulation.pseudo_inertia)).mT
        lag = (placement.poses - prepared.target)[..., :3, :]
        return LinkLoad(lag @ weighted, lambda: inertia_stiffness(placement.poses @ weighted))

    def take(self, worlds: Worlds) -> Self:
        """Itself: the masses are the articulation's."""
        return self

    def energy(self, prepared: PreparedInertia, placement: Placement) -> Tensor:
        lag = (placement.poses - prepared.target)[..., :3, :]
        return 0.5 * ((lag @ (prepared.weight * placement.articulation.pseudo_inertia)) * lag).sum((-3, -2, -1))


def inertia_stiffness(second: Tensor) -> Tensor:
    """6×6 spatial inertia about the world origin, `[*, 4, 4]` (T S Tᵀ) → `[*, 6, 6]` in the order (ω, v)."""
    m = second[..., :3, :3]
    trace = m.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(3, dtype=m.dtype, device=m.device)
    cross = skew(second[..., :3, 3])
    mass = second[..., 3:, 3:] * eye
    return torch.cat((torch.cat((trace * eye - m, cross), -1), torch.cat((-cross, mass), -1)), -2)
