"""Joint limits: a stiff one-sided spring, continuously differentiable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from torch import Tensor

from pbfd_torch.articulation import Articulation, force_scale, lever
from pbfd_torch.kinematics import Placement
from pbfd_torch.terms.checks import require_positive
from pbfd_torch.terms.load import JointLoad, StepContext, diagonal_load
from pbfd_torch.worlds import Worlds, replaced


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Torque −k x² back towards the range, x the violation of `articulation.lower/upper`; energy k x³/3. `stiffness` `[*, nv]`
    [N m/rad² or N/m²] > 0: a load τ rests √(τ/k) past the limit. Coordinates of ball and free joints have no limits."""

    stiffness: Tensor

    def __post_init__(self) -> None:
        require_positive("limit stiffness", self.stiffness)

    @staticmethod
    def for_articulation(articulation: Articulation, gravity: float = 9.81, violation: float = 2e-3) -> JointLimits:
        """Stiffness for which the whole weight (m g for a slide, m g · reach for a hinge) rests `violation` [rad or m] past a
        limit. Reach: see `articulation.reach`. Raises `InputError` for a violation ≤ 0."""
        require_positive("violation", violation, "rad or m")
        return JointLimits(force_scale(articulation, gravity) / violation**2)

    def prepare(self, step: StepContext) -> None:
        return None

    def load(self, prepared: None, placement: Placement) -> JointLoad:
        below, above = _violations(placement)
        residual = self.stiffness * (above * above - below * below)
        return diagonal_load(residual, 2 * self.stiffness * (above + below))

    def energy(self, prepared: None, placement: Placement) -> Tensor:
        """The stored energy [J] `[*batch]`."""
        below, above = _violations(placement)
        return (self.stiffness * (above**3 + below**3)).sum(-1) / 3

    def take(self, worlds: Worlds) -> Self:
        """The same limits with the stiffness of some worlds."""
        return replaced(self, stiffness=worlds.pick(self.stiffness, 1))

    def softened(self, factor: float) -> JointLimits:
        """The same limits with stiffness scaled by `factor`."""
        return JointLimits(self.stiffness * factor)

    def push(self, prepared: None, placement: Placement) -> Tensor:
        """See `Pushing`."""
        return (self.load(prepared, placement).residual.abs() / lever(placement.articulation)).sum(-1)

    def potential(self, placement: Placement, time: Tensor) -> Tensor:
        """Stored energy [J] `[*batch]`."""
        return self.energy(None, placement)


def _violations(placement: Placement) -> tuple[Tensor, Tensor]:
    """How far each coordinate is below its lower and above its upper limit, ≥ 0, `[*batch, nv]`."""
    articulation = placement.articulation
    t = articulation.topology
    x = placement.q.new_zeros((*placement.q.shape[:-1], articulation.nv))
    x[..., t.scalar_v] = placement.q[..., t.scalar_q]
    return (articulation.lower - x).clamp_min(0), (x - articulation.upper).clamp_min(0)
