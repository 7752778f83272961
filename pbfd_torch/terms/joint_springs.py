"""Effects that pull a joint towards a coordinate: springs, damping and armature share one quadratic energy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.checks import require_non_negative
from pbfd_torch.terms.load import JointLoad, StepContext, diagonal_load
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Placement, difference, retract
from pbfd_torch.tree.rotations import log_jacobian_symmetric


def checked_coefficient(articulation: Articulation, value: Tensor, what: str) -> Tensor:
    """`value` `[*, nv]` as the articulation's dtype; raises `InputError` unless it is finite, ≥ 0 and the same about all three axes
    of a ball or free joint's rotation."""
    value = torch.as_tensor(value, dtype=articulation.dtype, device=articulation.device)
    if value.ndim == 0 or value.shape[-1] != articulation.nv:
        raise InputError(f"{what} has shape {tuple(value.shape)}: must end in ({articulation.nv},)")
    require_non_negative(what, value)
    turning = value[..., articulation.topology.turning_v]
    if not bool((turning == turning[..., :1]).all()):
        raise InputError(f"{what} of a ball or free joint differs between its rotation axes: must be equal for all three")
    return value


def elastic_load(articulation: Articulation, coefficient: Tensor, rest: Tensor, q: Tensor) -> JointLoad:
    """Gradient and Hessian of ½ Σ c_i e_i², e = difference(rest, q); rotation vectors keep their exact curvature."""
    t = articulation.topology
    gap = difference(articulation, rest, q)

    def hessian() -> Tensor:
        stiffness = torch.diag_embed(coefficient.expand_as(gap))
        if len(t.turning_v):
            rows, columns = t.turning_v[:, :, None], t.turning_v[:, None, :]
            factor = coefficient[..., t.turning_v[:, :1]].unsqueeze(-1)
            stiffness[..., rows, columns] = factor * log_jacobian_symmetric(gap[..., t.turning_v])
        return stiffness

    return JointLoad(coefficient * gap, hessian)


@dataclass(frozen=True, eq=False)
class PreparedPull:
    coefficient: Tensor
    rest: Tensor
    start: Tensor | None = None  # the configuration at the start of the step


class _Pull:
    """Load and energy of an effect whose `prepare` gives a coefficient `[*batch, nv]` and a rest configuration."""

    def load(self, prepared: PreparedPull, placement: Placement) -> JointLoad:
        return elastic_load(placement.articulation, prepared.coefficient, prepared.rest, placement.q)

    def energy(self, prepared: PreparedPull, placement: Placement) -> Tensor:
        gap = difference(placement.articulation, prepared.rest, placement.q)
        return 0.5 * (prepared.coefficient * gap * gap).sum(-1)


@dataclass(frozen=True, eq=False)
class JointSprings(_Pull):
    """Torque −k (q − rest). `stiffness` `[*, nv]` [N m/rad or N/m] ≥ 0, `rest` `[*, nq]`. `share`: see `taken_at`."""

    stiffness: Tensor
    rest: Tensor
    share: Tensor | None = None

    def __post_init__(self) -> None:
        require_non_negative("spring stiffness", self.stiffness)

    def prepare(self, step: StepContext) -> PreparedPull:
        return PreparedPull(self.stiffness, self.rest, step.previous.q)

    def load(self, prepared: PreparedPull, placement: Placement) -> JointLoad:
        """See `Term`."""
        load = super().load(prepared, self._taken(prepared, placement))
        share = self.share
        if share is None:
            return load
        return JointLoad(share * load.residual, lambda: share[..., None] * load.stiffness * share[..., None, :])

    def energy(self, prepared: PreparedPull, placement: Placement) -> Tensor:
        """The stored energy [J] `[*batch]`, where the coordinates are taken."""
        return super().energy(prepared, self._taken(prepared, placement))

    def _taken(self, prepared: PreparedPull, placement: Placement) -> Placement:
        """The coordinates at the share of the step; the poses are left where they are."""
        if self.share is None or prepared.start is None:
            return placement
        a, start = placement.articulation, prepared.start
        return replaced(placement, q=retract(a, start, self.share * difference(a, start, placement.q)))

    def flow(self, placement: Placement, v: Tensor, control: Tensor | None) -> JointLoad:
        """See `Flowing`."""
        return elastic_load(placement.articulation, self.stiffness, self.rest, placement.q)

    def slope(self, articulation: Articulation, dt: Tensor) -> Tensor:
        """∂r/∂q `[*, nv]`."""
        return self.stiffness

    def taken_at(self, share: Tensor) -> Self:
        """θ of the springs, at q_n + θ (q − q_n), θ `[*, nv]`; 1 for rotations of ball and free joints."""
        return replaced(self, share=share)

    def take(self, worlds: Worlds) -> Self:
        """The same springs with the values of some worlds."""
        stiffness, rest, share = (worlds.pick(x, 1) for x in (self.stiffness, self.rest, self.share))
        return replaced(self, stiffness=stiffness, rest=rest, share=share)

    def potential(self, placement: Placement, time: Tensor) -> Tensor:
        """Stored energy [J] `[*batch]`."""
        return super().energy(PreparedPull(self.stiffness, self.rest), placement)


@dataclass(frozen=True, eq=False)
class JointDamping(_Pull):
    """Torque −c q̇ with q̇ = (q_{n+1} − q_n)/Δt, implicit. `damping` `[*, nv]` [N m s/rad or N s/m] ≥ 0."""

    damping: Tensor

    def __post_init__(self) -> None:
        require_non_negative("joint damping", self.damping)

    def prepare(self, step: StepContext) -> PreparedPull:
        return PreparedPull(self.damping / step.dt[..., None], step.previous.q)

    def flow(self, placement: Placement, v: Tensor, control: Tensor | None) -> JointLoad:
        """See `Flowing`."""
        return diagonal_load(self.damping * v, torch.zeros_like(v))

    def slope(self, articulation: Articulation, dt: Tensor) -> Tensor:
        """∂r/∂q `[*, nv]`."""
        return self.damping / dt[..., None]

    def taken_at(self, share: Tensor) -> Self:
        """θ of the damping, θ `[*, nv]`; it answers what the coordinates move by, wherever in the step."""
        return replaced(self, damping=share * self.damping)

    def take(self, worlds: Worlds) -> Self:
        """The same damping with the coefficients of some worlds."""
        return replaced(self, damping=worlds.pick(self.damping, 1))


@dataclass(frozen=True, eq=False)
class Armature(_Pull):
    """Inertia of the rotors behind the joints, as MuJoCo's: added to the diagonal of the mass matrix. `inertia` `[*, nv]`
    [kg m² or kg] ≥ 0; pulled to the integrator's target configuration as links are to their target poses. `length`: see
    `shortened`."""

    inertia: Tensor
    length: float = 1.0

    def __post_init__(self) -> None:
        require_non_negative("armature", self.inertia)

    def prepare(self, step: StepContext) -> PreparedPull:
        a, start, target = step.previous.articulation, step.previous.q, step.target_q
        if self.length < 1:
            target = retract(a, start, self.length * difference(a, start, target))
        return PreparedPull(self.inertia * step.weight[..., None] / self.length**2, target)

    def shortened(self, share: float) -> Self:
        """See `Inert`."""
        return replaced(self, length=share * self.length)

    def take(self, worlds: Worlds) -> Self:
        """The same armature with the inertias of some worlds."""
        return replaced(self, inertia=worlds.pick(self.inertia, 1))
