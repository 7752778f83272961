"""A box that slides to rest, as a function of its speed and its friction."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch import Simulator
from pbfd_torch.gradients.parameters import with_parameters
from pbfd_torch.models import SCENES
from tests.gradient_checks import PRECISE


def stopped(v0: Tensor, mu: Tensor, dt: float = 0.01, seconds: float = 0.5) -> Tensor:
    """How far the box slides from v0 `[m]` with μ `[m]`."""
    setup = SCENES["box-slide"](worlds=len(v0))
    scene = with_parameters(setup.scene, {"terms.1.friction.mu": mu[:, None]})
    simulator = Simulator(scene, dt, solver=PRECISE)
    v = torch.cat((v0[:, None], setup.v[:, 1:]), -1)
    path = simulator.trajectory(simulator.initial_state(setup.q, v), steps=round(seconds / dt))
    assert bool(path.solved.all())
    return path.q[-1, :, 0] - path.q[0, :, 0]
