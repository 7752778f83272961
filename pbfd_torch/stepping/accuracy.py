"""What is asked of steps whose length each world chooses for itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pbfd_torch.errors import InputError
from pbfd_torch.stepping.stepper import SHORTEST_STEP


@dataclass(frozen=True)
class Accuracy:
    """length: what a step's end may be off by, as estimated [m] > 0: the root mean square over the mass of a body, the largest of
    all bodies. shortest: a step that is never refused [s]."""

    length: float
    shortest: float

    @staticmethod
    def within(dt: float, length: float, shortest: float | None) -> Accuracy:
        """Of frames of length dt [s]; shortest: None: dt/4096. Raises `InputError` where one of the two is out of range."""
        if not (math.isfinite(length) and length > 0):
            raise InputError(f"accuracy is {length} m: must be > 0 and finite")
        least = 2 * SHORTEST_STEP
        chosen = max(dt / 4096, least) if shortest is None else float(shortest)
        if not least <= chosen <= max(dt, least):
            raise InputError(f"shortest is {chosen} s: must be from {least} s to dt, {dt} s")
        return Accuracy(float(length), chosen)
