"""Coulomb friction with the real μ, fully implicit in the normal force."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.checks import require_non_negative, require_positive, require_widening
from pbfd_torch.terms.friction_law import per_size, slip_size


def slip_factor(size: Tensor, width: Tensor) -> Tensor:
    """s of METHOD §4 at y = `size` ≥ 0: (2 − y/w)/w below `width` w, 1/y above; s·y rises smoothly from 0 to 1."""
    return (2 - torch.minimum(size, width) / width) / torch.maximum(size, width)


def slip_factor_slope(size: Tensor, width: Tensor) -> Tensor:
    """ds/dy of `slip_factor`, −1/max(y, w)²."""
    return -1 / torch.maximum(size, width).square()


def slip_work(size: Tensor, width: Tensor) -> Tensor:
    """S(y) = ∫ s·y dy from 0 to y = `size` ≥ 0, the work of one newton: y²/w (1 − y/(3w)) below `width` w, y − w/3 above."""
    ratio = size / width
    return torch.where(ratio < 1, size * ratio * (1 - ratio / 3), size - width / 3)


@dataclass(frozen=True, eq=False)
class DryFriction(ABC):
    """f∥ = −μ N s(‖u‖) u, smooth over some width of slip; Coulomb's law and those like it. `mu`: coefficient ≥ 0, one number or one
    per candidate `[*, npoint]` (MuJoCo's rule for two surfaces: the larger one)."""

    mu: float | Tensor

    def __post_init__(self) -> None:
        require_non_negative("mu", self.mu)

    @abstractmethod
    def width(self, dt: Tensor) -> Tensor:
        """ε [m], the slip over a step from which on friction is fully there."""

    @abstractmethod
    def widened(self, factor: float) -> Self:
        """See `SlipLaw`."""

    def take(self, worlds: Worlds) -> Self:
        """The same law with the μ of some worlds."""
        return replaced(self, mu=worlds.pick(self.mu, 1))

    def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
        """μ N s(y)."""
        return self.mu * normal * slip_factor(size, self.width(dt))

    def drag_slopes(self, normal: Tensor, normal_slope: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """See `FrictionLaw`."""
        width = self.width(dt)
        slope = per_size(slip_factor_slope(size, width), size)
        return self.mu * normal_slope * slip_factor(size, width), self.mu * normal * slope

    def slip_energy(self, normal: Tensor, depth: Tensor, slip: Tensor, dt: Tensor) -> Tensor:
        """μ N S(‖u‖) [J] `[*, n]` (see `slip_work`): minus its gradient by the slip, with N held still, is the force."""
        return self.mu * normal * slip_work(slip_size(slip), self.width(dt))


@dataclass(frozen=True, eq=False)
class CoulombFriction(DryFriction):
    """The dry friction law (METHOD §4), smooth below the slip speed ε_v: ε = ε_v Δt.

    `slip_speed`: ε_v [m/s] > 0; under a tangential load W a sticking contact creeps at ε_v (1 − √(1 − W/(μN))),
    which is ε_v W/(2μN) while W is small."""

    slip_speed: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("slip_speed", self.slip_speed, "m/s")

    def width(self, dt: Tensor) -> Tensor:
        """See `DryFriction`."""
        return self.slip_speed * dt

    def widened(self, factor: float) -> Self:
        """The same law, smooth below `factor` ≥ 1 times the slip speed."""
        require_widening(factor)
        return replaced(self, slip_speed=self.slip_speed * factor)
