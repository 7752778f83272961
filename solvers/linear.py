"""Linear systems of many worlds, solved without waiting for the device.

In the host's memory LAPACK factors LU. On CUDA cuBLAS does, up to 16 unknowns, for all worlds at once; of more unknowns PyTorch
(2.13) leaves more than 16 matrices to MAGMA, which waits for its queue and cannot be recorded as a graph. QR by Householder's
reflections goes to cuBLAS whatever the size, up to 256 rows: it costs twice the operations of an LU, needs no pivots, and is
backward stable; Cholesky's factorisation goes to cuSOLVER. An LU of our own would launch some 8 kernels for every column.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

LARGEST_LU = 16  # unknowns, on a device


def solved(matrix: Tensor, columns: Tensor) -> Tensor:
    """A⁻¹B `[*batch, n, k]` of matrices A `[*batch, n, n]` and columns B `[*batch, n, k]`. Never raises: where A is singular or
    not finite the result means nothing. Without derivatives."""
    return torch.linalg.solve_ex(matrix, columns)[0] if _by_lu(matrix) else Reflected.of(matrix, columns).solution


def solved_with_sign(matrix: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
    """The same, and the sign of det A `[*batch]`: 1 or −1, 0 where A is not finite, or so singular that a pivot is 0."""
    if not _by_lu(matrix):
        reflected = Reflected.of(matrix, columns)
        return reflected.solution, reflected.sign
    factor, pivots, _ = torch.linalg.lu_factor_ex(matrix)
    swapped = pivots != torch.arange(1, pivots.shape[-1] + 1, dtype=pivots.dtype, device=pivots.device)
    sign = factor.diagonal(dim1=-2, dim2=-1).sign().prod(-1) * (1 - 2 * (swapped.sum(-1) % 2))
    return torch.linalg.lu_solve(factor, pivots, columns), sign


def solved_positive(matrix: Tensor, columns: Tensor) -> Tensor:
    """The same as `solved` for matrices that are symmetric and positive definite, with derivatives on every device."""
    if _by_lu(matrix):
        return torch.linalg.solve_ex(matrix, columns)[0]
    lower, _ = torch.linalg.cholesky_ex(matrix)
    half = torch.linalg.solve_triangular(lower, columns, upper=False)
    return torch.linalg.solve_triangular(lower.mT, half, upper=True)


def least_squares(matrix: Tensor, columns: Tensor) -> Tensor:
    """argmin ‖A X − B‖ `[*batch, n, k]` of matrices A `[*batch, m, n]`, m ≥ n, and columns B `[*batch, m, k]`. By QR everywhere:
    AᵀA would have the square of A's condition number, and is never formed."""
    return Reflected.of(matrix, columns).solution


def _by_lu(matrix: Tensor) -> bool:
    return matrix.device.type == "cpu" or matrix.shape[-1] <= LARGEST_LU


@dataclass(frozen=True, eq=False)
class Reflected:
    """[A | B] turned into [R | QᵀB] by the reflections 1 − τ v vᵀ, one for each column of A `[*batch, m, n]`, m ≥ n.

    factor: `[*batch, m, n]` R, and below its diagonal the v, which are 1 on it. tau: `[*batch, n]`. right: `[*batch, n, k]` QᵀB."""

    factor: Tensor
    tau: Tensor
    right: Tensor

    @classmethod
    def of(cls, matrix: Tensor, columns: Tensor) -> Self:
        """Of A and B `[*batch, m, k]`."""
        n = matrix.shape[-1]
        both, tau = torch.geqrf(torch.cat((matrix, columns), -1))  # torch.linalg.qr would drop what the sign needs
        return cls(both[..., :n], tau[..., :n], both[..., :n, n:])

    @property
    def solution(self) -> Tensor:
        """R⁻¹QᵀB."""
        return torch.linalg.solve_triangular(self.factor[..., : self.right.shape[-2], :], self.right, upper=True)

    @property
    def sign(self) -> Tensor:
        """Of det A where A is square: det R, times 1 − τ‖v‖² = −1 for each reflection, 1 where nothing had to be reflected."""
        reflections = 1 - self.tau * (1 + self.factor.tril(-1).square().sum(-2))
        return (self.factor.diagonal(dim1=-2, dim2=-1).sign() * reflections.sign()).prod(-1)
