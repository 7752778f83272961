"""Dry friction inside joints: a torque of constant size against the motion."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pbfd_torch.kinematics import Placement
from pbfd_torch.terms.checks import require_non_negative, require_positive
from pbfd_torch.terms.coulomb_friction import slip_factor
from pbfd_torch.terms.load import JointLoad, StepContext, diagonal_load


@dataclass(frozen=True, eq=False)
class PreparedDryFriction:
    start: Tensor  # coordinates at the start of the step, [*batch, nv]
    width: Tensor  # displacement [rad or m] over which the torque reaches its full size


@dataclass(frozen=True, eq=False)
class JointDryFriction:
    """Torque −τ s(|Δq|) Δq of hinge and slide joints: size τ once |q̇| ≥ `slip_speed` [rad/s or m/s], smooth below.
    `torque` `[*, nv]` [N m or N] ≥ 0; entries of ball and free joints must be 0."""

    torque: Tensor
    slip_speed: float = 1e-3

    def __post_init__(self) -> None:
        require_non_negative("dry friction torque", self.torque)
        require_positive("slip_speed", self.slip_speed, "rad/s or m/s")

    def prepare(self, step: StepContext) -> PreparedDryFriction:
        t = step.previous.articulation.topology
        start = step.previous.q.new_zeros((*step.previous.q.shape[:-1], t.nv))
        start[..., t.scalar_v] = step.previous.q[..., t.scalar_q]
        return PreparedDryFriction(start, self.slip_speed * step.dt[..., None])

    def load(self, prepared: PreparedDryFriction, placement: Placement) -> JointLoad:
        t = placement.articulation.topology
        moved = -prepared.start
        moved[..., t.scalar_v] = moved[..., t.scalar_v] + placement.q[..., t.scalar_q]
        size = moved.abs()
        factor, slope = slip_factor(size, prepared.width)
        return diagonal_load(self.torque * factor * moved, self.torque * (factor + slope * size))
