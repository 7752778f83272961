"""The paper's friction: a viscous force weighted by the depth (Eq. 12), without the spurious normal part of its energy."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.checks import require_non_negative, require_widening
from pbfd_torch.terms.friction_law import per_size, slip_size
from pbfd_torch.terms.normal_force import power


@dataclass(frozen=True, eq=False)
class PbfdFriction:
    """f∥ = −C∥ (β + 1) ‖u‖^e u d^{γ+1}, u the slip over the step.

    Eq. 12 prints e = β; the gradient of the energy that it comes from (Eq. 11) has e = β − 1. Both exist: `as_printed` and
    `as_derived`; with β = 1 the first is quadratic in the slip, the second linear.

    `stiffness`: C∥ ≥ 0, a number or `[*batch, npoint]`; `beta`, `gamma` > 0; `slip_exponent`: e ≥ 0."""

    stiffness: float | Tensor
    beta: float
    gamma: float
    slip_exponent: float

    def __post_init__(self) -> None:
        require_non_negative("C∥", self.stiffness)
        if not (self.beta > 0 and self.gamma > 0 and math.isfinite(self.beta + self.gamma)):
            raise InputError(f"β is {self.beta} and γ is {self.gamma}: must be > 0 and finite")
        if not (math.isfinite(self.slip_exponent) and self.slip_exponent >= 0):
            raise InputError(f"slip exponent is {self.slip_exponent}: must be ≥ 0 and finite")

    @staticmethod
    def as_printed(stiffness: float | Tensor, beta: float = 1.0, gamma: float = 1.0) -> PbfdFriction:
        """Eq. 12 with ‖u‖^β, as the paper prints it."""
        return PbfdFriction(stiffness, beta, gamma, beta)

    @staticmethod
    def as_derived(stiffness: float | Tensor, beta: float = 1.0, gamma: float = 1.0) -> PbfdFriction:
        """Eq. 12 with ‖u‖^{β−1}, as the gradient of Eq. 11 gives it; needs β ≥ 1 to be smooth at rest."""
        if beta < 1:
            raise InputError(f"β is {beta}: the derived law needs β ≥ 1 to stay finite at zero slip")
        return PbfdFriction(stiffness, beta, gamma, beta - 1)

    def calibrated(self, mu: float | Tensor, normal_stiffness: float | Tensor, speed: float | Tensor, dt: float) -> PbfdFriction:
        """The same law with the C∥ at which a contact sliding at `speed` [m/s] feels μ: with α = 2 and γ = 1 friction is
        proportional to the normal force, μ = (β + 1) (C∥/C⊥) (v Δt)^{e + 1} (METHOD §4). It holds at this speed and Δt only.
        `calibration.calibrated_pbfd` is for any α and γ."""
        share = (self.beta + 1) * (speed * dt) ** (self.slip_exponent + 1)
        return replace(self, stiffness=mu * normal_stiffness / share)

    def take(self, worlds: Worlds) -> Self:
        """The same law with the C∥ of some worlds."""
        return replaced(self, stiffness=worlds.pick(self.stiffness, 1))

    def _weight(self, depth: Tensor, exponent: float) -> Tensor:
        return self.stiffness * (self.beta + 1) * power(depth.clamp_min(0), exponent)

    def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
        """C∥ (β + 1) y^e d^{γ+1}."""
        return self._weight(depth, self.gamma + 1) * power(size, self.slip_exponent)

    def drag_slopes(self, normal: Tensor, normal_slope: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """See `FrictionLaw`."""
        factor = power(size, self.slip_exponent)
        by_depth = (self.gamma + 1) * self._weight(depth, self.gamma) * factor
        return by_depth, self.slip_exponent * self._weight(depth, self.gamma + 1) * per_size(per_size(factor, size), size)

    def slip_energy(self, normal: Tensor, depth: Tensor, slip: Tensor, dt: Tensor) -> Tensor:
        """C∥ (β + 1)/(e + 2) ‖u‖^{e+2} d^{γ+1} [J] `[*, n]`: minus its gradient by the slip, with d held still, is the force. With
        e = β − 1 it is the density of Eq. 11 times C∥."""
        weight = self._weight(depth, self.gamma + 1)
        return weight * power(slip_size(slip), self.slip_exponent + 2) / (self.slip_exponent + 2)

    def widened(self, factor: float) -> Self:
        """Itself: this law has no slip speed below which it is smoothed."""
        require_widening(factor)
        return self
