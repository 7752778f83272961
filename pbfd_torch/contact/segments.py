"""Segments: which of their points is nearest, and how the distance from them bends."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.tensors.vectors import axis, dot, outer, unit


def share_of(along: Tensor, square: Tensor) -> Tensor:
    """Which part of a segment, in [0, 1], lies before a point, `[*]`: from what the point is ahead of its start times the segment's
    length, and the square of that; `along` itself, which is zero then, where the segment has no length."""
    return (along / torch.where(square > 0, square, 1.0)).clamp(0, 1)


def from_segment(points: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets `[*, 3]` of points from the nearest point of a segment, the segment's direction `[*, 3]` (z where it has no
    length), and `[*]` which points lie beside the segment, not beyond its ends."""
    along = end - start
    direction, _ = unit(along, axis(2, along))
    length = dot(along, direction)
    ahead = dot(points - start, direction)
    nearest = start + torch.minimum(ahead.clamp_min(0), length)[..., None] * direction
    return points - nearest, direction, (ahead > 0) & (ahead < length)


def around_segment(normal: Tensor, direction: Tensor, beside: Tensor, inverse: Tensor) -> Tensor:
    """Hessian `[*, 3, 3]` of the distance from a segment: that of a line for points beside it, that of a point beyond its ends.
    inverse: of the distance `[*]` [1/m]."""
    eye = torch.eye(3, dtype=normal.dtype, device=normal.device)
    return inverse[..., None, None] * (eye - outer(normal, normal) - beside[..., None, None] * outer(direction, direction))
