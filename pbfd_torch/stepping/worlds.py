"""Values of some worlds, put back among those of all."""

from __future__ import annotations

import math
from typing import TypeVar

import torch
from torch import Tensor

from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.tensors.worlds import Worlds

T = TypeVar("T")


def put(whole: T, part: T, worlds: Worlds, kept: Tensor) -> T:
    """Values of a batch with those of some worlds replaced by `part`, where `kept` `[n]`: tensors, or states made of them."""

    def write(old: Tensor, new: Tensor) -> Tensor:
        rows = old.reshape(math.prod(worlds.batch), *old.shape[len(worlds.batch) :])
        before = rows[worlds.index]
        chosen = torch.where(kept.reshape(-1, *(1,) * (rows.ndim - 1)), new.reshape(before.shape), before)
        return rows.index_copy(0, worlds.index, chosen).reshape(old.shape)

    result: T = mapped(write, whole, part)
    return result
