"""A solid as samples of its signed distance on a regular grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.contact.splines import coefficients_through, evaluate
from pbfd_torch.contact.surface import Field
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.constants import filled
from pbfd_torch.tensors.facts import fact
from pbfd_torch.tensors.vectors import dot, outer
from pbfd_torch.tensors.worlds import Worlds


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """φ is the tricubic B-spline with `coefficients` `[nx + 2, ny + 2, nz + 2]` (see `coefficients_through`) over nodes at
    origin `[3]` + spacing `[]` · (i, j, k) [m]: C² across cells. ∇φ is its gradient, of nearly unit length, and not scaled to it:
    a force along it has a potential. An edge of the solid is rounded over about a cell.

    Beyond the grid φ stays finite, C¹ and larger than at the border, but it is no distance any more: the spline runs out constant
    and √(e² + a²) − a is added, with e the distance to the grid and a the spacing. Centres of spheres that touch the solid must be
    inside the grid."""

    origin: Tensor
    spacing: Tensor
    coefficients: Tensor

    def __post_init__(self) -> None:
        _ = self.last

    @classmethod
    def through(
        cls,
        values: NDArray[np.float64],
        origin: tuple[float, float, float],
        spacing: float,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> Self:
        """The grid that takes the signed distances `[nx, ny, nz]` [m] at its nodes, at least 2 along each axis."""
        if values.ndim != 3 or min(values.shape) < 2:
            raise InputError(f"distances have shape {values.shape}: must be [nx, ny, nz], each ≥ 2")
        if not np.isfinite(values).all() or not np.isfinite(origin).all():
            raise InputError("distances and the origin of a grid must be finite")
        if not (math.isfinite(spacing) and spacing > 0):
            raise InputError(f"spacing is {spacing} m: must be > 0 and finite")
        coefficients = torch.as_tensor(coefficients_through(np.asarray(values, np.float64)), dtype=dtype, device=device)
        return cls(
            torch.tensor(origin, dtype=dtype, device=device), torch.tensor(spacing, dtype=dtype, device=device), coefficients
        )

    @fact("origin", "spacing", "coefficients")
    def last(self) -> Tensor:
        """The last node `[3]` [m]."""
        return self.origin + self.spacing * filled([size - 3 for size in self.coefficients.shape], self.origin)

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        beyond = points - points.clamp(self.origin, self.last)
        rounded = (dot(beyond, beyond) + self.spacing * self.spacing).sqrt()
        distance, normal = evaluate(self.coefficients, self.origin, self.spacing, points, 1)

        def curvature() -> Tensor:
            turn = beyond / rounded.unsqueeze(-1)
            bend = torch.diag_embed((beyond != 0).to(points.dtype)) - outer(turn, turn)
            hessian = evaluate(self.coefficients, self.origin, self.spacing, points, 2)[2]
            return hessian + bend / rounded[..., None, None]

        return Field(distance + (rounded - self.spacing), normal + beyond / rounded.unsqueeze(-1), curvature, exact=False)

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`; all worlds share the grid."""
        return self
