"""Friction against spinning on the spot: the torque that a contact patch has and a contact point has not."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.vectors import dot, outer, rows
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.checks import require_non_negative, require_positive, require_widening
from pbfd_torch.terms.contact import Contact, PreparedContact
from pbfd_torch.terms.coulomb_friction import slip_factor, slip_factor_slope, slip_work
from pbfd_torch.terms.grouping import belonging, summed
from pbfd_torch.terms.load import LinkLoad, StepContext
from pbfd_torch.terms.touching import Touching, shifting
from pbfd_torch.tree.kinematics import Placement
from pbfd_torch.tree.rotations import log_jacobian_left, skew


@dataclass(frozen=True, eq=False)
class TorsionalFriction:
    """τ = −ℓ μ N s(|y|) y n on the body at every rounded candidate of a contact, y = φ · n the turn about the normal relative to
    the solid over the step, N the contact's normal force and s as in `CoulombFriction`, smooth below |y| = ε_ω Δt.

    Attributes:
        contact: the contact, which is a term of its own. Must have a candidate with a radius.
        mu: μ ≥ 0 of the surfaces, one number or one per candidate `[*, npoint]`.
        patch: ℓ [m] ≥ 0, the effective radius of the contact patch (MuJoCo's torsional coefficient is μℓ), likewise; ⅔ a for an
            even pressure on a disc of radius a.
        spin_speed: ε_ω [rad/s] > 0.
        held: N̂ `[*batch, npoint]` [N] that counts for N, see `lagged`; None: N itself.
    """

    contact: Contact
    mu: float | Tensor
    patch: float | Tensor
    spin_speed: float = 1e-2
    held: Tensor | None = None

    def __post_init__(self) -> None:
        require_non_negative("mu", self.mu)
        require_non_negative("patch", self.patch, "m")
        require_positive("spin_speed", self.spin_speed, "rad/s")
        if not self.contact.rounded:
            raise InputError("no candidate of the contact has a radius: torsional friction needs a sphere or a capsule")

    @cached_property
    def arm(self) -> Tensor:
        """ℓ μ of the rounded candidates, 0 for points, `[*, npoint]` [m]."""
        return self.mu * self.patch * (self.contact.radius > 0).to(self.contact.radius.dtype)

    def prepare(self, step: StepContext) -> PreparedContact:
        return self.contact.prepare(step)

    def take(self, worlds: Worlds) -> Self:
        """The same friction of some worlds."""
        return replaced(
            self,
            contact=self.contact.take(worlds),
            mu=worlds.pick(self.mu, 1),
            patch=worlds.pick(self.patch, 1),
            held=worlds.pick(self.held, 1),
        )

    def _at(self, prepared: PreparedContact, placement: Placement) -> tuple[Touching, Tensor, Tensor, Tensor, Tensor]:
        """The candidates, φ, ℓμN and its slope by the depth, and y: each of the last three `[*batch, npoint]`."""
        force = self.contact.force(prepared, placement)
        push, slope = force.push, force.normal_force.slope(force.at.depth)
        if self.held is not None:
            push, slope = self.held, torch.zeros_like(slope)
        turn = force.at.turn
        assert turn is not None  # the contact is rounded
        return force.at, turn, self.arm * push, self.arm * slope, dot(turn, force.at.normal)

    def load(self, prepared: PreparedContact, placement: Placement) -> LinkLoad:
        at, turn, limit, by_depth, angle = self._at(prepared, placement)
        on = belonging(self.contact.link, placement.poses.shape[-3], limit)
        width = self.spin_speed * prepared.dt
        size = angle.abs()
        factor = slip_factor(size, width)
        torque = -(limit * factor * angle)[..., None] * at.normal

        def stiffness() -> Tensor:
            shift = shifting(at.centers)
            turns = rows(at.normal, log_jacobian_left(turn))  # ∂y/∂ω, the normal held still
            spin = torch.cat((turns, torch.zeros_like(turns)), -1)
            if at.bend is not None:
                spin = spin + rows(turn, at.bend() @ shift)
            rises = limit * (factor + size * slip_factor_slope(size, width))
            grows = rises[..., None] * spin - (by_depth * factor * angle)[..., None] * at.sinks
            answer = outer(at.normal, grows)
            if at.bend is not None:
                answer = answer + (limit * factor * angle)[..., None, None] * (at.bend() @ shift)
            # the assembly takes the torque for one of forces on material points, whose curvature is ½[τ]× more on either side
            answer = answer - 0.5 * torch.cat((skew(torque), torch.zeros_like(answer[..., 3:])), -1)
            return summed(on, torch.cat((answer, torch.zeros_like(answer)), -2))

        moment = torch.cat((-0.5 * skew(torque), torch.zeros_like(torque)[..., None]), -1)
        return LinkLoad(summed(on, moment), stiffness)

    def energy(self, prepared: PreparedContact, placement: Placement) -> Tensor:
        """ℓ μ N̂ S(|y|) [J] `[*batch]`, S as in `slip_work`, where the friction is lagged, else none. Its gradient is the torque but
        for ½‖φ × τ‖ across the normal."""
        _, _, limit, _, angle = self._at(prepared, placement)
        work = limit * slip_work(angle.abs(), self.spin_speed * prepared.dt)
        return work.sum(-1) if self.held is not None else torch.zeros_like(work.sum(-1))

    def lagged(self, prepared: PreparedContact, placement: Placement) -> Self:
        """The same friction held at the normal forces of `placement`."""
        force = self.contact.force(prepared, placement)
        return replaced(self, held=force.push)

    def softened(self, factor: float) -> Self:
        """The same friction of a contact `factor` times as stiff."""
        return replaced(self, contact=self.contact.softened(factor))

    def widened(self, factor: float) -> Self:
        """The same friction, smooth below `factor` ≥ 1 times the spin speed."""
        require_widening(factor)
        return replaced(self, spin_speed=self.spin_speed * factor)
