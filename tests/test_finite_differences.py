"""The finite-difference checker itself."""

from __future__ import annotations

import torch
from torch import Tensor

from tests.finite_differences import derivative


def test_derivative_of_a_known_function() -> None:
    """The checker itself: ∂ sin(x)/∂x = cos(x) to 1e-11, and with a kink 3e-4 away from the point as well."""
    x = torch.tensor([0.3, -1.2], dtype=torch.float64)

    def smooth(delta: Tensor) -> Tensor:
        return torch.sin(5 * (x + delta))

    def kinked(delta: Tensor) -> Tensor:
        return torch.sin(5 * (x + delta)) + (delta - 3e-4).clamp_min(0)

    expected = torch.diag(5 * torch.cos(5 * x))
    assert float((derivative(smooth, 2) - expected).abs().max()) <= 1e-11
    assert float((derivative(kinked, 2) - expected).abs().max()) <= 1e-9
