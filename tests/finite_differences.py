"""The one finite-difference checker of all tests: central differences, extrapolated to zero step (Ridders' method).

A residual is a covector on the manifold of configurations, given at q in the tangent (body-axes) basis there. Its exact Jacobian is
the one in the exponential chart δ ↦ q ⊕ δ: with R(δ) = R exp([δ]), a change dδ turns the body by Jr(δ) dδ about its own
axes, so the residual pulled back to the chart is Jr(δ)ᵀ r(q ⊕ δ) for rotations, and r itself for all other coordinates.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import retract
from pbfd_torch.tree.rotations import skew
from pbfd_torch.tree.topology import Topology


def derivative(
    function: Callable[[Tensor], Tensor], size: int, batch: tuple[int, ...] = (), largest: float = 1e-2, levels: int = 9
) -> Tensor:
    """∂f/∂δ at δ = 0, in float64: `[*batch, *out, size]`.

    function: δ `[m, *batch, size]` → `[m, *batch, *out]`, every row of the leading dimension and every world for itself.
    Differences at steps h = largest · 2^−k are extrapolated (their error is a series in h²), and each world takes the entry of the
    tableau that differs least from its neighbours: large steps suffer from truncation or kinks, small ones from rounding."""
    steps = largest * 0.5 ** torch.arange(levels, dtype=torch.float64)
    signs = torch.tensor([1.0, -1.0], dtype=torch.float64)
    delta = (steps[:, None, None, None] * signs[:, None, None]) * torch.eye(size, dtype=torch.float64)  # [levels, 2, size, size]
    delta = delta.view(-1, *[1] * len(batch), size).expand(-1, *batch, size)
    flat = function(delta)
    shape = flat.shape[1:]
    values = flat.reshape(levels, 2, size, *batch, -1)
    column = [(values[k, 0] - values[k, 1]) / (2 * steps[k]) for k in range(levels)]  # each [size, *batch, out]
    best = torch.full((1, *batch, 1), math.inf, dtype=torch.float64)
    answer = torch.full_like(column[0], math.nan)
    for order in range(1, 4):
        share = 4.0**order
        extrapolated = [(share * b - a) / (share - 1) for a, b in itertools.pairwise(column)]
        for a, b, value in zip(column[:-1], column[1:], extrapolated, strict=True):
            error = torch.maximum((value - a).abs(), (value - b).abs()).amax((0, -1), keepdim=True)
            answer = torch.where(error < best, value, answer)
            best = torch.where(error < best, error, best)
        column = extrapolated
    return answer.movedim(0, -1).reshape(*shape, size)


def right_jacobian(phi: Tensor) -> Tensor:
    """Jr of SO(3) `[*, 3] → [*, 3, 3]`, exp([φ + dφ]) = exp([φ]) exp([Jr(φ) dφ]): by its power series Σ (−[φ])^k/(k + 1)!."""
    k = -skew(phi)
    term = torch.eye(3, dtype=phi.dtype).expand_as(k)
    total = term
    for i in range(1, 40):
        term = term @ k / (i + 1)
        total = total + term
    return total


def pulled_back(topology: Topology, delta: Tensor, residual: Tensor) -> Tensor:
    """The residual at q ⊕ δ as a covector in the exponential chart at q, `[*, nv]`."""
    rows = topology.turning_v
    if len(rows) == 0:
        return residual
    turned = (right_jacobian(delta[..., rows]).mT @ residual[..., rows].unsqueeze(-1)).squeeze(-1)
    result = residual.clone()
    result[..., rows] = turned
    return result


def jacobian(articulation: Articulation, residual: Callable[[Tensor], Tensor], q: Tensor, largest: float = 1e-2) -> Tensor:
    """∂r/∂θ `[*batch, nv, nv]` in the exponential chart at q `[*batch, nq]`. residual: `[m, *batch, nq]` → `[m, *batch, nv]`."""

    def chart(delta: Tensor) -> Tensor:
        return pulled_back(articulation.topology, delta, residual(retract(articulation, q, delta)))

    return derivative(chart, articulation.nv, tuple(q.shape[:-1]), largest)


def relative_error(value: Tensor, reference: Tensor, floor: Tensor | float = 0.0) -> float:
    """Largest |value − reference| over the largest |reference| of each matrix, worst world. `floor` `[*batch]`: matrices count as
    at least that large, for references that are zero."""
    size = reference.abs().amax((-2, -1)).clamp_min(floor)
    error = (value - reference).abs().amax((-2, -1))
    return float((error / torch.where(size > 0, size, torch.ones_like(size))).max())
