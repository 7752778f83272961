"""Which pairs of colliders may come near each other: boxes around them, in the axes of the world."""

from __future__ import annotations

from torch import Tensor


def overlapping(lower: Tensor, upper: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Which pairs of boxes overlap or touch, `[*batch, npair]` bool; nothing does that is not finite. lower, upper: the boxes'
    corners `[*batch, ncollider, 3]` [m]; first, second: `[npair]` the boxes of each pair."""
    return ((lower[..., first, :] <= upper[..., second, :]) & (lower[..., second, :] <= upper[..., first, :])).all(-1)
