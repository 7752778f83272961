"""Dry friction inside joints: a torque of constant size against the motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from torch import Tensor

from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.checks import require_non_negative, require_positive, require_widening
from pbfd_torch.terms.coulomb_friction import slip_factor, slip_factor_slope, slip_work
from pbfd_torch.terms.load import JointLoad, StepContext, diagonal_load
from pbfd_torch.terms.scalar_coordinates import scalar_coordinates
from pbfd_torch.tree.kinematics import Placement


@dataclass(frozen=True, eq=False)
class PreparedDryFriction:
    start: Tensor  # coordinates at the start of the step, [*batch, nv]
    dt: Tensor  # [*batch, 1]


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
        return PreparedDryFriction(scalar_coordinates(step.previous), step.dt[..., None])

    def load(self, prepared: PreparedDryFriction, placement: Placement) -> JointLoad:
        moved = _moved(prepared, placement)
        size = moved.abs()
        width = self.slip_speed * prepared.dt
        factor, slope = slip_factor(size, width), slip_factor_slope(size, width)
        return diagonal_load(self.torque * factor * moved, self.torque * (factor + slope * size))

    def take(self, worlds: Worlds) -> Self:
        """The same friction with the torques of some worlds."""
        return replaced(self, torque=worlds.pick(self.torque, 1))

    def energy(self, prepared: PreparedDryFriction, placement: Placement) -> Tensor:
        """Σ τ S(|Δq|) [J] `[*batch]`, S as in `slip_work`: what the friction takes from the step."""
        size = _moved(prepared, placement).abs()
        return (self.torque * slip_work(size, self.slip_speed * prepared.dt)).sum(-1)

    def widened(self, factor: float) -> Self:
        """The same torque, smooth below `factor` ≥ 1 times the slip speed."""
        require_widening(factor)
        return replaced(self, slip_speed=self.slip_speed * factor)

    def lagged(self, prepared: PreparedDryFriction, placement: Placement) -> Self:
        """Itself: its torque depends on no normal force."""
        return self


def _moved(prepared: PreparedDryFriction, placement: Placement) -> Tensor:
    """Displacement of each hinge and slide over the step `[*batch, nv]`, 0 for other degrees of freedom."""
    return scalar_coordinates(placement) - prepared.start
