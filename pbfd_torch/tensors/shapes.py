"""Shapes of tensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """What shapes broadcast to, as `torch.broadcast_shapes`, which imports SymPy for it (.4 s). Raises `RuntimeError` where they do
    not go together."""
    try:
        return torch.Size(np.broadcast_shapes(*(tuple(shape) for shape in shapes)))
    except ValueError as error:
        raise RuntimeError(str(error)) from error
