"""Joint limits: a stiff one-sided spring, continuously differentiable."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

from torch import Tensor

from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.checks import require_positive
from pbfd_torch.terms.load import JointLoad, StepContext, diagonal_load
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.release import NormalLaw, require_release
from pbfd_torch.terms.scalar_coordinates import scalar_coordinates
from pbfd_torch.tree.articulation import Articulation, force_scale, lever
from pbfd_torch.tree.kinematics import Placement

_LAW = NormalForce(1.0, exponent=2.0)


@dataclass(frozen=True, eq=False)
class PreparedLimits:
    below: NormalLaw  # of how far each coordinate is below its lower limit
    above: NormalLaw


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Torque −k x² back towards the range, x the violation of `articulation.lower/upper`; energy k x³/3. Like a contact, a limit
    lets go of what leaves it (`Releasing`). Coordinates of ball and free joints have no limits.

    `stiffness`: k `[*, nv]` [N m/rad² or N/m²] > 0: a load τ rests √(τ/k) past the limit.
    `release`: speed > 0 of leaving [rad/s or m/s] at which a limit pushes no more; infinite: never, and short steps bounce."""

    stiffness: Tensor
    release: float = 1.0

    def __post_init__(self) -> None:
        require_positive("limit stiffness", self.stiffness)
        require_release(self.release)

    @staticmethod
    def for_articulation(articulation: Articulation, gravity: float = 9.81, violation: float = 2e-3) -> JointLimits:
        """Stiffness for which the whole weight (m g for a slide, m g · reach for a hinge) rests `violation` [rad or m] past a
        limit. Reach: see `articulation.reach`. Raises `InputError` for a violation ≤ 0."""
        require_positive("violation", violation, "rad or m")
        return JointLimits(force_scale(articulation, gravity) / violation**2)

    @property
    def _law(self) -> NormalForce:
        return replaced(_LAW, stiffness=self.stiffness, release=self.release)

    def prepare(self, step: StepContext) -> PreparedLimits:
        if math.isinf(self.release):
            return PreparedLimits(self._law, self._law)
        starts, dt = _depths(step.previous), step.dt[..., None]
        below, above = (self._law.during(depth.clamp_min(0), dt) for depth in starts)
        return PreparedLimits(below, above)

    def load(self, prepared: PreparedLimits, placement: Placement) -> JointLoad:
        below, above = _depths(placement)
        residual = prepared.above.push(above) - prepared.below.push(below)
        return diagonal_load(residual, prepared.above.slope(above) + prepared.below.slope(below))

    def energy(self, prepared: PreparedLimits, placement: Placement) -> Tensor:
        """The integral of the step's forces [J] `[*batch]`."""
        below, above = _depths(placement)
        return (prepared.above.energy(above) + prepared.below.energy(below)).sum(-1)

    def take(self, worlds: Worlds) -> Self:
        """The same limits with the stiffness of some worlds."""
        return replaced(self, stiffness=worlds.pick(self.stiffness, 1))

    def softened(self, factor: float) -> Self:
        """The same limits with stiffness scaled by `factor`."""
        return replaced(self, stiffness=self.stiffness * factor)

    def push(self, prepared: PreparedLimits, placement: Placement) -> Tensor:
        """See `Pushing`."""
        return (self.load(prepared, placement).residual.abs() / lever(placement.articulation)).sum(-1)

    def potential(self, placement: Placement, time: Tensor) -> Tensor:
        """Stored energy [J] `[*batch]`."""
        below, above = _depths(placement)
        return (self._law.energy(above) + self._law.energy(below)).sum(-1)


def _depths(placement: Placement) -> tuple[Tensor, Tensor]:
    """How far each coordinate is below its lower and above its upper limit, < 0 within the range, −1 at least, `[*batch, nv]`."""
    articulation, x = placement.articulation, scalar_coordinates(placement)
    # what has no limit is infinitely far from it, which autograd does not survive
    return (articulation.lower - x).clamp_min(-1.0), (x - articulation.upper).clamp_min(-1.0)
