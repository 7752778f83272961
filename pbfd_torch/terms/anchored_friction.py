"""Coulomb friction that remembers where a contact stuck, and so does not creep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.terms.checks import require_non_negative, require_positive, require_widening
from pbfd_torch.terms.coulomb_friction import slip_factor, slip_factor_slope, slip_work
from pbfd_torch.terms.friction_law import per_size, slip_size
from pbfd_torch.worlds import Worlds, replaced


@dataclass(frozen=True, eq=False)
class AnchoredFriction:
    """f∥ = −μ N s(‖w‖) w with w = u + a: the slip is measured from an anchor, which a contact drags along at most `stretch` behind
    itself. A stuck contact under a load stands still at the stretch that carries it: it does not creep.

    `mu`: as in `CoulombFriction`. `stretch` [m] > 0: how far a contact gives way before it slides; s is smooth below it."""

    mu: float | Tensor
    stretch: float = 1e-5

    def __post_init__(self) -> None:
        require_non_negative("mu", self.mu)
        require_positive("stretch", self.stretch, "m")

    def take(self, worlds: Worlds) -> Self:
        """The same law with the μ of some worlds."""
        return replaced(self, mu=worlds.pick(self.mu, 1))

    def _width(self, like: Tensor) -> Tensor:
        return torch.full((), self.stretch, dtype=like.dtype, device=like.device)

    def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
        """μ N s(y)."""
        return self.mu * normal * slip_factor(size, self._width(size))

    def drag_slopes(self, normal: Tensor, normal_slope: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """See `FrictionLaw`."""
        width = self._width(size)
        slope = per_size(slip_factor_slope(size, width), size)
        return self.mu * normal_slope * slip_factor(size, width), self.mu * normal * slope

    def slip_energy(self, normal: Tensor, depth: Tensor, slip: Tensor, dt: Tensor) -> Tensor:
        """μ N S(‖w‖) [J] `[*, n]`, see `slip_work`."""
        return self.mu * normal * slip_work(slip_size(slip), self._width(depth))

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
