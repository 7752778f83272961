"""Friction as position-based dynamics has it: the whole gradient of the paper's energy (Eq. 11), spurious normal part included."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.checks import require_non_negative
from pbfd_torch.terms.friction_law import per_size, slip_size
from pbfd_torch.terms.normal_force import power


@dataclass(frozen=True, eq=False)
class PbdFriction:
    """The force of the energy C∥ ‖u‖^{β+1} d^{γ+1} (Eq. 11), u the slip over the step: f∥ = −C∥ (β + 1) ‖u‖^{β−1} u d^{γ+1}, that
    of `PbfdFriction.as_derived`, and f* = C∥ (γ + 1) ‖u‖^{β+1} d^γ n, which lifts whatever slips.

    A point that carries a load W while it slips by y rises until C⊥ d^α + f* = W, so that its friction is
    (β + 1)/(γ + 1) (d/y) (W − C⊥ d^α): once d^α < W/((α + 1) C⊥), more C∥ means less friction.

    `stiffness`: C∥ ≥ 0 [N/m^{β+γ+1}], a number or `[*batch, npoint]`. `beta`, `gamma`: ≥ 1. With γ = 1 the slope of f* jumps where
    a slipping point touches."""

    stiffness: float | Tensor
    beta: float = 1.0
    gamma: float = 1.0

    def __post_init__(self) -> None:
        require_non_negative("C∥", self.stiffness)
        for name, value in (("β", self.beta), ("γ", self.gamma)):
            if not (math.isfinite(value) and value >= 1):
                raise InputError(f"{name} is {value}: must be ≥ 1 and finite, or the force is not Lipschitz")

    def take(self, worlds: Worlds) -> Self:
        """The same law with the C∥ of some worlds."""
        return replaced(self, stiffness=worlds.pick(self.stiffness, 1))

    def _weight(self, depth: Tensor, exponent: float) -> Tensor:
        """C∥ d^exponent, 0 where apart."""
        weight = self.stiffness * power(depth.clamp_min(0), exponent)
        return torch.where(depth > 0, weight, torch.zeros_like(weight))

    def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
        """C∥ (β + 1) y^{β−1} d^{γ+1}."""
        return (self.beta + 1) * self._weight(depth, self.gamma + 1) * power(size, self.beta - 1)

    def drag_slopes(self, normal: Tensor, normal_slope: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """See `FrictionLaw`."""
        b, g, factor = self.beta + 1, self.gamma + 1, power(size, self.beta - 1)
        by_size = (self.beta - 1) * b * self._weight(depth, g) * per_size(per_size(factor, size), size)
        return b * g * self._weight(depth, self.gamma) * factor, by_size

    def lift(self, depth: Tensor, size: Tensor) -> Tensor:
        """f* = C∥ (γ + 1) y^{β+1} d^γ."""
        return (self.gamma + 1) * self._weight(depth, self.gamma) * power(size, self.beta + 1)

    def lift_slopes(self, depth: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
        """See `Lifting`."""
        b, g = self.beta + 1, self.gamma + 1
        by_depth = g * self.gamma * self._weight(depth, self.gamma - 1) * power(size, b)
        return by_depth, b * g * self._weight(depth, self.gamma) * power(size, self.beta - 1)

    def energy(self, depth: Tensor, slip: Tensor, dt: Tensor) -> Tensor:
        """C∥ ‖u‖^{β+1} d^{γ+1} [J] `[*, n]`."""
        return self._weight(depth, self.gamma + 1) * power(slip_size(slip), self.beta + 1)
