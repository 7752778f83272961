"""Levenberg–Marquardt and its certainty against closed forms, bounds, and the spread of many noisy fits."""

from __future__ import annotations

import pytest
import torch
from scipy.optimize import lsq_linear
from torch import Tensor

from pbfd_torch import InputError
from pbfd_torch.identify import Bounds, Outcome, Stopping, certainty, levenberg_marquardt
from pbfd_torch.identify.levenberg_marquardt import Linearized

TIGHT = Stopping(iterations=200, step=1e-10, decrease=1e-14)


def unbounded(n: int, scale: float = 1.0) -> Bounds:
    infinite = torch.full((n,), torch.inf, dtype=torch.float64)
    return Bounds(-infinite, infinite, torch.full((n,), scale, dtype=torch.float64))


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


class Linear:
    """r = A x − b, one right side b for each row of x."""

    def __init__(self, A: Tensor, b: Tensor) -> None:
        self.A, self.b = A, b

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return x @ self.A.T - self.b, self.A.expand(*x.shape[:-1], *self.A.shape)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_linear(batch: tuple[int, ...]) -> None:
    A, b = random(30, 4), random(*batch, 30, seed=1)
    fit = levenberg_marquardt(Linear(A, b), random(*batch, 4, seed=2), unbounded(4), TIGHT)
    exact = torch.linalg.lstsq(A, b.reshape(-1, 30).T).solution.T.reshape(*batch, 4)
    assert bool(fit.converged.all())
    torch.testing.assert_close(fit.x, exact, rtol=0, atol=1e-8)
    torch.testing.assert_close(fit.cost, 0.5 * (exact @ A.T - b).square().sum(-1))
    assert bool((fit.history[1:] <= fit.history[:-1]).all())


def test_bounds_against_scipy() -> None:
    A, b = random(30, 6), 3 * random(8, 30, seed=1)
    lower, upper = torch.full((6,), -0.1).double(), torch.full((6,), 0.15).double()
    fit = levenberg_marquardt(Linear(A, b), torch.zeros(8, 6).double(), Bounds(lower, upper, torch.ones(6).double()), TIGHT)
    for k in range(8):
        exact = lsq_linear(A.numpy(), b[k].numpy(), (lower.numpy(), upper.numpy()), tol=1e-14)
        torch.testing.assert_close(fit.x[k], torch.from_numpy(exact.x), rtol=0, atol=1e-6)
        assert fit.held[k].tolist() == [bool(side) for side in exact.active_mask]
    assert bool(fit.held.any())


def rosenbrock(x: Tensor) -> tuple[Tensor, Tensor]:
    u, v = x.unbind(-1)
    one, zero = torch.ones_like(u), torch.zeros_like(u)
    jacobian = torch.stack((torch.stack((-20 * u, 10 * one), -1), torch.stack((-one, zero), -1)), -2)
    return torch.stack((10 * (v - u * u), 1 - u), -1), jacobian


def test_rosenbrock_from_many_starts() -> None:
    fit = levenberg_marquardt(rosenbrock, 2 * random(50, 2), unbounded(2), Stopping(200, 1e-9, 1e-12))
    assert bool(fit.converged.all())
    torch.testing.assert_close(fit.x, torch.ones(50, 2).double(), rtol=0, atol=1e-5)


def test_a_row_is_the_same_alone() -> None:
    starts = 2 * random(5, 2)
    together = levenberg_marquardt(rosenbrock, starts, unbounded(2), TIGHT)
    for k in range(5):
        alone = levenberg_marquardt(rosenbrock, starts[k], unbounded(2), TIGHT)
        torch.testing.assert_close(alone.x, together.x[k], rtol=0, atol=1e-9)
        assert int(alone.outcome) == int(together.outcome[k])


def test_how_fits_end() -> None:
    def broken(x: Tensor) -> tuple[Tensor, Tensor]:
        r, J = rosenbrock(x)
        return torch.where(x[..., :1] > 5, torch.nan, r), J

    def wrong(x: Tensor) -> tuple[Tensor, Tensor]:
        r, J = rosenbrock(x)
        return r, -J

    starts = torch.tensor([[1.0, 1.0], [6.0, 1.0], [-1.9, 2.0]]).double()
    few = levenberg_marquardt(broken, starts, unbounded(2), Stopping(iterations=2))
    assert few.outcome.tolist() == [Outcome.CONVERGED, Outcome.BROKEN, Outcome.EXHAUSTED]
    lost = levenberg_marquardt(wrong, starts[2], unbounded(2), Stopping(iterations=100, step=0, decrease=0))
    assert int(lost.outcome) == Outcome.STALLED


