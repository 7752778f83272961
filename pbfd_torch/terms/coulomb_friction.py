"""Coulomb friction with the real μ, fully implicit in the normal force."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.terms.checks import require_non_negative, require_positive, require_widening
from pbfd_torch.worlds import Worlds, replaced


def slip_factor(size: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
    """s and ds/dy of METHOD §4 at y = `size` ≥ 0: (2 − y/w)/w below `width` w, 1/y above; s·y rises smoothly from 0 to 1."""
    inside = size < width
    outer = torch.where(inside, torch.ones_like(size), size)
    inverse = 1 / width
    s = torch.where(inside, (2 - size * inverse) * inverse, 1 / outer)
    slope = torch.where(inside, -inverse * inverse, -1 / (outer * outer))
    return s, slope


def slip_work(size: Tensor, width: Tensor) -> Tensor:
    """S(y) = ∫ s·y dy from 0 to y = `size` ≥ 0, the work of one newton: y²/w (1 − y/(3w)) below `width` w, y − w/3 above."""
    ratio = size / width
    return torch.where(ratio < 1, size * ratio * (1 - ratio / 3), size - width / 3)


def slip_size(slip: Tensor) -> Tensor:
    """‖u‖ of `[*, 3]`, with derivatives of every order at u = 0, where they are set to zero."""
    square = (slip * slip).sum(-1)
    moves = square > 0
    return torch.where(moves, torch.where(moves, square, torch.ones_like(square)).sqrt(), torch.zeros_like(square))


def isotropic_slope(slip: Tensor, size: Tensor, factor: Tensor, slope: Tensor) -> Tensor:
    """d(factor(‖u‖) u)/du = factor·1 + (slope/‖u‖) u uᵀ `[*, 3, 3]`, with the second part zero at u = 0."""
    safe = torch.where(size > 0, size, torch.ones_like(size))
    eye = torch.eye(3, dtype=slip.dtype, device=slip.device)
    outer = slip[..., :, None] * slip[..., None, :]
    return factor[..., None, None] * eye + (slope / safe)[..., None, None] * outer


@dataclass(frozen=True, eq=False)
class CoulombFriction:
    """f∥ = −μ N s(‖u‖) u (METHOD §4): the dry friction law, smooth below the slip speed ε_v.

    `mu`: coefficient ≥ 0, one number or one per candidate `[*, npoint]` (MuJoCo's rule for two surfaces: the larger one).
    `slip_speed`: ε_v [m/s] > 0; under a tangential load W a sticking contact creeps at ε_v (1 − √(1 − W/(μN))),
    which is ε_v W/(2μN) while W is small."""

    mu: float | Tensor
    slip_speed: float = 1e-3

    def __post_init__(self) -> None:
        require_non_negative("mu", self.mu)
        require_positive("slip_speed", self.slip_speed, "m/s")

    def take(self, worlds: Worlds) -> Self:
        """The same law with the μ of some worlds."""
        return replaced(self, mu=worlds.pick(self.mu, 1))

    def force(self, normal: Tensor, normal_slope: Tensor, depth: Tensor, slip: Tensor, dt: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Friction force and its derivatives by depth and by slip: `[*, n, 3]`, `[*, n, 3]`, `[*, n, 3, 3]`.

        normal, normal_slope, depth: N, dN/dd, d `[*, n]`; slip: u over the step `[*, n, 3]`; dt broadcastable to `[*, n]`."""
        size = slip_size(slip)
        factor, slope = slip_factor(size, self.slip_speed * dt)
        unit = factor[..., None] * slip
        force = -(self.mu * normal)[..., None] * unit
        by_depth = -(self.mu * normal_slope)[..., None] * unit
        by_slip = -(self.mu * normal)[..., None, None] * isotropic_slope(slip, size, factor, slope)
        return force, by_depth, by_slip

    def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
        """μ N s(‖u‖) `[*, n]`: the force is minus this times the slip."""
        inverse = 1 / (self.slip_speed * dt)
        # as `slip_factor`, whose slope is not asked for here
        return self.mu * normal * torch.where(size * inverse < 1, (2 - size * inverse) * inverse, 1 / size)

    def slip_energy(self, normal: Tensor, depth: Tensor, slip: Tensor, dt: Tensor) -> Tensor:
        """μ N S(‖u‖) [J] `[*, n]` (see `slip_work`): minus its gradient by the slip, with N held still, is the force."""
        return self.mu * normal * slip_work(slip_size(slip), self.slip_speed * dt)

    def widened(self, factor: float) -> Self:
        """The same law, smooth below `factor` ≥ 1 times the slip speed."""
        require_widening(factor)
        return replaced(self, slip_speed=self.slip_speed * factor)
