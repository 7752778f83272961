"""Coulomb friction that remembers where a contact stuck, and so does not creep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.checks import require_positive, require_widening
from pbfd_torch.terms.coulomb_friction import DryFriction
from pbfd_torch.terms.friction_law import slip_size


@dataclass(frozen=True, eq=False)
class AnchoredFriction(DryFriction):
    """f∥ = −μ N s(‖w‖) w with w = u + a: the slip is measured from an anchor, which a contact drags along at most `stretch` behind
    itself. A stuck contact under a load stands still at the stretch that carries it: it does not creep.

    `stretch`: ε [m] > 0, how far a contact gives way before it slides."""

    stretch: float = 1e-5

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("stretch", self.stretch, "m")

    def width(self, dt: Tensor) -> Tensor:
        """See `DryFriction`."""
        return torch.full_like(dt, self.stretch)

    def widened(self, factor: float) -> Self:
        """The same law with a `factor` ≥ 1 times longer stretch."""
        require_widening(factor)
        return replaced(self, stretch=self.stretch * factor)

    def kept(self, slip: Tensor, depth: Tensor) -> Tensor:
        """What the anchor is behind by after a step that ended with w = `slip` `[*, n, 3]` at a depth `[*, n]`: w, cut to the
        stretch; nothing where the contact has opened."""
        size = slip_size(slip)[..., None]
        shortened = torch.where(size > self.stretch, self.stretch / torch.where(size > 0, size, torch.ones_like(size)), 1.0)
        return torch.where((depth > 0)[..., None], shortened * slip, torch.zeros_like(slip))