def decay(data: Tensor) -> tuple[Tensor, Linearized]:
    """y = a e^{−b t} at 40 times; the function is that of a fit to data `[*batch, 40]`."""
    time = torch.linspace(0, 3, 40, dtype=torch.float64)

    def function(x: Tensor) -> tuple[Tensor, Tensor]:
        a, b = x[..., :1], x[..., 1:]
        fall = torch.exp(-b * time)
        return a * fall - data, torch.stack((fall, -a * time * fall), -1)

    return time, function


def test_covariance_against_many_noisy_fits() -> None:
    """Over 2000 data sets the answers spread as σ²(JᵀJ)⁻¹ says, and σ² is found."""
    truth, sigma, sets = torch.tensor([2.0, 0.7]).double(), 0.05, 2000
    time, _ = decay(torch.zeros(40).double())
    data = truth[0] * torch.exp(-truth[1] * time) + sigma * random(sets, 40)
    fit = levenberg_marquardt(decay(data)[1], torch.tensor([1.0, 1.0]).double().expand(sets, 2), unbounded(2), TIGHT)
    assert bool(fit.converged.all())
    variance = 2 * fit.cost / (40 - 2)
    assert float(variance.mean()) == pytest.approx(sigma**2, rel=0.02)
    each = [certainty(fit.jacobian[k], variance[k], torch.ones(2).double()) for k in range(0, sets, 20)]
    foreseen = torch.stack([known.covariance for known in each]).mean(0)
    torch.testing.assert_close(foreseen, torch.cov(fit.x.T), rtol=0.1, atol=0)
    assert all(bool(known.determined.all()) and len(known.loose) == 0 for known in each)


def test_what_data_do_not_see() -> None:
    """A column of zeros, two that are the same, and one that is seen."""
    A = random(20, 4)
    A[:, 1] = 0
    A[:, 3] = A[:, 2]
    one, scale = torch.tensor(1.0).double(), torch.full((4,), 10.0).double()
    known = certainty(A, one, scale)
    assert known.determined.tolist() == [True, False, False, False]
    assert torch.isinf(known.deviation).tolist() == [False, True, True, True]
    assert len(known.loose) == 2
    # a difference of the two is not seen, their sum is
    slopes = torch.tensor([[0.0, 0, 1, 1], [0.0, 0, 1, -1]]).double()
    assert certainty(A, one, scale, slopes).determined.tolist() == [True, False]
    # what is held counts as known
    held = torch.tensor([False, True, False, True])
    assert certainty(A, one, scale, held=held).determined.tolist() == [True] * 4


def test_barely_seen_is_not_determined() -> None:
    """A column that is rounding of zero: its deviation is finite but says nothing; without noise only the stated noise tells."""
    A = random(20, 2)
    A[:, 1] *= 1e-9
    scale, none = torch.ones(2).double(), torch.tensor(1e-24).double()
    assert certainty(A, none, scale).determined.tolist() == [True, True]
    known = certainty(A, none, scale, stated=1.0)
    assert known.determined.tolist() == [True, False]
    assert bool(torch.isfinite(known.deviation).all())
    torch.testing.assert_close(known.loose.abs(), torch.tensor([[0.0, 1.0]]).double(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("size", [3, 5])
def test_fewer_data_than_unknowns(size: int) -> None:
    known = certainty(random(size - 1, size), torch.tensor(1.0).double(), torch.full((size,), 100.0).double())
    assert known.determined.tolist() == [False] * size
    assert len(known.loose) == 1


def test_input_errors() -> None:
    one = torch.ones(2).double()
    with pytest.raises(InputError, match="must be below"):
        Bounds(one, one, one)
    with pytest.raises(InputError, match="scale is"):
        Bounds(-one, one, 0 * one)
    with pytest.raises(InputError, match=r"must all be \[n\]"):
        Bounds(-one, one, one[:1])
    with pytest.raises(InputError, match=r"must end in \(2,\)"):
        levenberg_marquardt(rosenbrock, torch.zeros(3).double(), unbounded(2))
    with pytest.raises(InputError, match="iterations"):
        Stopping(iterations=0)
    with pytest.raises(InputError, match="decrease"):
        Stopping(decrease=-1.0)
