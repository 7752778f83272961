"""Small quadratic programmes within bounds, many at once: projected Newton after Bertsekas (1982), as in box-DDP.

Components at a bound that the gradient pushes against are clamped; the others make a Newton step, projected onto the bounds.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

ITERATIONS = 30  # of projected Newton; each settles at least one component, so a programme of a few needs as few
LENGTHS = 12  # of the search, each half of the one before
ENOUGH = 0.1  # of the decrease that the gradient foresees


@dataclass(frozen=True, eq=False)
class BoxMinimum:
    """Attributes:
    x: `[*batch, n]` within the bounds, to the bit.
    free: `[*batch, n]` bool, components that no bound holds.
    factor: `[*batch, n, n]` Cholesky factor of the free components' Hessian, with ones on the diagonal of the others.
    """

    x: Tensor
    free: Tensor
    factor: Tensor

    def solve(self, right: Tensor) -> Tensor:
        """H⁻¹ of columns `[*batch, n, m]` among the free components; rows of clamped ones are zero."""
        mask = self.free[..., None].to(right.dtype)
        return mask * torch.cholesky_solve(mask * right, self.factor)


def box_minimum(hessian: Tensor, gradient: Tensor, lower: Tensor, upper: Tensor) -> BoxMinimum:
    """Minimum of ½ xᵀHx + gᵀx over lower ≤ x ≤ upper, for H `[*batch, n, n]` positive definite, g `[*batch, n]` and bounds that
    broadcast to it, infinite where there is none."""
    x = torch.zeros_like(gradient).clamp(lower, upper)
    lengths = 0.5 ** torch.arange(LENGTHS, dtype=x.dtype, device=x.device).reshape(-1, *(1,) * x.ndim)
    tolerance = torch.finfo(x.dtype).eps ** 0.75 * (1 + gradient.abs().amax(-1, keepdim=True))
    found = _faced(hessian, gradient, x, lower, upper)
    for _ in range(ITERATIONS):
        slope = _product(hessian, x) + gradient
        if not bool((found.free & (slope.abs() > tolerance)).any()):
            break
        move = -found.solve(slope[..., None]).squeeze(-1)
        tried = (x + lengths * move).clamp(lower, upper)
        # of what x does, so that rounding of the whole value does not hide the end of the way
        step = tried - x
        gained = -(step * (slope + 0.5 * _product(hessian, step))).sum(-1)
        good = gained >= ENOUGH * -(step * slope).sum(-1)
        first = good.to(torch.uint8).argmax(0)  # the longest step that is good
        chosen = tried.gather(0, first[None, ..., None].expand(1, *x.shape)).squeeze(0)
        x = torch.where(good.any(0)[..., None], chosen, x)
        found = _faced(hessian, gradient, x, lower, upper)
    return found


def _product(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None]).squeeze(-1)


def _faced(hessian: Tensor, gradient: Tensor, x: Tensor, lower: Tensor, upper: Tensor) -> BoxMinimum:
    """x with what its bounds hold."""
    slope = _product(hessian, x) + gradient
    free = ~(((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0)))
    mask = free.to(x.dtype)
    inner = mask[..., :, None] * hessian * mask[..., None, :] + torch.diag_embed(1 - mask)
    factor, _ = torch.linalg.cholesky_ex(inner)
    return BoxMinimum(x, free, factor)
