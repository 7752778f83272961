"""Contact between bodies of which one is a cylinder or an ellipsoid: the point that touches moves over it.

It lies beside a plane of the other body, or, where two round bodies touch at one point, where they come closest.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.contact.candidates import Slots
from pbfd_torch.contact.curved_pairs import CurvedSlots
from pbfd_torch.contact.surface import Placed
from pbfd_torch.tensors.vectors import applied, mapped
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.approaching import Approaching, closest_approach
from pbfd_torch.terms.body_contact import BodyContact, PreparedBodyContact, of_slots
from pbfd_torch.terms.load import StepContext
from pbfd_torch.terms.lying import share_of
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.supported import Supported, reaching
from pbfd_torch.tree.kinematics import Placement


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedCurvedBodies(PreparedBodyContact):
    share: Tensor  # [*batch, n] of the normal force that each candidate gives


@dataclass(frozen=True, eq=False, kw_only=True)
class CurvedBodyContact(BodyContact):
    """Attributes: `finder` finds `CurvedSlots`."""

    def recall(self, step: StepContext, memory: Tensor) -> PreparedCurvedBodies:
        """See `ContactLaws`."""
        prepared = super().recall(step, memory)
        slots = prepared.slots
        assert isinstance(slots, CurvedSlots)
        first, second = of_slots(prepared.bodies, slots.first), of_slots(prepared.bodies, slots.second)
        normal = Placed(slots.surface, second).field(mapped(first, slots.position)).direction
        share = share_of(slots.lying, applied(first[..., :3], slots.axis), normal)
        fields = {field.name: getattr(prepared, field.name) for field in dataclasses.fields(prepared)}
        return PreparedCurvedBodies(**fields, share=share)

    def _gaps(self, slots: Slots, bodies: Tensor) -> Tensor:
        assert isinstance(slots, CurvedSlots)
        first, second = of_slots(bodies, slots.first), of_slots(bodies, slots.second)
        field = Placed(slots.surface, second).field(mapped(first, slots.position))
        gap = field.distance - slots.radius - reaching(_form(slots, first), field.direction)
        if slots.meeting is None:
            return gap
        found, _ = closest_approach(slots.meeting, torch.stack((first, second), -3), field.direction)
        return torch.where(slots.meeting.follows, found.gap, gap)

    def pressing(self, prepared: PreparedBodyContact) -> NormalForce:
        """See `ContactLaws`."""
        assert isinstance(prepared, PreparedCurvedBodies)
        law = super().pressing(prepared)
        return replaced(law, stiffness=law.stiffness * prepared.share)

    def touching(self, prepared: PreparedBodyContact, placement: Placement) -> Supported:
        """See `ContactLaws`."""
        at, slots = super().touching(prepared, placement), prepared.slots
        assert isinstance(slots, CurvedSlots)
        bodies = prepared.standing(placement)
        first = of_slots(bodies, slots.first)
        form = _form(slots, first)
        deep = dataclasses.replace(at, depth=torch.where(slots.filled, at.depth + reaching(form, at.normal), at.depth))
        balls = torch.diag_embed(slots.radius.square()[..., None].expand(*slots.radius.shape, 3))
        planes = Supported.of(deep, form + balls)
        if slots.meeting is None:
            return planes
        frames = torch.stack((first, of_slots(bodies, slots.second)), -3)
        return Approaching.beside(planes, slots.meeting, frames, prepared.raised(torch.zeros_like(planes.depth)))


def _form(slots: Slots, first: Tensor) -> Tensor:
    """M in the world `[*batch, n, 3, 3]`, of bodies at `first` `[*batch, n, 3, 4]`."""
    assert isinstance(slots, CurvedSlots)
    turn = first[..., :3]
    return turn @ slots.form @ turn.mT
