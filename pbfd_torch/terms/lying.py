"""Which candidates of a rim count: it itself where it stands on edge, points around it where it lies flat.

A rim that stands on edge is held at its lowest point (`supported`); one that lies flat has none. Which of both counts is settled at
the start of a step, by the angle α between the rim's axis and the normal: from the points to the rim as sin α grows from `FLAT` to
`STEEP`, smoothly.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.tensors.vectors import dot

FLAT, STEEP = 0.02, 0.1


def share_of(lying: Tensor, axis: Tensor, normal: Tensor) -> Tensor:
    """Of its normal force that each candidate gives, from 0 to 1, `[*, n]`. lying: 1 for what counts where a rim lies flat, −1 for
    what counts where it does not, 0 for what always does, `[*, n]`; axis, normal: unit, `[*, n, 3]`."""
    square = 1 - dot(axis, normal).square()  # sin² α: its root has no derivative where a rim lies flat
    x = ((square - FLAT**2) / (STEEP**2 - FLAT**2)).clamp(0, 1)
    steep = x * x * x * (10 - x * (15 - 6 * x))  # twice continuously differentiable
    return torch.where(lying == 0, 1.0, torch.where(lying > 0, 1 - steep, steep))
