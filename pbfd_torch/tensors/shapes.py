"""Shapes of tensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """What shapes broadcast to, as `torch.broadcast_shapes`, which imports SymPy for it (.4 s). Raises `RuntimeError` where they do
    not go together."""
    try:
        return torch.Size(np.broadcast_shapes(*(tuple(shape) for shape in shapes)))
    except ValueError as error:
        raise RuntimeError(str(error)) from error


def spread(controls: Tensor, batch: Sequence[int]) -> Tensor:
    """Controls `[steps, *, nu]`, given for all worlds or for some dimensions of the batch, as `[steps, *batch, nu]`."""
    missing = len(batch) + 2 - controls.ndim
    if missing == 0 and controls.shape[1:-1] == batch:
        return controls
    return controls.reshape(len(controls), *(1,) * missing, *controls.shape[1:]).expand(len(controls), *batch, controls.shape[-1])
