"""Friction with the normal force held still: a gradient, which friction that follows the normal force is not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.friction_law import FrictionLaw, SlipLaw


@dataclass(frozen=True, eq=False)
class LaggedFriction:
    """A friction law at a frozen normal force N̂ and depth d̂, both `[*batch, npoint]`, whatever the depth is now:
    f∥ = −μ N̂ s(‖u‖) u for Coulomb's law, −C∥ (β + 1) ‖u‖^e u d̂^{γ+1} for the paper's (Eq. 12)."""

    law: SlipLaw
    normal: Tensor
    depth: Tensor

    def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
        """The law's at the frozen normal force and depth."""
        return self.law.drag(self.normal, self.depth, size, dt)

    def drag_slopes(self, normal: Tensor, normal_slope: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """See `FrictionLaw`; nothing depends on the present depth."""
        _, by_size = self.law.drag_slopes(self.normal, normal_slope, self.depth, size, dt)
        return torch.zeros_like(by_size), by_size

    def energy(self, depth: Tensor, slip: Tensor, dt: Tensor) -> Tensor:
        """μ N̂ S(‖u‖) for Coulomb's law, S as in `slip_work`; C∥ (β + 1)/(e + 2) ‖u‖^{e+2} d̂^{γ+1} for the paper's: [J] `[*, n]`."""
        return self.law.slip_energy(self.normal, self.depth, slip, dt)

    def take(self, worlds: Worlds) -> Self:
        """The same frozen friction of some worlds."""
        return replaced(self, law=self.law.take(worlds), normal=worlds.pick(self.normal, 1), depth=worlds.pick(self.depth, 1))

    def widened(self, factor: float) -> Self:
        """The same frozen friction, smooth over a `factor` ≥ 1 times wider range of slip speeds."""
        return replaced(self, law=self.law.widened(factor))


def lagged_law(law: FrictionLaw | None, normal: Tensor, depth: Tensor) -> FrictionLaw | None:
    """The law held at normal forces and depths `[*batch, npoint]` where it is a `SlipLaw` or held already; else the law itself."""
    inner = unlagged(law)
    return LaggedFriction(inner, normal, depth) if isinstance(inner, SlipLaw) else law


def unlagged(law: FrictionLaw | None) -> FrictionLaw | None:
    """The law that is held, or itself."""
    return law.law if isinstance(law, LaggedFriction) else law


def widened_law(law: FrictionLaw | None, factor: float) -> FrictionLaw | None:
    """The law smooth over a `factor` ≥ 1 times wider range of slip speeds, where it has one; else the law."""
    return law.widened(factor) if isinstance(law, SlipLaw | LaggedFriction) else law
