"""How well a least-squares fit knows its answer: the covariance σ² (JᵀJ)⁻¹, and what the data do not determine at all.

By the singular value decomposition J D = U Σ Vᵀ in units of the scale D: along the direction D V_j the answer is known to σ/Σ_j,
and not at all where Σ_j is rounding. Directions that are known no better than to the scale itself are loose: the data say nothing
about them that was not known before.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

REACHED = 1e-6  # the share of a direction that nothing determines from which on a quantity depends on it


@dataclass(frozen=True, eq=False)
class Certainty:
    """Of one fit and k quantities that follow from its x.

    Attributes:
        covariance: `[k, k]` of what is determined; rows of quantities that depend on what the data do not see at all are infinite.
        deviation: `[k]` standard deviations.
        determined: `[k]` bool: the data know the quantity better than to the scale.
        loose: `[l, n]` unit vectors in units of the scale: combinations of x that the data do not determine.
    """

    covariance: Tensor
    deviation: Tensor
    determined: Tensor
    loose: Tensor

    @property
    def correlation(self) -> Tensor:
        """`[k, k]`, NaN where a deviation is infinite or zero."""
        return self.covariance / (self.deviation[:, None] * self.deviation[None, :])


def certainty(
    jacobian: Tensor,
    variance: Tensor,
    scale: Tensor,
    slopes: Tensor | None = None,
    held: Tensor | None = None,
    stated: float = 0.0,
) -> Certainty:
    """Of quantities with derivatives `slopes` `[k, n]` by x (None: x itself), from the Jacobian `[m, n]` of residuals with this
    variance. scale: `[n]`, how well x was known before. held: `[n]` bool, components of x that count as known, as bounds hold them.
    stated: the variance that the residuals should have; where the fit is better than that, it judges what is determined.

    Scale and stated variance judge only: the covariance does not depend on them."""
    n = len(scale)
    slopes = torch.eye(n, dtype=scale.dtype, device=scale.device) if slopes is None else slopes
    free = torch.ones(n, dtype=torch.bool, device=scale.device) if held is None else ~held
    _, sizes, turned = torch.linalg.svd((scale * jacobian)[:, free], full_matrices=False)
    count = int(free.sum())
    if len(sizes) < count:  # fewer data than unknowns
        _, _, turned = torch.linalg.svd((scale * jacobian)[:, free], full_matrices=True)
        sizes = torch.cat((sizes, sizes.new_zeros(count - len(sizes))))
    rounding = torch.finfo(sizes.dtype).eps * max(jacobian.shape) * (sizes[:1] if count else 1.0)
    seen = sizes > rounding
    along = (scale * slopes)[:, free] @ turned.mT  # [k, count]: how the quantities change along every direction
    before = torch.linalg.vector_norm((scale * slopes)[:, free], dim=-1)
    spread = along[:, seen] / sizes[seen]
    covariance = variance * spread @ spread.mT
    blind = (along[:, ~seen].abs() > REACHED * before[:, None]).any(-1)
    covariance = torch.where(blind[:, None] | blind[None, :], torch.inf, covariance)
    deviation = covariance.diagonal().sqrt()
    judge = variance.clamp_min(stated).sqrt()
    judged = judge * torch.linalg.vector_norm(spread, dim=-1)
    return Certainty(
        covariance=covariance,
        deviation=deviation,
        determined=~blind & (judged <= before),
        loose=_spread(turned[(sizes <= judge) | ~seen], free),
    )


def _spread(directions: Tensor, free: Tensor) -> Tensor:
    """Directions of the free components as those of all `[l, n]`."""
    whole = directions.new_zeros((len(directions), len(free)))
    whole[:, free] = directions
    return whole
