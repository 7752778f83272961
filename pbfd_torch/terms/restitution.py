"""Restitution: how much of an impact comes back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.normal_force import NormalForce

_HARDER = 300.0  # how many times less deep a contact gets that throws back; what it gives way is lost to the rebound


@dataclass(frozen=True)
class Restitution:
    """Newton's law v⁺ = −e v⁻ for the normal velocity of a contact, over the step of the impact.

    A candidate that would end its step inside ends it by r further out than it was instead, and so leaves at r/Δt. It bounces from
    where it is at the start of that step, up to |v⁻|Δt early; r makes up for that: implicit Euler keeps ½v² + a x ∓ ½a|v|Δt in
    flight (height x, speed v down or up, acceleration a towards the solid), and the bounce leaves e² of it. So a drop from h
    rebounds to e²h at any Δt, but for what the contact gives way, and every bounce is lower than the last. A rebound lower than
    where the step began, so at most |v⁻|Δt, is lost.

    `coefficient`: e in [0, 1]. `threshold` [m/s] ≥ 0: slower impacts do not bounce, so that a bouncing body comes to rest."""

    coefficient: float
    threshold: float = 0.1

    def __post_init__(self) -> None:
        if not 0 <= self.coefficient <= 1:
            raise InputError(f"coefficient of restitution is {self.coefficient}: must be in [0, 1]")
        if not (math.isfinite(self.threshold) and self.threshold >= 0):
            raise InputError(f"threshold of restitution is {self.threshold} m/s: must be ≥ 0 and finite")

    def bounce(self, gap: Tensor, free: Tensor, dt: Tensor, coasting: Tensor | None = None) -> Tensor:
        """How far the solid's surface is moved out for the step `[*, n]` [m], 0 where nothing bounces.

        gap: at the start of the step. free, coasting: with which the motion would end it without the contact, and without any
        force (None: the same). Each `[*, n]` [m]."""
        coasting = free if coasting is None else coasting
        closing, pull = gap - coasting, (coasting - free).clamp_min(0)  # |v⁻|Δt, aΔt²
        square = self.coefficient**2
        left = square * closing * (closing + pull) - 2 * (1 - square) * pull * gap
        bounces = (gap >= 0) & (free < 0) & (closing > self.threshold * dt) & (left > 0)
        root = (pull * pull + 4 * torch.where(bounces, left, torch.ones_like(left))).sqrt()
        return torch.where(bounces, gap + 0.5 * (root - pull), torch.zeros_like(gap))

    def stiffened(self, law: NormalForce, bounce: Tensor) -> NormalForce:
        """The normal force during the step, much stiffer where a candidate bounces."""
        return replaced(law, stiffness=law.stiffness * torch.where(bounce > 0, _HARDER**law.exponent, 1.0).to(bounce.dtype))
