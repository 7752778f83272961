"""Coulomb friction that is stronger at rest than in motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.checks import require_non_negative, require_positive, require_widening
from pbfd_torch.terms.coulomb_friction import slip_factor, slip_factor_slope, slip_work
from pbfd_torch.terms.friction_law import per_size, slip_size


@dataclass(frozen=True, eq=False)
class StaticFriction:
    """f∥ = −N s(y) (μ_k + (μ_s − μ_k) exp(−x²)) u with y = ‖u‖, s as in `CoulombFriction` and x = (y/Δt − ε_v)₊/v_s: it rises to
    μ_s N at the slip speed ε_v and falls, as a Gaussian Stribeck curve of width v_s, to μ_k N; continuously differentiable.

    `mu_kinetic`: μ_k ≥ 0, `mu_static`: μ_s ≥ μ_k, numbers or one per candidate `[*, npoint]`; `slip_speed`: ε_v > 0 and
    `stribeck_speed`: v_s > 0 [m/s].

    Where friction falls with the speed a step may have several solutions, or flip between sticking and sliding. A body that slides
    on its weight mg has one at Δt < v_s/(√(2/e) (μ_s − μ_k) g): 6 ms with the default v_s and μ_s − μ_k = .2."""

    mu_static: float | Tensor
    mu_kinetic: float | Tensor
    slip_speed: float = 1e-3
    stribeck_speed: float = 1e-2

    def __post_init__(self) -> None:
        require_non_negative("kinetic μ", self.mu_kinetic)
        require_non_negative("static μ", self.mu_static)
        static, kinetic = torch.as_tensor(self.mu_static), torch.as_tensor(self.mu_kinetic)
        if not bool((static >= kinetic).all()):
            raise InputError(f"static μ is {static.tolist()}: must be ≥ the kinetic μ, {kinetic.tolist()}")
        require_positive("slip_speed", self.slip_speed, "m/s")
        require_positive("stribeck_speed", self.stribeck_speed, "m/s")

    def take(self, worlds: Worlds) -> Self:
        """The same law with the μ of some worlds."""
        return replaced(self, mu_static=worlds.pick(self.mu_static, 1), mu_kinetic=worlds.pick(self.mu_kinetic, 1))

    def _beyond(self, size: Tensor, dt: Tensor) -> Tensor:
        """x `[*, n]`."""
        return (size - self.slip_speed * dt).clamp_min(0) / (self.stribeck_speed * dt)

    def _excess(self, beyond: Tensor) -> Tensor:
        """(μ_s − μ_k) exp(−x²)."""
        return (self.mu_static - self.mu_kinetic) * torch.exp(-beyond * beyond)

    def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
        """N s(y) (μ_k + (μ_s − μ_k) exp(−x²))."""
        return normal * slip_factor(size, self.slip_speed * dt) * (self.mu_kinetic + self._excess(self._beyond(size, dt)))

    def drag_slopes(self, normal: Tensor, normal_slope: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """See `FrictionLaw`."""
        width, beyond = self.slip_speed * dt, self._beyond(size, dt)
        factor, excess = slip_factor(size, width), self._excess(beyond)
        mu, falls = self.mu_kinetic + excess, 2 * beyond * excess / (self.stribeck_speed * dt)
        slope = slip_factor_slope(size, width) * mu - factor * falls
        return normal_slope * factor * mu, normal * per_size(slope, size)

    def slip_energy(self, normal: Tensor, depth: Tensor, slip: Tensor, dt: Tensor) -> Tensor:
        """N (μ_s S(‖u‖) − (μ_s − μ_k) v_s Δt (x − ½√π erf x)) [J] `[*, n]`, S as in `slip_work`: minus its gradient by the slip,
        with N held still, is the force."""
        size = slip_size(slip)
        beyond = self._beyond(size, dt)
        fallen = self.stribeck_speed * dt * (beyond - 0.5 * math.sqrt(math.pi) * torch.erf(beyond))
        return normal * (self.mu_static * slip_work(size, self.slip_speed * dt) - (self.mu_static - self.mu_kinetic) * fallen)

    def widened(self, factor: float) -> Self:
        """The same law with both speeds `factor` ≥ 1 times as large."""
        require_widening(factor)
        return replaced(self, slip_speed=self.slip_speed * factor, stribeck_speed=self.stribeck_speed * factor)
