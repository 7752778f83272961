"""Uniform cubic B-splines of any dimension through regular samples: C², with all partial derivatives.

Along each axis the spline in the cell from node i to node i + 1 is Σⱼ wⱼ(t) cᵢ₊ⱼ₋₁, j = 0…3, with t in [0, 1) the place in the cell
and w the basis of de Boor (A Practical Guide to Splines, 1978); several axes multiply.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def coefficients_through(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients `[n₁ + 2, n₂ + 2, …]` of the spline that takes the values `[n₁, n₂, …]`, nᵢ ≥ 2, at the nodes: one for each node
    and one beyond each border. The spline is natural (no second derivative across a border): samples of a linear function give it
    exactly; others, to fourth order in the spacing inside and to second order within a few cells of the border."""
    from scipy.linalg import solve_banded  # takes .2 s, and few scenes need it

    for axis in range(values.ndim):
        y = np.moveaxis(values, axis, 0)
        c = np.empty((len(y) + 2, *y.shape[1:]))
        c[1], c[-2] = y[0], y[-1]
        if len(y) > 2:
            inner = 6.0 * y[1:-1]
            inner[0] -= y[0]
            inner[-1] -= y[-1]
            bands = np.repeat([[1.0], [4.0], [1.0]], len(inner), 1)
            c[2:-2] = solve_banded((1, 1), bands, inner.reshape(len(inner), -1)).reshape(inner.shape)
        c[0], c[-1] = 2 * c[1] - c[2], 2 * c[-2] - c[-3]
        values = np.moveaxis(c, 0, axis)
    return np.ascontiguousarray(values)


def evaluate(coefficients: Tensor, origin: Tensor, spacing: Tensor, points: Tensor, order: int) -> list[Tensor]:
    """The spline's value `[*batch]`, gradient `[*batch, d]`, Hessian `[*batch, d, d]`, … up to the derivatives of `order` ≤ 3 at
    points `[*batch, d]`; third derivatives are constant in a cell and jump between cells.

    coefficients: as of `coefficients_through`. origin: `[d]`, the first node. spacing: `[d]` or `[]`, of the nodes. Beyond the
    border the outermost coefficients repeat: the spline runs out C², from two cells on no more changing away from the border."""
    dimension, batch = coefficients.ndim, points.ndim - 1
    place = (points - origin) / spacing
    cell = place.detach().floor()
    weights = _weights(place - cell, spacing.unsqueeze(-1), order)
    nearby = torch.arange(4, device=points.device)
    index = torch.zeros((), dtype=torch.long, device=points.device)
    for axis, size in enumerate(coefficients.shape):
        nodes = (cell[..., axis, None].clamp(-3, size).long() + nearby).clamp(0, size - 1)
        index = index * size + nodes.view(*nodes.shape[:-1], *(4 if other == axis else 1 for other in range(dimension)))
    partials = coefficients.reshape(-1)[index]
    for axis in range(dimension):  # contracts the first axis of coefficients and appends one of derivative orders
        row = weights[..., axis, :, :].view(*points.shape[:-1], *[1] * (dimension - 1), order + 1, 4)
        partials = (partials.movedim(batch, -1).unsqueeze(-2) * row).sum(-1)
    return [_derivative(partials, dimension, rank) for rank in range(order + 1)]


def _weights(t: Tensor, spacing: Tensor, order: int) -> Tensor:
    """The basis and its derivatives by position `[*, order + 1, 4]` at places t `[*]`."""
    s, one = 1 - t, torch.ones_like(t)
    rows = (
        (s * s * s / 6, (4 - 3 * t * t * (2 - t)) / 6, (4 - 3 * s * s * (2 - s)) / 6, t * t * t / 6),
        (-0.5 * s * s, t * (1.5 * t - 2), -s * (1.5 * s - 2), 0.5 * t * t),
        (s, 3 * t - 2, 3 * s - 2, t),
        (-one, 3 * one, -3 * one, one),
    )
    return torch.stack([torch.stack(row, -1) / spacing**k for k, row in enumerate(rows[: order + 1])], -2)


def _derivative(partials: Tensor, dimension: int, rank: int) -> Tensor:
    """The symmetric tensor `[*, d, …, d]` of derivatives of order `rank` from the partial derivatives `[*, order + 1, …]`."""
    flat, strides = partials.flatten(-dimension), [partials.shape[-1] ** k for k in reversed(range(dimension))]
    entries = [flat[..., sum(strides[axis] for axis in each)] for each in itertools.product(range(dimension), repeat=rank)]
    return torch.stack(entries, -1).unflatten(-1, (dimension,) * rank) if rank else entries[0]
