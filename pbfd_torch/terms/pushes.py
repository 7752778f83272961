"""Forces from outside on the links, constant in the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.vectors import extended, outer, rotated
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.load import LinkLoad, StepContext
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Placement


@dataclass(frozen=True, eq=False)
class Pushes:
    """r_i = −Σ f · ∂p/∂θ_i at the end of the step, as contact forces are: exact while the arms of the forces stay, nearly of second
    order in how they turn.

    force: f `[*, nlink, 3]` [N], world axes. point: where each acts, `[*, nlink, 3]` in its link's frame [m]."""

    force: Tensor
    point: Tensor

    @staticmethod
    def at_centers(articulation: Articulation, force: Tensor) -> Pushes:
        """On the centres of mass; on the origin of a link without mass."""
        mass = articulation.mass[..., None]
        first = articulation.pseudo_inertia[..., :3, 3]
        return Pushes(force, torch.where(mass > 0, first / torch.where(mass > 0, mass, 1.0), 0.0))

    def __post_init__(self) -> None:
        for what, value in (("force", self.force), ("point", self.point)):
            if value.ndim < 2 or value.shape[-1] != 3 or value.shape[-2] != self.force.shape[-2]:
                raise InputError(f"{what} of the pushes has shape {tuple(value.shape)}: must be [*batch, links, 3]")
            if not bool(torch.isfinite(value.detach()).all()):
                raise InputError(f"{what} of the pushes holds NaN or infinity")

    def prepare(self, step: StepContext) -> None:
        """Nothing: the forces are constant."""

    def _moment(self, poses: Tensor) -> Tensor:
        """−f p̄ᵀ `[*batch, nlink, 3, 4]`."""
        return -outer(self.force, extended(rotated(poses[..., :3, :3], self.point) + poses[..., :3, 3]))

    def load(self, prepared: None, placement: Placement) -> LinkLoad:
        poses = placement.poses
        return LinkLoad(self._moment(poses), lambda: poses.new_zeros((*poses.shape[:-2], 6, 6)))

    def flow(self, placement: Placement, v: Tensor, control: Tensor | None) -> LinkLoad:
        """See `Flowing`."""
        return self.load(None, placement)

    def take(self, worlds: Worlds) -> Self:
        """The same pushes of some worlds."""
        return replaced(self, force=worlds.pick(self.force, 2), point=worlds.pick(self.point, 2))

    def energy(self, prepared: None, placement: Placement) -> Tensor:
        """−Σ f · p [J] `[*batch]`."""
        return self._moment(placement.poses)[..., :3].diagonal(dim1=-2, dim2=-1).sum((-2, -1))
