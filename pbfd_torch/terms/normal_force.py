"""The normal force as a power of the penetration depth (Eq. 8)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.checks import require_positive
from pbfd_torch.terms.release import NormalLaw, Releasing, require_release
from pbfd_torch.tree.articulation import Articulation


def power(base: Tensor, exponent: float) -> Tensor:
    """base ** exponent for base ≥ 0 and exponent ≥ 0; whole exponents by products, so that a batch and a single world round
    alike."""
    if exponent == int(exponent) and exponent <= 4:
        if exponent == 0:
            return torch.ones_like(base)
        result = base
        for _ in range(int(exponent) - 1):
            result = result * base
        return result
    positive = base > 0
    safe = torch.where(positive, base, torch.ones_like(base))
    return torch.where(positive, torch.exp(exponent * torch.log(safe)), torch.zeros_like(base))


@dataclass(frozen=True, eq=False)
class NormalForce:
    """f⊥ = C⊥ d^α n (Eq. 8), energy C⊥ d^{α+1}/(α+1) (Eq. 9); at rest d = (N/C⊥)^{1/α}.

    `stiffness`: C⊥ [N/m^α] > 0, one number, one per world `[*batch, 1]` or one per candidate `[*batch, npoint]`.
    `exponent`: α > 1, so that the residual is continuously differentiable (what GE needs).
    `release`: speed > 0 of leaving [m/s] at which a contact pushes no more, so that impacts are inelastic at any Δt (`Releasing`);
    infinite: never, as in the paper, and short steps bounce."""

    stiffness: float | Tensor
    exponent: float = 2.0
    release: float = 0.1

    def __post_init__(self) -> None:
        require_positive("stiffness", self.stiffness, "N/m^α")
        if not (math.isfinite(self.exponent) and self.exponent > 1):
            raise InputError(f"exponent α is {self.exponent}: must be > 1 and finite, or the residual is not smooth")
        require_release(self.release)

    @staticmethod
    def for_weight(weight: float | Tensor, penetration: float = 3e-4, exponent: float = 2.0) -> NormalForce:
        """The stiffness at which a load `weight` [N] on one point rests `penetration` [m] deep."""
        require_positive("weight", weight, "N")
        require_positive("penetration", penetration, "m")
        return NormalForce(weight / penetration**exponent, exponent)

    def take(self, worlds: Worlds) -> Self:
        """The same law with the stiffness of some worlds."""
        return replaced(self, stiffness=worlds.pick(self.stiffness, 1))

    def scaled(self, factor: float) -> NormalForce:
        """The same law with C⊥ scaled by `factor` > 0."""
        return replaced(self, stiffness=self.stiffness * factor)

    def seen_from(self, distance: float) -> DistantForce:
        """The same law as derivatives may see it, from `distance` > 0 [m] on."""
        return DistantForce(self.stiffness, self.exponent, self.release, distance)

    def during(self, start: Tensor | None, dt: Tensor) -> NormalLaw:
        """The law of a step of dt `[*batch, 1]` [s] that begins at depths `start` `[*batch, npoint]` [m]; None: not known."""
        return self if start is None else Releasing(self, start, self.release * dt)

    def force(self, depth: Tensor) -> tuple[Tensor, Tensor]:
        """N and dN/dd `[*batch, npoint]` at depth d (≤ 0: apart, no force)."""
        return self.push(depth), self.slope(depth)

    def push(self, depth: Tensor) -> Tensor:
        """N alone."""
        return self.stiffness * power(depth.clamp_min(0), self.exponent)

    def slope(self, depth: Tensor) -> Tensor:
        """dN/dd alone."""
        return self.stiffness * self.exponent * power(depth.clamp_min(0), self.exponent - 1)

    def energy(self, depth: Tensor) -> Tensor:
        """C⊥ d^{α+1}/(α+1) [J] per candidate."""
        return self.stiffness * power(depth.clamp_min(0), self.exponent + 1) / (self.exponent + 1)


@dataclass(frozen=True, eq=False)
class DistantForce(NormalForce):
    """C⊥ (δ ln(1 + e^{d/δ}))^α: sets in before anything touches, about δ = `distance` [m] away. For derivatives only: it has no
    energy in closed form."""

    distance: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("distance", self.distance, "m")

    def _felt(self, depth: Tensor) -> Tensor:
        return self.distance * torch.nn.functional.softplus(depth / self.distance)

    def push(self, depth: Tensor) -> Tensor:
        """See `NormalForce`."""
        return super().push(self._felt(depth))

    def slope(self, depth: Tensor) -> Tensor:
        """See `NormalForce`."""
        return super().slope(self._felt(depth)) * torch.sigmoid(depth / self.distance)

    def energy(self, depth: Tensor) -> Tensor:
        """There is none."""
        raise NotImplementedError("a force that is seen from a distance is for derivatives, and has no energy")


def default_stiffness(articulation: Articulation, penetration: float = 1e-3) -> NormalForce:
    """The normal force at which the whole articulation, on one point and under 9.81 m/s², rests `penetration` [m] deep: nothing to
    tune. C⊥ is `[*batch, 1]` where the masses differ from world to world."""
    weight = 9.81 * articulation.mass.sum(-1).detach()
    return NormalForce.for_weight(float(weight) if weight.ndim == 0 else weight[..., None], penetration)
