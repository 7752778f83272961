"""The half-space: everything below a plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pbfd_torch.errors import InputError


@dataclass(frozen=True)
class HalfSpace:
    """All points p with normal · p < offset [m]. `normal` points out of the obstacle and is scaled to unit length.
    `friction`, `group`, `mask`, `priority` and `frictionless` as in `Collider`."""

    name: str = "ground"
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    offset: float = 0.0
    friction: float = 1.0
    group: int = 1
    mask: int = 1
    priority: int = 0
    frictionless: bool = False

    def __post_init__(self) -> None:
        length = math.hypot(*self.normal)
        if not (math.isfinite(length) and length > 0):
            raise InputError(f"normal of '{self.name}' is {self.normal}: must be finite and not zero")
        if not math.isfinite(self.offset):
            raise InputError(f"offset of '{self.name}' is {self.offset}: must be finite")
        if not (math.isfinite(self.friction) and self.friction >= 0):
            raise InputError(f"friction of '{self.name}' is {self.friction}: must be ≥ 0 and finite")
        object.__setattr__(self, "normal", tuple(x / length for x in self.normal))
