"""Random numbers for tests: the same ones for the same seed."""

from __future__ import annotations

import torch
from torch import Tensor

from tests.random_trees import generator


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=generator(seed))


def uniform(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, dtype=torch.float64, generator=generator(seed))
