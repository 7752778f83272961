"""Given values at one point, for tests of the parts of a solver."""

from __future__ import annotations

import torch
from torch import Tensor

from tests.solver_problems import FunctionObjective


class Point:
    """Given values at one point."""

    def __init__(self, residual: Tensor, jacobian: Tensor, stiffness: Tensor | None = None, value: Tensor | None = None) -> None:
        self.residual = residual
        self.jacobian = jacobian
        self.stiffness = jacobian if stiffness is None else stiffness
        self.value = torch.zeros(residual.shape[:-1], dtype=residual.dtype) if value is None else value


def plain(n: int, scale: Tensor | None = None) -> FunctionObjective:
    """An objective of which only the scale matters."""
    return FunctionObjective(lambda q, ease: q, torch.ones(n, dtype=torch.float64) if scale is None else scale)
