"""The plain tensor inside what torch.func works on, for what carries no derivatives: other libraries, and the host's choices."""

from __future__ import annotations

import torch
from torch import Tensor


def wrapped(value: Tensor) -> bool:
    """Whether torch.func is at work on a tensor, which then has no memory of its own."""
    return bool(torch._C._functorch.is_functorch_wrapped_tensor(value))


def plain(value: Tensor) -> Tensor:
    """Its values alone."""
    while wrapped(value):
        value = torch._C._functorch.get_unwrapped(value)
    return value.detach()
