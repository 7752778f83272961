"""States for tests."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.integrators.implicit_euler import ImplicitEuler, Positions
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.stepping.stepper import Solver


def state_of(q: Tensor, q_previous: Tensor) -> Positions:
    """The last two configurations at time 0, nothing remembered, nothing amiss."""
    time = torch.zeros_like(q[..., 0])
    return Positions(q=q, q_previous=q_previous, time=time, hazards=torch.zeros_like(time, dtype=torch.int32))


def implicit(scene: Scene, dt: float, solver: Solver | None = None, halvings: int = 3) -> Simulator[Positions]:
    """A simulator with the paper's integrator, for what is known exactly of its steps."""
    return Simulator(scene, dt, ImplicitEuler(), solver, halvings)
