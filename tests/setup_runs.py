"""Rollouts of named scenes and their metrics."""

from __future__ import annotations

from pbfd_torch.models.setup import Setup
from pbfd_torch.records.rollout import Rollout
from tests.bodies import rolled_out


def run(setup: Setup, dt: float, duration: float) -> Rollout:
    """The set-up's own start, for `duration` seconds at step dt."""
    return rolled_out(setup.scene, dt, duration, setup.q, setup.v)


def metric(setup: Setup, rollout: Rollout, name: str) -> list[float]:
    value = setup.metrics(rollout)[name]
    return value if isinstance(value, list) else [value]
