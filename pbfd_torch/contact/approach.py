"""The closest approach of two round bodies: the direction in which they are the farthest apart.

Each is an ellipsoid with a centre c and a form M (`terms.supported`), and may be swept along a line with direction l, as the side
of a cylinder is; a point has M = 0. Their signed distance is the largest over all unit n of

    gap(n) = n·(c₁ − c₂) − h₁ − h₂,   h = √(nᵀM n),   n·l₁ = n·l₂ = 0,

n from the second to the first. Where it is largest, ∇gap = c₁ − c₂ − M₁n/h₁ − M₂n/h₂ = gap n + μ₁ l₁ + μ₂ l₂: the nearest points
are c₁ − M₁n/h₁ − μ₁ l₁ and c₂ + M₂n/h₂ + μ₂ l₂. Newton's method on the sphere finds n; its matrix K, on the plane across n, is the
sum of the radii of curvature and the gap. By the same matrix n and μ answer a motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pbfd_torch.tensors.vectors import dot, outer, rotated

_POINT = 1e-12  # [m] a smaller reach is that of a point
_PARTS = (1.0, 0.5, 0.2, 0.05)  # of a step that are tried
_BENT = 0.9  # of the least radius of curvature: deeper overlaps count as so deep, or Newton's steps would go downhill


@dataclass(frozen=True, eq=False)
class Swept:
    """Two bodies. `centers`: c `[*, 2, 3]` [m]; `forms`: M `[*, 2, 3, 3]` [m²]; `lines`: l `[*, 2, 3]` of unit length, or zero."""

    centers: Tensor
    forms: Tensor
    lines: Tensor

    def moved(self, frames: Tensor) -> Swept:
        """The same in the world, where they were given in frames `[*, 2, 3, 4]`."""
        turn = frames[..., :3]
        return Swept(rotated(turn, self.centers) + frames[..., 3], turn @ self.forms @ turn.mT, rotated(turn, self.lines))


@dataclass(frozen=True, eq=False)
class Approach:
    """Two bodies seen along one direction. `normal`: n `[*, 3]`, unit."""

    of: Swept
    normal: Tensor

    @cached_property
    def between(self) -> Tensor:
        """c₁ − c₂ `[*, 3]` [m]."""
        return self.of.centers[..., 0, :] - self.of.centers[..., 1, :]

    @cached_property
    def spreads(self) -> Tensor:
        """M n `[*, 2, 3]`."""
        return rotated(self.of.forms, self.normal[..., None, :])

    @cached_property
    def reaches(self) -> Tensor:
        """h `[*, 2]` [m]."""
        return dot(self.spreads, self.normal[..., None, :]).clamp_min(_POINT**2).sqrt()

    @cached_property
    def gap(self) -> Tensor:
        """`[*]` [m], < 0 where they overlap."""
        return dot(self.between, self.normal) - self.reaches.sum(-1)

    @cached_property
    def _across(self) -> Tensor:
        """Two unit vectors across n, `[*, 2, 3]`."""
        flattest = self.normal.abs().argmin(-1, keepdim=True)
        other = torch.zeros_like(self.normal).scatter(-1, flattest, 1.0)
        first = torch.linalg.cross(self.normal, other)
        first = first / torch.linalg.vector_norm(first, dim=-1, keepdim=True)
        return torch.stack((first, torch.linalg.cross(self.normal, first)), -2)

    @cached_property
    def _size(self) -> Tensor:
        """`[*]` [m] by which a line holds n: K has full rank where lines alone determine it."""
        return self.reaches.sum(-1) + torch.linalg.vector_norm(self.between.detach(), dim=-1)

    @cached_property
    def _lines(self) -> Tensor:
        """The lines across n, as columns `[*, 2, 2]`."""
        return _times(self._across, self.of.lines.mT)

    @cached_property
    def _inverse(self) -> Tensor:
        """K⁻¹ `[*, 2, 2]` [1/m]."""
        across, forms = self._across, self.of.forms
        seen = _times(_times(across[..., None, :, :], forms), across.mT[..., None, :, :])
        slope = rotated(across[..., None, :, :], self.spreads) / self.reaches[..., None]
        bent = ((seen - outer(slope, slope)) / self.reaches[..., None, None]).sum(-3)
        bent = bent + self._size[..., None, None] * _times(self._lines, self._lines.mT)
        a, b, c = bent[..., 0, 0], bent[..., 0, 1], bent[..., 1, 1]
        least = 0.5 * (a + c) - (0.25 * (a - c).square() + b.square() + _POINT**2).sqrt()
        gap = torch.maximum(self.gap, -_BENT * least)
        return _inverse(bent + torch.diag_embed(gap[..., None].expand(*gap.shape, 2)))

    def answer(self, pull: Tensor, leans: Tensor) -> tuple[Tensor, Tensor]:
        """Where n and μ go, `[*, 3, k]`, `[*, 2, k]`, as ∇gap grows by `pull` `[*, 3, k]` and n·l by `leans` `[*, 2, k]` while n
        stays."""
        pull = _times(self._across, pull)
        held = _times(self._inverse, self._lines)
        free = (self.of.lines == 0).all(-1)  # what has no line has no μ
        tight = _times(self._lines.mT, held) + torch.diag_embed(free.to(pull.dtype))
        slides = _times(_inverse(tight), _times(held.mT, pull) + leans)
        turn = _times(self._inverse, pull) - _times(held, slides)
        return _times(self._across.mT, turn), slides - self._size[..., None, None] * leans

    @cached_property
    def _step(self) -> tuple[Tensor, Tensor]:
        """Newton's step of n `[*, 3]`, not longer than one, and μ `[*, 2]` [m]."""
        grow = self.between - (self.spreads / self.reaches[..., None]).sum(-2)
        leans = dot(self.of.lines, self.normal[..., None, :])
        turn, slides = (x.squeeze(-1) for x in self.answer(grow[..., None], leans[..., None]))
        return turn / dot(turn, turn).clamp_min(1.0).sqrt()[..., None], slides

    def nearer(self) -> tuple[Approach, Tensor]:
        """After one step of Newton's method, with μ `[*, 2]` [m]."""
        turn, slides = self._step
        return Approach(self.of, _unit(self.normal + turn)), slides

    def _higher(self) -> Approach:
        """After that part of one step after which the gap is the largest: where a rim is seen along its axis, whole ones miss."""
        parts = torch.stack([self.normal + part * self._step[0] for part in _PARTS], -2)
        normals = _unit(parts)
        of = Swept(self.of.centers[..., None, :, :], self.of.forms[..., None, :, :, :], self.of.lines[..., None, :, :])
        leans = dot(of.lines, normals[..., None, :]).abs().sum(-1)  # more than μ is worth
        best = (Approach(of, normals).gap - 2 * self._size[..., None] * leans).argmax(-1)[..., None, None]
        return Approach(self.of, normals.take_along_dim(best, -2).squeeze(-2))

    def closest(self, steps: int) -> tuple[Approach, Tensor]:
        """After so many steps, with μ `[*, 2]` [m]. The last one alone carries derivatives: those of the solution."""
        with torch.no_grad():
            found = self
            for _ in range(steps - 1):
                found = found._higher()
        return Approach(self.of, found.normal.detach()).nearer()


def _unit(vectors: Tensor) -> Tensor:
    return vectors / torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)


def _inverse(matrix: Tensor) -> Tensor:
    """Of symmetric positive definite matrices `[*, 2, 2]`; finite for those that are none."""
    a, b, c = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    size, det = a * c, a * c - b * b
    least = torch.finfo(det.dtype)
    det = torch.where(det > least.eps * size.abs(), det, size.abs().clamp_min(least.tiny))
    return torch.stack((c, -b, -b, a), -1).unflatten(-1, (2, 2)) / det[..., None, None]


def _times(a: Tensor, b: Tensor) -> Tensor:
    """A B, `[*, n, m], [*, m, k]`; row by row the same in any batch."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)
