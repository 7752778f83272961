"""Rollouts of the conventional formulation, for tests."""

from __future__ import annotations

from torch import Tensor

from pbfd_torch.conventional.newton_euler import NewtonEuler
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.normal_force import NormalForce

LAW = NormalForce(1e6)


def rolled(scene: Scene, dt: float, duration: float, q: Tensor | None = None, v: Tensor | None = None) -> Rollout:
    """A rollout in which every step is solved."""
    stepper = NewtonEuler(scene, dt)
    rollout = stepper.rollout(stepper.initial_state(q, v), steps=round(duration / dt))
    assert rollout.solved.all()
    assert rollout.residual_norm.max() <= stepper.tolerance == 1e-8
    return rollout
