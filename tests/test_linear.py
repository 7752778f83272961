"""Linear systems: a device solves by reflections, and without waiting, what LAPACK solves by LU, with the determinant's sign."""

from __future__ import annotations

from collections import Counter

import pytest
import torch
from torch import Tensor

from pbfd_torch.solvers.linear import LARGEST_LU, least_squares, solved, solved_positive, solved_with_sign
from tests.make_believe_device import DEVICE, make_believe, values
from tests.random_trees import generator

SIZES = (1, 2, 7, LARGEST_LU, LARGEST_LU + 1, 24, 40)
both_dtypes = pytest.mark.parametrize("dtype", [torch.float64, torch.float32])


def system(n: int, dtype: torch.dtype, batch: tuple[int, ...] = (3, 4)) -> tuple[Tensor, Tensor]:
    """Random matrices `[*batch, n, n]`, half of them with a negative determinant, and two columns each."""
    random = generator(n)
    matrix = torch.randn(*batch, n, n, dtype=torch.float64, generator=random)
    matrix[..., 0] *= torch.linalg.slogdet(matrix)[0][..., None]
    matrix[0, ..., 0] *= -1
    columns = torch.randn(*batch, n, 2, dtype=torch.float64, generator=random)
    return matrix.to(dtype), columns.to(dtype)


def on_device(matrix: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
    """What `solved_with_sign` finds on the device, where it must not wait."""
    with make_believe():
        there = matrix.to(DEVICE), columns.to(DEVICE)
        with make_believe() as tally:
            solution, sign = solved_with_sign(*there)
            alone = solved(*there)
    assert (tally.waits, tally.copies) == (Counter(), Counter())
    if matrix.shape[-1] > LARGEST_LU:
        torch.testing.assert_close(values(alone), values(solution), rtol=0, atol=0, equal_nan=True)
    return values(solution), values(sign)


def leftover(matrix: Tensor, solution: Tensor, columns: Tensor) -> float:
    """‖A X − B‖ over ‖A‖ ‖X‖, as a multiple of the rounding of one number."""
    A, X, B = matrix.double(), solution.double(), columns.double()
    relative = torch.linalg.matrix_norm(A @ X - B) / (torch.linalg.matrix_norm(A) * torch.linalg.matrix_norm(X))
    return float(relative.max()) / torch.finfo(solution.dtype).eps


@both_dtypes
@pytest.mark.parametrize("n", SIZES)
def test_solutions_and_signs(n: int, dtype: torch.dtype) -> None:
    """A X = B to rounding and the sign of det A, on both devices, at any number of unknowns; on the host bitwise as by LAPACK."""
    matrix, columns = system(n, dtype)
    expected = torch.linalg.slogdet(matrix.double())[0].to(dtype)
    assert set(expected.flatten().tolist()) == {-1.0, 1.0}
    here, there = solved_with_sign(matrix, columns), on_device(matrix, columns)
    for solution, sign in (here, there):
        assert torch.equal(sign, expected)
        assert leftover(matrix, solution, columns) <= 2 * n
    assert torch.equal(solved(matrix, columns), torch.linalg.solve_ex(matrix, columns)[0])
    factor, pivots, _ = torch.linalg.lu_factor_ex(matrix)
    assert torch.equal(here[0], torch.linalg.lu_solve(factor, pivots, columns))


@pytest.mark.parametrize("n", SIZES)
def test_signs_of_known_determinants(n: int) -> None:
    """Where nothing needs to be reflected, or a row is exchanged: ±1, permutations, triangles."""
    eye = torch.eye(n, dtype=torch.float64)
    triangle = torch.triu(torch.ones(n, n, dtype=torch.float64))
    flipped = eye.flip(0)
    matrix = torch.stack((eye, -eye, flipped, triangle, triangle.mT.contiguous()))
    exchanges = n * (n - 1) // 2
    expected = torch.tensor([1.0, (-1.0) ** n, (-1.0) ** exchanges, 1.0, 1.0], dtype=torch.float64)
    columns = torch.ones(5, n, 1, dtype=torch.float64)
    for solution, sign in (solved_with_sign(matrix, columns), on_device(matrix, columns)):
        assert torch.equal(sign, expected)
        torch.testing.assert_close(matrix @ solution, columns, rtol=0, atol=1e-12)


@pytest.mark.parametrize("n", [5, 24])
def test_bad_worlds_spoil_no_other(n: int) -> None:
    """A column of zeros, NaN and infinity: sign 0, no finite solution and no error; others are bitwise as without them."""
    matrix, columns = system(n, torch.float64, (5,))
    bad = matrix.clone()
    bad[1, :, n // 2] = 0.0
    bad[2, n // 2, 0] = torch.nan
    bad[3] = torch.inf
    (whole, _), (solution, sign) = on_device(matrix, columns), on_device(bad, columns)
    assert sign[1:4].tolist() == [0.0, 0.0, 0.0]
    assert not bool(torch.isfinite(solution[1:4]).flatten(1).all(1).any())
    assert torch.equal(solution[[0, 4]], whole[[0, 4]])


@both_dtypes
@pytest.mark.parametrize("n", SIZES)
def test_positive_matrices(n: int, dtype: torch.dtype) -> None:
    """A X = B to rounding on both devices; on the host bitwise as by LAPACK's LU."""
    matrix, columns = system(n, dtype)
    positive = matrix @ matrix.mT + torch.eye(n, dtype=dtype)
    here = solved_positive(positive, columns)
    assert torch.equal(here, torch.linalg.solve_ex(positive, columns)[0])
    with make_believe():
        there = positive.to(DEVICE), columns.to(DEVICE)
        with make_believe() as tally:
            solution = values(solved_positive(*there))
    assert (tally.waits, tally.copies) == (Counter(), Counter())
    assert max(leftover(positive, x, columns) for x in (here, solution)) <= 2 * n


def test_derivatives_of_a_solution() -> None:
    """By the size of a positive matrix, through what a device does: those of the host."""
    matrix, columns = system(24, torch.float64, (2,))
    positive = matrix @ matrix.mT + torch.eye(24, dtype=torch.float64)

    def of(matrix: Tensor, size: Tensor, columns: Tensor) -> Tensor:
        return solved_positive((1 + size) * matrix, columns).square().sum()

    size = torch.zeros((), dtype=torch.float64, requires_grad=True)
    expected = torch.autograd.grad(of(positive, size, columns), size)[0]
    with make_believe():
        x, b = positive.to(DEVICE), columns.to(DEVICE)
        there = torch.zeros((), dtype=torch.float64, device=DEVICE, requires_grad=True)
        found = torch.autograd.grad(of(x, there, b), there)[0]
    torch.testing.assert_close(values(found), expected, rtol=1e-9, atol=0)


@both_dtypes
def test_least_squares(dtype: torch.dtype) -> None:
    """The residual is orthogonal to the matrix' columns; the same on both devices."""
    random = generator(0)
    matrix = torch.randn(2, 3, 12, 5, dtype=torch.float64, generator=random).to(dtype)
    columns = torch.randn(2, 3, 12, 1, dtype=torch.float64, generator=random).to(dtype)
    solution = least_squares(matrix, columns)
    left = matrix.mT @ (matrix @ solution - columns)
    assert float(left.abs().max()) <= 100 * torch.finfo(dtype).eps
    with make_believe():
        there = matrix.to(DEVICE), columns.to(DEVICE)
        with make_believe() as tally:
            assert torch.equal(values(least_squares(*there)), solution)
    assert (tally.waits, tally.copies) == (Counter(), Counter())
