"""Products of small vectors and matrices, one or many at a time.

M v has two forms, which round differently: `rotated`, where a row must not depend on the batch it is in, and `applied`.
"""

from __future__ import annotations

import torch
from torch import Tensor

_NEGLIGIBLE = 1e-15  # shorter vectors have no direction; its square and that of its inverse fit into float32


def dot(a: Tensor, b: Tensor) -> Tensor:
    """a · b, `[*, k], [*, k] → [*]`."""
    return (a * b).sum(-1)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """a × b, `[*, 3], [*, 3] → [*, 3]`; one of them may have fewer dimensions."""
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))


def outer(a: Tensor, b: Tensor) -> Tensor:
    """a bᵀ, `[*, n], [*, m] → [*, n, m]`."""
    return a[..., :, None] * b[..., None, :]


def rows(vector: Tensor, matrix: Tensor) -> Tensor:
    """vᵀM, `[*, n], [*, n, m] → [*, m]`; not by a matrix product, which rounds differently for one world and for many."""
    return (vector[..., None] * matrix).sum(-2)


def trace_minus(matrix: Tensor) -> Tensor:
    """tr(M) 1 − M, `[*, 3, 3] → [*, 3, 3]`: the inertia of a second moment."""
    trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    return trace * torch.eye(3, dtype=matrix.dtype, device=matrix.device) - matrix


def applied(matrix: Tensor, vector: Tensor) -> Tensor:
    """M v as a matrix product, `[*, n, m], [*, m] → [*, n]`."""
    return (matrix @ vector[..., None]).squeeze(-1)


def rotated(matrix: Tensor, vector: Tensor) -> Tensor:
    """M v, `[*, n, m], [*, m] → [*, n]`; row by row the same in any batch."""
    return dot(matrix, vector[..., None, :])


def mapped(frames: Tensor, points: Tensor) -> Tensor:
    """M p̄ = R p + t, `[*, n or 1, 3, 4], [*, n, 3] → [*, n, 3]`."""
    return rotated(frames[..., :3], points) + frames[..., 3]


def in_frames(frames: Tensor, points: Tensor) -> Tensor:
    """Points as they are seen in frames, Rᵀ(p − t), `[*, n or 1, 3, 4], [*, n, 3] → [*, n, 3]`."""
    return applied(frames[..., :3].mT, points - frames[..., 3])


def extended(points: Tensor) -> Tensor:
    """p̄ = (p, 1), `[*, n, 3] → [*, n, 4]`."""
    return torch.cat((points, torch.ones_like(points[..., :1])), -1)


def unit(vector: Tensor, fallback: Tensor) -> tuple[Tensor, Tensor]:
    """Direction `[*, k]` of a vector and the inverse `[*]` of its length. A negligible vector takes the direction of the
    fallback, and zero for the inverse. With this direction (vector · direction) is the length, differentiable at zero too."""
    negligible = dot(vector, vector)[..., None] <= _NEGLIGIBLE**2
    safe = torch.where(negligible, fallback, vector)
    length = torch.linalg.vector_norm(safe, dim=-1, keepdim=True)
    return safe / length, torch.where(negligible, 0.0, 1 / length).squeeze(-1)


def axis(index: int, like: Tensor) -> Tensor:
    """The unit vector `[k]` along an axis, of the length and type of vectors `[*, k]`; made where they are, without a copy from the
    host."""
    return (torch.arange(like.shape[-1], device=like.device) == index).to(like.dtype)
