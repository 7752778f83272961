"""Who touches whom, and with which friction: MuJoCo's rules."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pbfd_torch.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Touchable:
    """What every collider and obstacle has besides its shape.

    `friction`: Coulomb's μ of its surface. Two things touch where (`group` of one) & (`mask` of the other) ≠ 0 in either direction
    (MuJoCo's contype and conaffinity). Of the two, the larger `priority` decides μ; at equal priority the larger μ does.
    `frictionless`: there is no friction where this one decides, or where the other one is frictionless too."""

    friction: float = 1.0
    group: int = 1
    mask: int = 1
    priority: int = 0
    frictionless: bool = False

    def require_friction(self, whose: str) -> None:
        """Raises `InputError` unless μ is finite and ≥ 0."""
        if not (math.isfinite(self.friction) and self.friction >= 0):
            raise InputError(f"friction of {whose} is {self.friction}: must be ≥ 0 and finite")


def touch(a: Touchable, b: Touchable) -> bool:
    """Whether two things collide by their groups and masks."""
    return bool((a.group & b.mask) or (b.group & a.mask))


def friction_between(a: Touchable, b: Touchable) -> float:
    """μ of a pair: that of the higher priority, else the larger one; 0 where all that decide are frictionless."""
    highest = max(a.priority, b.priority)
    deciding = [x for x in (a, b) if x.priority == highest]
    return 0.0 if all(x.frictionless for x in deciding) else max(x.friction for x in deciding)
