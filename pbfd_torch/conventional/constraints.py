"""What keeps a step's velocity within bounds: contacts, joint limits and dry friction of joints, all of one form.

Each constraint has a normal and two tangents, and is a row of `complementarity`: u = Jv + b. A gap g > 0 may close within the step,
u_n = ġ + g/Δt ≥ 0, so that nothing is felt before it is reached and an impact leaves no penetration; of a penetration g < 0 the
share β is undone, u_n = ġ + βg/Δt ≥ 0 (Baumgarte).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.tensors.vectors import dot
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import DryFriction
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.touching import Touching
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Placement


@dataclass(frozen=True, eq=False)
class Constraints:
    """Attributes:
    rows: J `[*batch, n, 3, nv]` (normal, tangent, tangent).
    bias: b `[*batch, n, 3]` [m/s or rad/s].
    mu: μ `[*batch, n]`. hold: R₀ `[*batch, n]` [N s or N m s].
    """

    rows: Tensor
    bias: Tensor
    mu: Tensor
    hold: Tensor

    @staticmethod
    def together(parts: list[Constraints], batch: tuple[int, ...]) -> Constraints:
        """All of them, one after the other; at least one."""

        def joined(values: list[Tensor], rank: int) -> Tensor:
            return torch.cat([x.expand(*batch, *x.shape[x.ndim - rank :]) for x in values], -rank)

        return Constraints(
            joined([x.rows for x in parts], 3),
            joined([x.bias for x in parts], 2),
            joined([x.mu for x in parts], 1),
            joined([x.hold for x in parts], 1),
        )


def contact_frame(normal: Tensor) -> Tensor:
    """Right-handed axes (normal, tangent, tangent) in rows, `[*, 3] → [*, 3, 3]`, without a singular normal (Duff et al. 2017,
    "Building an orthonormal basis, revisited")."""
    x, y, z = normal.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(z.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), -1)
    return torch.stack((normal, first, torch.stack((b, sign + y * y * a, -y), -1)), -2)


def contact_constraints(
    contact: Contact, prepared: Any, placement: Placement, time: Tensor, dt: Tensor, share: float
) -> tuple[Constraints, Tensor]:
    """Every candidate at the placement that starts the step, one that is far included: its gap keeps its impulse zero. Distances
    are those to the solid as it will stand at the end of the step. And the frames `[*batch, n, 3, 3]` of `contact_frame`."""
    at = contact.touching(prepared, placement)
    frame = contact_frame(at.normal)
    topology = placement.articulation.topology
    arms = torch.cat((torch.linalg.cross(at.points[..., None, :], frame), frame), -1)
    rows = (arms.flatten(-3, -2) @ placement.axes.mT).unflatten(-2, arms.shape[-3:-1])
    rows = rows * topology.moves_link[contact.link].to(rows.dtype)[:, None]
    slid = dot(frame[..., 1:, :], at.travel[..., None, :]) / dt[..., None, None]
    bias = torch.cat((_closing(contact, at, placement, time, dt, share)[..., None], slid), -1)
    return Constraints(rows, bias, friction_coefficient(contact), torch.zeros_like(contact.radius)), frame


def _closing(contact: Contact, at: Touching, placement: Placement, time: Tensor, dt: Tensor, share: float) -> Tensor:
    """The normal's part of b, `[*batch, n]`. What the solid's own motion closes is always undone in full."""
    depth = at.depth
    if contact.carrier is not None and contact.carrier.motion.moves:
        depth = contact.depth(placement, time)
    undone = torch.where(depth > 0, share, 1.0) * depth + (at.depth - depth)
    speed = -undone / dt[..., None]
    return speed if at.steepness is None else speed / at.steepness


def friction_coefficient(contact: Contact) -> Tensor:
    """μ of every candidate `[*, npoint]`: of Coulomb's law and laws like it, times the grip; 0 without friction."""
    if contact.friction is None:
        return torch.zeros_like(contact.radius)
    assert isinstance(contact.friction, DryFriction)  # checked at construction
    return contact.friction.mu * (torch.ones_like(contact.radius) if contact.grip is None else contact.grip)


def limit_constraints(articulation: Articulation, dofs: Tensor, q: Tensor, dt: Tensor, share: float) -> Constraints:
    """The lower and upper limits of some degrees of freedom, two constraints each; one that is infinite is never reached."""
    t = articulation.topology
    x = q.new_zeros((*q.shape[:-1], t.nv))
    x[..., t.scalar_v] = q[..., t.scalar_q]
    gap = torch.cat((x - articulation.lower, articulation.upper - x), -1)[..., torch.cat((dofs, dofs + t.nv))]
    closing = torch.where(gap < 0, share, 1.0) * gap / dt[..., None]
    axes = torch.eye(t.nv, dtype=q.dtype, device=q.device)[dofs]
    rows = q.new_zeros((2 * len(dofs), 3, t.nv))
    rows[:, 0] = torch.cat((axes, -axes))
    none = torch.zeros_like(closing)
    return Constraints(rows, torch.stack((closing, none, none), -1), none, none)


def dry_friction_constraints(term: JointDryFriction, dt: Tensor) -> Constraints:
    """Dry friction of all joints, as the first tangent of a constraint whose normal is never reached: the whole torque against the
    motion, and as much as is needed to hold still."""
    hold = term.torque * dt[..., None]
    rows = hold.new_zeros((hold.shape[-1], 3, hold.shape[-1]))
    rows[:, 1] = torch.eye(hold.shape[-1], dtype=hold.dtype, device=hold.device)
    bias = torch.zeros_like(hold[..., None].expand(*hold.shape, 3))
    bias[..., 0] = torch.inf
    return Constraints(rows, bias, torch.zeros_like(hold), hold)
