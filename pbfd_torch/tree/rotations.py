"""Rotations: exponential and logarithm, quaternions (w, x, y, z), safe (value and derivative) at zero rotation.

Every function takes any leading batch shape, float32 or float64, on any device.
"""

from __future__ import annotations

import torch
from torch import Tensor

_SMALL = 1e-2  # below this angle [rad] the series are used; their first omitted term is below float64's rounding


def _guarded(square: Tensor) -> tuple[Tensor, Tensor]:
    """Mask of small squares, and the squares with the small ones replaced by 1 (so that no branch divides by zero)."""
    small = square < _SMALL * _SMALL
    return small, torch.where(small, 1.0, square)


def skew(v: Tensor) -> Tensor:
    """Cross-product matrix [v]×, `[*, 3] → [*, 3, 3]`: skew(v) @ w = v × w."""
    (x, y, z), (minus_x, minus_y, minus_z) = v.unbind(-1), (-v).unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, minus_z, y, z, zero, minus_x, minus_y, x, zero), -1).unflatten(-1, (3, 3))


def unskew(m: Tensor) -> Tensor:
    """Twice the axial vector of a matrix's antisymmetric part, `[*, 3, 3] → [*, 3]`: unskew(skew(v)) = 2 v."""
    twice = m - m.mT
    return torch.stack((twice[..., 2, 1], twice[..., 0, 2], twice[..., 1, 0]), -1)


def sinc(square: Tensor) -> Tensor:
    """sin(a)/a as a function of a²: smooth at zero."""
    small, safe = _guarded(square)
    angle = safe.sqrt()
    series = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72)))
    return torch.where(small, series, torch.sin(angle) / angle)


def quaternion_exp(v: Tensor) -> Tensor:
    """Unit quaternion of the rotation vector v [rad], `[*, 3] → [*, 4]`."""
    half = 0.5 * v
    square = (half * half).sum(-1, keepdim=True)
    small, safe = _guarded(square)
    cosine = torch.where(small, 1 - square / 2 * (1 - square / 12 * (1 - square / 30 * (1 - square / 56))), torch.cos(safe.sqrt()))
    return torch.cat((cosine, sinc(square) * half), -1)


def quaternion_log(q: Tensor) -> Tensor:
    """Rotation vector of a unit quaternion, angle in [0, π], `[*, 4] → [*, 3]`: q and −q give the same."""
    q = torch.where(q[..., :1] < 0, -q, q)
    w, xyz = q[..., :1], q[..., 1:]
    square = (xyz * xyz).sum(-1, keepdim=True)
    small, safe = _guarded(square)
    sine = safe.sqrt()
    # 2 asin(s)/s for s = |xyz|, by series where small
    series = 2 * (1 + square / 6 * (1 + square * 9 / 20 * (1 + square * 25 / 42 * (1 + square * 49 / 72))))
    return torch.where(small, series, 2 * torch.atan2(sine, w) / sine) * xyz


def quaternion_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a ⊗ b, `[*, 4]`."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        -1,
    )


def quaternion_conjugate(q: Tensor) -> Tensor:
    """Conjugate of a quaternion: the inverse rotation where q has unit norm."""
    return torch.cat((q[..., :1], -q[..., 1:]), -1)


def quaternion_normalize(q: Tensor) -> Tensor:
    """The quaternion scaled to unit norm."""
    return q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)


def quaternion_matrix(q: Tensor) -> Tensor:
    """Rotation matrix of any non-zero quaternion, `[*, 4] → [*, 3, 3]`; its norm does not matter."""
    w, x, y, z = (q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)).unbind(-1)
    return torch.stack(
        (
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ),
        -1,
    ).unflatten(-1, (3, 3))


def rotation_log(r: Tensor) -> Tensor:
    """Rotation vector of a rotation matrix, `[*, 3, 3] → [*, 3]`, angle in [0, π).

    Meant for the rotation over one time step: within about 1e-6 rad of a half turn the axis is not resolved and
    the result's length is no longer meaningful (it stays finite).
    """
    double_sine = unskew(r)  # 2 sin(angle) · axis
    square = 0.25 * (double_sine * double_sine).sum(-1, keepdim=True)
    cosine = 0.5 * (r.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1)
    small = (square < _SMALL * _SMALL) & (cosine > 0)
    sine = torch.where(small, 1.0, square.clamp_min(1e-12)).sqrt()  # no branch divides by zero, at a half turn neither
    series = 1 + square / 6 * (1 + square * 9 / 20 * (1 + square * 25 / 42 * (1 + square * 49 / 72)))
    return 0.5 * torch.where(small, series, torch.atan2(sine, cosine) / sine) * double_sine


def _curvature(square: Tensor) -> Tensor:
    """c(a) = 1/a² − (1 + cos a)/(2 a sin a) as a function of a²: the coefficient of [φ]² in the inverse Jacobians."""
    small, safe = _guarded(square)
    angle = safe.sqrt()
    half = 0.5 * angle
    closed = (1 - half * torch.cos(half) / torch.sin(half)) / safe
    series = (1 + square / 60 * (1 + square / 42 * (1 + square / 40))) / 12
    return torch.where(small, series, closed)


def log_jacobian_left(phi: Tensor) -> Tensor:
    """Inverse left Jacobian of SO(3), `[*, 3] → [*, 3, 3]`: d log(R)/dω for R ← exp([ω]) R at φ = log R."""
    k = skew(phi)
    square = (phi * phi).sum(-1, keepdim=True).unsqueeze(-1)
    eye = torch.eye(3, dtype=phi.dtype, device=phi.device)
    return eye - 0.5 * k + _curvature(square) * (k @ k)


def log_jacobian_symmetric(phi: Tensor) -> Tensor:
    """Symmetric part of the inverse Jacobian, I + c [φ]²: the Hessian of ½‖log R‖² in the exponential chart at R."""
    k = skew(phi)
    square = (phi * phi).sum(-1, keepdim=True).unsqueeze(-1)
    eye = torch.eye(3, dtype=phi.dtype, device=phi.device)
    return eye + _curvature(square) * (k @ k)
