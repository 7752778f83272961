"""Terrain: everything below a smooth height over the plane."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pbfd_torch.contact.splines import coefficients_through, evaluate
from pbfd_torch.contact.surface import Field
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.vectors import dot, outer, rotated
from pbfd_torch.tensors.worlds import Worlds


@dataclass(frozen=True, eq=False)
class HeightField:
    """Everything below z = h(x, y), the C² bicubic B-spline through `heights` `[nx, ny]` [m], nx and ny ≥ 2, first index along x.
    The samples are `spacing` = (dx, dy) [m] apart and centred at x = y = 0. Beyond the border the terrain goes on: within two cells
    it turns level across the border, C², at about the height that the border's slope reaches one cell out. A step between
    neighbouring samples becomes a slope over one cell, with waves of up to 11 % of its height beside it."""

    heights: NDArray[np.float64]
    spacing: tuple[float, float]

    def __post_init__(self) -> None:
        heights = np.array(self.heights, np.float64)
        if heights.ndim != 2 or min(heights.shape) < 2:
            raise InputError(f"heights have shape {heights.shape}: must be [nx, ny], each ≥ 2")
        if not np.isfinite(heights).all():
            raise InputError(f"{(~np.isfinite(heights)).sum()} of {heights.size} heights are not finite: all must be")
        if np.shape(self.spacing) != (2,) or not all(math.isfinite(x) and x > 0 for x in self.spacing):
            raise InputError(f"spacing of heights is {self.spacing} m: must be (dx, dy), each > 0 and finite")
        object.__setattr__(self, "heights", heights)

    @classmethod
    def from_function(
        cls,
        function: Callable[[NDArray[np.float64], NDArray[np.float64]], ArrayLike],
        size: tuple[float, float],
        resolution: float,
    ) -> Self:
        """Samples of h = function(x, y) [m], of arrays, over size[0] × size[1] [m], at most `resolution` [m] apart."""
        if np.shape(size) != (2,) or not all(math.isfinite(x) and x > 0 for x in (*size, resolution)):
            raise InputError(f"size {size} m and resolution {resolution} m of a height field: must be > 0 and finite")
        count = [math.ceil(length / resolution - 1e-9) + 1 for length in size]
        x, y = (np.linspace(-0.5 * length, 0.5 * length, n) for length, n in zip(size, count, strict=True))
        heights = np.broadcast_to(np.asarray(function(x[:, None], y), np.float64), (len(x), len(y)))
        return cls(heights, (size[0] / (count[0] - 1), size[1] / (count[1] - 1)))

    def surface(self, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> HeightSurface:
        """Its signed distance on tensors."""
        first = [-0.5 * (n - 1) * step for n, step in zip(self.heights.shape, self.spacing, strict=True)]
        return HeightSurface(
            torch.tensor(first, dtype=dtype, device=device),
            torch.tensor(self.spacing, dtype=dtype, device=device),
            torch.as_tensor(coefficients_through(self.heights), dtype=dtype, device=device),
        )


@dataclass(frozen=True, eq=False)
class HeightSurface:
    """φ = (z − h)/√(1 + |∇h|²), > 0 above the terrain. origin `[2]`, spacing `[2]` and coefficients: as of `evaluate`.

    On a plane φ is the distance. On terrain of slope angle α and normal curvature κ along the steepest direction (> 0 in a valley)
    it is d + ½ κ d² tan²α + O(d³) at distance d: exact on the surface, with its normal, and to second order where it is level.
    ∇φ is continuous; ∇∇φ jumps between cells in proportion to z − h."""

    origin: Tensor
    spacing: Tensor
    coefficients: Tensor

    def field(self, points: Tensor) -> Field:
        """See `Surface`."""
        height, slope, bend = evaluate(self.coefficients, self.origin, self.spacing, points[..., :2], 2)
        above = points[..., 2] - height
        steepness = (1 + dot(slope, slope)).rsqrt()  # s = 1/√(1 + |∇h|²)
        upward = torch.cat((-slope, torch.ones_like(slope[..., :1])), -1)  # ∇(z − h)
        along = rotated(bend, slope)  # ½ ∇|∇h|²
        easing = _level(-(steepness**3).unsqueeze(-1) * along)  # ∇s
        normal = steepness.unsqueeze(-1) * upward + above.unsqueeze(-1) * easing

        def curvature() -> Tensor:
            twist = evaluate(self.coefficients, self.origin, self.spacing, points[..., :2], 3)[3]
            s = steepness[..., None, None]
            change = (twist * slope[..., None, None, :]).sum(-1) + (bend.unsqueeze(-2) * bend.unsqueeze(-3)).sum(-1)
            easing2 = 3 * s**5 * along.unsqueeze(-1) * along.unsqueeze(-2) - s**3 * change  # ∇∇s
            mixed = outer(upward, easing)
            level = above[..., None, None] * easing2 - s * bend
            return mixed + mixed.mT + _level(_level(level).mT).mT

        return Field(steepness * above, normal, curvature, exact=False)

    def take(self, worlds: Worlds) -> Self:
        """See `Surface`; all worlds share the terrain."""
        return self


def _level(vector: Tensor) -> Tensor:
    """Vectors `[*, 2]` of the plane as `[*, 3]`."""
    return torch.cat((vector, torch.zeros_like(vector[..., :1])), -1)
