"""What makes impacts inelastic however short the steps are: a contact that is left faster than at a certain speed pushes no more.

A power of the depth alone (Eq. 8) stores the energy of an impact and gives it back. A step much longer than the contact lasts
loses it all the same, which is why the paper needs nothing else; shorter steps let the body bounce.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pbfd_torch.errors import InputError

# Gauss–Legendre nodes and weights on [0, 1]: exact for polynomials up to the ninth degree
_NODES = (0.04691007703066800, 0.23076534494715845, 0.5, 0.76923465505284155, 0.95308992296933200)
_WEIGHTS = (0.11846344252809454, 0.23931433524968324, 0.28444444444444444, 0.23931433524968324, 0.11846344252809454)


def require_release(speed: float) -> None:
    """Raises `InputError` unless the speed is > 0; infinite: nothing is ever let go."""
    if not speed > 0:
        raise InputError(
            f"release is {speed}: must be a speed > 0, or infinite for a contact or limit that gives back what it takes"
        )


class NormalLaw(Protocol):
    """A normal force that depends on the depth d `[*batch, npoint]` [m]."""

    def push(self, depth: Tensor) -> Tensor:
        """N [N]."""
        ...

    def slope(self, depth: Tensor) -> Tensor:
        """dN/dd [N/m]."""
        ...

    def energy(self, depth: Tensor) -> Tensor:
        """Its integral [J], up to a constant."""
        ...


@dataclass(frozen=True, eq=False)
class Releasing:
    """N(d) s(x) during one step, s = x² (3 − 2x) with x = 1 − (d₀ − d)/(v Δt) within [0, 1]: all of it where the step ends as deep
    as it began or deeper, none where it leaves faster than at v. It still is a function of the depth alone, so it still has an
    energy; over several steps it gives back nothing that it took, but for what a speed of v holds.

    Attributes:
        law: N.
        start: d₀ `[*batch, npoint]`, the depth at the start of the step [m].
        range: v Δt `[*batch, 1]` [m].
    """

    law: NormalLaw
    start: Tensor
    range: Tensor

    def _share(self, depth: Tensor) -> tuple[Tensor, Tensor]:
        """s and ds/dd."""
        x = (1 - (self.start - depth) / self.range).clamp(0, 1)
        return x * x * (3 - 2 * x), 6 * x * (1 - x) / self.range

    def push(self, depth: Tensor) -> Tensor:
        """See `NormalLaw`."""
        return self._share(depth)[0] * self.law.push(depth)

    def slope(self, depth: Tensor) -> Tensor:
        """See `NormalLaw`."""
        share, slope = self._share(depth)
        return share * self.law.slope(depth) + slope * self.law.push(depth)

    def energy(self, depth: Tensor) -> Tensor:
        """See `NormalLaw`; where the force is released, by Gauss's quadrature: exact for whole exponents up to 6."""
        least = (self.start - self.range).clamp_min(0)
        width = torch.minimum(depth, self.start).clamp_min(least) - least
        released = torch.zeros_like(width)
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            released = released + weight * self.push(least + node * width)
        return width * released + self.law.energy(torch.maximum(depth, self.start)) - self.law.energy(self.start)
