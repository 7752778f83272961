"""Joint limits: a stiff one-sided spring, continuously differentiable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.contact.hazards import Hazard, marked
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.checks import require_positive
from pbfd_torch.terms.load import JointLoad, StepContext, diagonal_load
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.release import NormalLaw, Releasing, require_release
from pbfd_torch.terms.scalar_coordinates import scalar_coordinates
from pbfd_torch.tree.articulation import Articulation, force_scale, lever
from pbfd_torch.tree.kinematics import Placement

_LAW = NormalForce(1.0, exponent=2.0)
TOO_FAR = 0.02  # [rad or m] past a limit: ten times what the weight brings about
RETURN = 0.2  # [s] in which a joint comes back from far beyond, but for a share of 1/e
HELD = 4e-4  # [rad or m] past a limit under the largest force of the joint's actuators


@dataclass(frozen=True, eq=False)
class PreparedLimits:
    stiffness: Tensor  # [*, nv]
    starts: tuple[Tensor, Tensor] | None  # how far past its lower and upper limit each coordinate began; None: nothing is let go
    dt: Tensor  # [*batch, 1]


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Torque −k x² back towards the range, x the violation of `articulation.lower/upper`; energy k x³/3. Like a contact, a limit
    lets go of what leaves it (`Releasing`). Coordinates of ball and free joints have no limits.

    `stiffness`: k `[*, nv]` [N m/rad² or N/m²] > 0: a load τ rests √(τ/k) past the limit.
    `release`: speed > 0 of leaving [rad/s or m/s] at which a limit pushes no more: what a strike leaves with, at most, however
    short the steps. From far beyond it is faster, by x / .2 s, so a joint that starts there is back soon. Infinite: never, and
    short steps bounce.
    `drives`: actuators without a largest force: in every step k is at least what holds them within `HELD`.
    `share`: k is multiplied by it."""

    stiffness: Tensor
    release: float = 0.1
    drives: Actuators | None = None
    share: float = 1.0

    def __post_init__(self) -> None:
        require_positive("limit stiffness", self.stiffness)
        require_release(self.release)

    @staticmethod
    def for_articulation(
        articulation: Articulation, gravity: float = 9.81, violation: float = 2e-3, actuators: Actuators | None = None
    ) -> JointLimits:
        """Stiffness for which the whole weight (m g for a slide, m g · reach for a hinge) rests `violation` [rad or m] past a
        limit, and the weight and the largest force of the joint's actuators at most .4 mrad or mm. Reach: see
        `articulation.reach`. Raises `InputError` for a violation ≤ 0."""
        require_positive("violation", violation, "rad or m")
        load = force_scale(articulation, gravity)
        stiffness = load / violation**2
        if actuators is None:
            return JointLimits(stiffness)
        efforts = actuators.efforts(articulation)
        known = load.new_tensor([x if math.isfinite(x) else 0.0 for x in efforts])
        held = torch.where(known > 0, (load + known) / HELD**2, 0.0)
        unbounded = any(math.isinf(x) for x in efforts)
        return JointLimits(torch.maximum(stiffness, held), drives=actuators if unbounded else None)

    def _laws(self, prepared: PreparedLimits) -> Sequence[NormalLaw]:
        """Below and above the range."""
        law = replaced(_LAW, stiffness=prepared.stiffness * self.share)
        if prepared.starts is None:
            return [law, law]
        return [Releasing(law, start, (self.release + start / RETURN) * prepared.dt) for start in prepared.starts]

    def prepare(self, step: StepContext) -> PreparedLimits:
        stiffness = self.stiffness
        if self.drives is not None:
            pressing = self.drives.pressing(self.drives.prepare(step))
            stiffness = torch.maximum(stiffness, pressing / HELD**2)
        below, above = (depth.clamp_min(0) for depth in _depths(step.previous))
        return PreparedLimits(stiffness, None if math.isinf(self.release) else (below, above), step.dt[..., None])

    def load(self, prepared: PreparedLimits, placement: Placement) -> JointLoad:
        below, above = zip(self._laws(prepared), _depths(placement), strict=True)
        residual = above[0].push(above[1]) - below[0].push(below[1])
        return diagonal_load(residual, above[0].slope(above[1]) + below[0].slope(below[1]))

    def energy(self, prepared: PreparedLimits, placement: Placement) -> Tensor:
        """The integral of the step's forces [J] `[*batch]`."""
        sides = zip(self._laws(prepared), _depths(placement), strict=True)
        return torch.stack([law.energy(depth).sum(-1) for law, depth in sides]).sum(0)

    def take(self, worlds: Worlds) -> Self:
        """The same limits with the stiffness of some worlds."""
        drives = None if self.drives is None else self.drives.take(worlds)
        return replaced(self, stiffness=worlds.pick(self.stiffness, 1), drives=drives)

    def softened(self, factor: float) -> Self:
        """The same limits with stiffness scaled by `factor`."""
        return replaced(self, share=self.share * factor)

    def push(self, prepared: PreparedLimits, placement: Placement) -> Tensor:
        """See `Pushing`."""
        return (self.load(prepared, placement).residual.abs() / lever(placement.articulation)).sum(-1)

    def hazards(self, prepared: PreparedLimits, placement: Placement, turned: Tensor) -> Tensor:
        """See `Hazardous`."""
        share, _ = self.strain(prepared, placement, turned)
        return marked({Hazard.TOO_DEEP: (share > 1).any(-1)})

    def dangers(self, articulation: Articulation) -> tuple[str, ...]:
        """See `Hazardous`."""
        return tuple(f"limit of {articulation.joint_names[j]}" for j in articulation.topology.dof_joints)

    def strain(self, prepared: PreparedLimits, placement: Placement, turned: Tensor) -> tuple[Tensor, Tensor]:
        """See `Hazardous`."""
        past = torch.stack(_depths(placement)).amax(0)
        return past / TOO_FAR, torch.arange(past.shape[-1], device=past.device).expand(past.shape)

    def potential(self, placement: Placement, time: Tensor) -> Tensor:
        """Stored energy [J] `[*batch]`, as long as no drive presses."""
        law = replaced(_LAW, stiffness=self.stiffness * self.share)
        below, above = _depths(placement)
        return (law.energy(above) + law.energy(below)).sum(-1)


def _depths(placement: Placement) -> tuple[Tensor, Tensor]:
    """How far each coordinate is below its lower and above its upper limit, < 0 within the range, −1 at least, `[*batch, nv]`."""
    articulation, x = placement.articulation, scalar_coordinates(placement)
    # what has no limit is infinitely far from it, which autograd does not survive
    return (articulation.lower - x).clamp_min(-1.0), (x - articulation.upper).clamp_min(-1.0)
