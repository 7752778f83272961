"""The half-space: everything below a plane."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch

from pbfd_torch.contact.motion import Motion, Still
from pbfd_torch.contact.obstacle import Carrier
from pbfd_torch.contact.pairing import Touchable
from pbfd_torch.contact.surface import Plane
from pbfd_torch.errors import InputError


@dataclass(frozen=True)
class HalfSpace(Touchable):
    """All points p with normal · p < offset [m] at time 0. `normal` points out of the obstacle and is scaled to unit length."""

    name: str = "ground"
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    offset: float = 0.0
    motion: Motion = field(default_factory=Still)

    def __post_init__(self) -> None:
        length = math.hypot(*self.normal)
        if not (math.isfinite(length) and length > 0):
            raise InputError(f"normal of '{self.name}' is {self.normal}: must be finite and not zero")
        if not math.isfinite(self.offset):
            raise InputError(f"offset of '{self.name}' is {self.offset}: must be finite")
        self.require_friction(f"'{self.name}'")
        object.__setattr__(self, "normal", tuple(x / length for x in self.normal))

    def surface(self, dtype: torch.dtype, device: torch.device, reach: float = 0.0) -> Plane:
        """Its signed distance, in world axes at time 0; right everywhere."""
        return Plane(torch.tensor(self.normal, dtype=dtype, device=device), torch.tensor([self.offset], dtype=dtype, device=device))

    @property
    def thickness(self) -> float:
        """Endless."""
        return math.inf

    def carrier(self, dtype: torch.dtype, device: torch.device) -> Carrier | None:
        """What moves it, or None."""
        if not self.motion.moves and not any(self.motion.belt):
            return None
        return Carrier(torch.eye(4, dtype=dtype, device=device), self.motion)
