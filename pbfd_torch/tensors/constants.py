"""Python's numbers as tensors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def filled(values: Sequence[float], like: Tensor) -> Tensor:
    """A vector `[k]` of the type of a tensor and where that is. Its entries are filled in there: a copy from the host would make it
    wait for a device."""
    return torch.stack([torch.full((), x, dtype=like.dtype, device=like.device) for x in values])


def indices(values: Sequence[int], device: torch.device) -> Tensor:
    """Whole numbers `[n]`, copied to a device: for what is made once, not in a step."""
    return torch.tensor(values, dtype=torch.long, device=device)
