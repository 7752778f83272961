"""Placements as URDF writes them: xyz [m] and roll, pitch, yaw [rad]."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pbfd_torch.tree.rotations import quaternion_matrix, quaternion_multiply

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def rotation_matrix(quaternion: Quaternion) -> NDArray[np.float64]:
    matrix: NDArray[np.float64] = quaternion_matrix(torch.tensor(quaternion, dtype=torch.float64)).numpy()
    return matrix


@dataclass(frozen=True)
class Placed:
    """A frame in another: position [m] and unit quaternion (w, x, y, z)."""

    position: Vector
    quaternion: Quaternion

    @staticmethod
    def identity() -> Placed:
        return Placed((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))

    @staticmethod
    def from_origin(origin: Any) -> Placed:
        """From a parsed <origin>, which may be missing: turns about the fixed x, then y, then z axis."""
        if origin is None:
            return Placed.identity()
        (sx, cx), (sy, cy), (sz, cz) = ((math.sin(a / 2), math.cos(a / 2)) for a in origin.rpy)
        quaternion = (
            cx * cy * cz + sx * sy * sz,
            sx * cy * cz - cx * sy * sz,
            cx * sy * cz + sx * cy * sz,
            cx * cy * sz - sx * sy * cz,
        )
        x, y, z = origin.xyz
        return Placed((x, y, z), quaternion)

    def __matmul__(self, inner: Placed) -> Placed:
        """The placement `inner`, given in this frame, as seen from outside."""
        x, y, z = np.array(self.position) + rotation_matrix(self.quaternion) @ np.array(inner.position)
        both = torch.tensor((self.quaternion, inner.quaternion), dtype=torch.float64)
        a, b, c, d = quaternion_multiply(both[0], both[1]).tolist()
        return Placed((float(x), float(y), float(z)), (a, b, c, d))


def plane_axes(normal: Vector) -> tuple[Vector, Vector]:
    """Two unit axes of the plane, right-handed with its normal: x, y for z; y, z for x; z, x for y. Zero for a zero normal."""
    n = np.array(normal) / (np.linalg.norm(normal) or 1.0)
    start = np.roll(np.eye(3)[int(np.abs(n).argmax())], 1)
    first = start - (start @ n) * n
    first /= np.linalg.norm(first) or 1.0
    a, b = first.tolist(), np.cross(n, first).tolist()
    return (a[0], a[1], a[2]), (b[0], b[1], b[2])
