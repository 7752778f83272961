"""What controls may be."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.errors import InputError


@dataclass(frozen=True, eq=False)
class Limits:
    """`lower`, `upper`: `[nu]` or per world `[*batch, nu]`, ∓inf where there is none."""

    lower: Tensor
    upper: Tensor

    def __post_init__(self) -> None:
        if self.lower.shape != self.upper.shape or self.lower.ndim == 0:
            raise InputError(
                f"lower and upper have shapes {tuple(self.lower.shape)} and {tuple(self.upper.shape)}: must be the same"
            )
        if not bool((self.lower < self.upper).all()):
            raise InputError(f"lower limits {self.lower.tolist()} must be below upper limits {self.upper.tolist()}")

    @staticmethod
    def within(effort: Tensor) -> Limits:
        """±effort `[nu]` > 0."""
        return Limits(-effort, effort)

    @staticmethod
    def none(like: Tensor) -> Limits:
        """No limits for controls `[*, nu]`."""
        free = torch.full_like(like[(0,) * (like.ndim - 1)], torch.inf)
        return Limits(-free, free)

    def clamped(self, controls: Tensor) -> Tensor:
        """Controls `[*, *batch, nu]` within the limits, to the bit."""
        return torch.maximum(torch.minimum(controls, self.upper), self.lower)

    def left(self, controls: Tensor) -> tuple[Tensor, Tensor]:
        """How far controls `[T, *batch, nu]` are from the lower and the upper limits."""
        return self.lower - controls, self.upper - controls
