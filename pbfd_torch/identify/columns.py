"""Exact Jacobians by forward derivatives, where a larger batch costs next to nothing: every column is a copy of it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd import forward_ad

from pbfd_torch.identify.levenberg_marquardt import Linearized


def linearized(residual: Callable[[Tensor], Tensor]) -> Linearized:
    """The residual, a function of x `[*batch, n]` that gives `[*batch, m]` for any batch, together with its Jacobian.

    Through a simulator this is several times faster than one row at a time backward, and also than `torch.func.jvp`."""

    def function(x: Tensor) -> tuple[Tensor, Tensor]:
        n = x.shape[-1]
        copies = x.detach().expand(n, *x.shape).clone()
        along = torch.eye(n, dtype=x.dtype, device=x.device).reshape(n, *(1,) * (x.ndim - 1), n).expand_as(copies).clone()
        with forward_ad.dual_level():
            found = forward_ad.unpack_dual(residual(forward_ad.make_dual(copies, along)))
        columns = torch.zeros_like(found.primal) if found.tangent is None else found.tangent
        return found.primal[0].detach(), columns.movedim(0, -1).detach()

    return function
