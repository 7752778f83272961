"""Friction with the normal force held still: a gradient, which friction that follows the normal force is not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from pbfd_torch.worlds import Worlds, replaced


@runtime_checkable
class SlipLaw(Protocol):
    """A friction law whose force is the gradient of a scalar of the slip while the normal force and the depth are held still."""

    def force(self, normal: Tensor, normal_slope: Tensor, depth: Tensor, slip: Tensor, dt: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `FrictionLaw`."""
        ...

    def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
        """See `FrictionLaw`."""
        ...

    def slip_energy(self, normal: Tensor, depth: Tensor, slip: Tensor, dt: Tensor) -> Tensor:
        """The scalar [J] `[*, n]` whose gradient by the slip is minus the force, 0 at zero slip."""
        ...

    def take(self, worlds: Worlds) -> Self:
        """See `FrictionLaw`."""
        ...

    def widened(self, factor: float) -> Self:
        """The same law, smooth over a `factor` ≥ 1 times wider range of slip speeds."""
        ...


@dataclass(frozen=True, eq=False)
class LaggedFriction:
    """A friction law at a frozen normal force N̂ and depth d̂, both `[*batch, npoint]`, whatever the depth is now:
    f∥ = −μ N̂ s(‖u‖) u for Coulomb's law, −C∥ (β + 1) ‖u‖^e u d̂^{γ+1} for the paper's (Eq. 12)."""

    law: SlipLaw
    normal: Tensor
    depth: Tensor

    def force(self, normal: Tensor, normal_slope: Tensor, depth: Tensor, slip: Tensor, dt: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Friction force and its derivatives by depth, which is zero, and by slip, shapes as in `CoulombFriction.force`."""
        force, by_depth, by_slip = self.law.force(self.normal, normal_slope, self.depth, slip, dt)
        return force, torch.zeros_like(by_depth), by_slip

    def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
        """The law's at the frozen normal force and depth."""
        return self.law.drag(self.normal, self.depth, size, dt)

    def energy(self, slip: Tensor, dt: Tensor) -> Tensor:
        """μ N̂ S(‖u‖) for Coulomb's law, S as in `slip_work`; C∥ (β + 1)/(e + 2) ‖u‖^{e+2} d̂^{γ+1} for the paper's: [J] `[*, n]`."""
        return self.law.slip_energy(self.normal, self.depth, slip, dt)

    def take(self, worlds: Worlds) -> Self:
        """The same frozen friction of some worlds."""
        return replaced(self, law=self.law.take(worlds), normal=worlds.pick(self.normal, 1), depth=worlds.pick(self.depth, 1))

    def widened(self, factor: float) -> Self:
        """The same frozen friction, smooth over a `factor` ≥ 1 times wider range of slip speeds."""
        return replaced(self, law=self.law.widened(factor))
