"""States for tests."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.integrators.implicit_euler import State


def state_of(q: Tensor, q_previous: Tensor) -> State:
    """The last two configurations at time 0, nothing remembered, nothing amiss."""
    time = torch.zeros_like(q[..., 0])
    return State(q, q_previous, time, torch.zeros_like(time, dtype=torch.int32))
