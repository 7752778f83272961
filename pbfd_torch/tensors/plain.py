"""Which tensors carry derivatives, and the plain one inside what torch.func works on: for other libraries, and for choices."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import forward_ad


def wrapped(value: Tensor) -> bool:
    """Whether torch.func is at work on a tensor, which then has no memory of its own."""
    return bool(torch._C._functorch.is_functorch_wrapped_tensor(value))


def plain(value: Tensor) -> Tensor:
    """Its values alone."""
    while wrapped(value):
        value = torch._C._functorch.get_unwrapped(value)
    return value.detach()


def primal(value: Tensor) -> Tensor:
    """Its values without derivatives, backward or forward ones."""
    return forward_ad.unpack_dual(value).primal.detach() if value.is_floating_point() else value.detach()


def changes(value: Tensor) -> bool:
    """Whether it has a forward derivative."""
    return value.is_floating_point() and forward_ad.unpack_dual(value).tangent is not None


def carries(value: Tensor) -> bool:
    """Whether a tensor carries derivatives, backward or forward ones."""
    if torch.is_grad_enabled() and value.requires_grad:
        return True
    return changes(value)
