"""What a record lists, as the C++ core sees it: links, slots of contacts, and dangers; and what rides on the world."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.native.aligned import aligned
from pbfd_torch.native.plan import Plan
from pbfd_torch.native.plan_contact import joined
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.load import Hazardous, StepContext
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import place


@dataclass(frozen=True, eq=False)
class Roster:
    """See `pbfd_roster` in src/interface.h; real: `[*, 12 · links + 7]`. still: of the contacts that ride on the world, which never
    change: their slots `[n]`, and what a record has of them, `[*, n]` or `[*, n, 3]`."""

    slots: int
    carrier: Tensor
    slot: Tensor
    danger: Tensor
    first_limit: int
    meeting_slot: Tensor
    meeting_danger: Tensor
    real: Tensor
    still: tuple[Tensor, dict[str, Tensor]]


@torch.no_grad()
def rostered(stepper: EagerStepper[Any], plan: Plan) -> Roster:
    """Of a stepper's scene, with its plan."""
    a = aligned(stepper.articulation)
    carrier = torch.tensor(a.topology.link_node, dtype=torch.int32) - 1
    dangers, order = _dangers(stepper), list(plan.order)
    moment = (a.link_frame @ a.pseudo_inertia)[..., carrier < 0, :3, 3].sum(-2)
    still = _Still(stepper, dangers.of_slots)
    energy = still.energy - (stepper.scene.gravity * moment).sum(-1)
    numbers = (a.mass.sum(-1), moment, energy, still.strain, still.suspect.to(a.dtype))
    return Roster(
        slots=len(dangers.of_slots),
        carrier=carrier,
        slot=torch.tensor(order, dtype=torch.int32),
        danger=torch.tensor([dangers.of_slots[i] for i in order], dtype=torch.int32),
        first_limit=dangers.first_limit,
        meeting_slot=torch.tensor([slot for slot, _ in dangers.meetings], dtype=torch.int32),
        meeting_danger=torch.tensor([danger for _, danger in dangers.meetings], dtype=torch.int32),
        real=joined(a.link_frame[..., :3, :].flatten(-3), *(x if x is moment else x[..., None] for x in numbers)).contiguous(),
        still=(torch.tensor(still.slots, dtype=torch.long), still.seen),
    )


@dataclass(frozen=True)
class _Dangers:
    """The number among the dangers of what is in each slot of candidates (of contact between bodies: of the first pair), and that
    of the first limit; −1: there are no limits. meetings: of each term of contact between bodies its first slot and danger."""

    of_slots: list[int]
    first_limit: int
    meetings: list[tuple[int, int]]


def _dangers(stepper: EagerStepper[Any]) -> _Dangers:
    slots: list[int] = []
    meetings: list[tuple[int, int]] = []
    count, first_limit = 0, -1
    for term in stepper.terms:
        if isinstance(term, Contact):
            slots += range(count, count + len(term.link))
        elif isinstance(term, BodyContact):
            meetings.append((len(slots), count))
            slots += [count] * term.finder.slots
        elif isinstance(term, JointLimits):
            first_limit = count
        if isinstance(term, Hazardous):
            count += len(term.dangers(stepper.articulation))
    return _Dangers(slots, first_limit, meetings)


class _Still:
    """The contacts that ride on the world: their slots and what is seen of them, `[*, n, …]`; the energy [J] that they store
    together, and of the one that is deepest beyond its measure how far, and its number among the dangers, `[*]` each."""

    def __init__(self, stepper: EagerStepper[Any], dangers: list[int]) -> None:
        a = stepper.articulation
        step = _resting(stepper, a)
        self.slots: list[int] = []
        self.energy = a.rest.new_zeros(())
        parts: dict[str, list[Tensor]] = {name: [a.rest.new_zeros((0, *event))] for name, event in CONTACT.items()}
        shares = [a.rest.new_tensor([-math.inf])]  # of none
        first = 0
        for term in stepper.terms:
            if isinstance(term, BodyContact):
                first += term.finder.slots
            if not isinstance(term, Contact):
                continue
            here = [i for i, link in enumerate(term.link.tolist()) if a.topology.link_node[link] == 0]
            if here:
                prepared = term.prepare(step)
                points = term.points(prepared, step.previous)
                for name, event in CONTACT.items():
                    values = getattr(points, name.removeprefix("contact_"))  # all slips are zero
                    parts[name].append(values.movedim(-1 - len(event), 0)[here].movedim(0, -1 - len(event)))
                force, depth = parts["contact_force"][-1], parts["contact_depth"][-1]
                work = (torch.linalg.vector_norm(force, dim=-1) * depth.clamp_min(0)).sum(-1)
                self.energy = self.energy + work / (term.normal_force.exponent + 1)
                turned = torch.zeros(a.topology.nlink, dtype=torch.bool)
                shares.append(term.strain(prepared, step.previous, turned)[0][..., here])
            self.slots += [first + i for i in here]
            first += len(term.link)
        share = joined(*shares)
        worst = share.argmax(-1, keepdim=True)
        self.strain = share.gather(-1, worst).squeeze(-1)
        self.suspect = torch.tensor([0, *(dangers[slot] for slot in self.slots)])[worst.squeeze(-1)]
        self.seen = {name: joined(*values, dim=-1 - len(CONTACT[name])) for name, values in parts.items()}


CONTACT = {"contact_depth": (), **dict.fromkeys(("contact_point", "contact_normal", "contact_force", "contact_slip"), (3,))}


def _resting(stepper: EagerStepper[Any], a: Articulation) -> StepContext:
    """A step in which nothing moves."""
    at, dt = place(a, a.rest), stepper.step_size
    return StepContext(
        dt=dt,
        previous=at,
        weight=1 / (dt * dt),
        target_poses=at.poses,
        target_q=a.rest,
        control=None,
        time=torch.zeros_like(dt),
        gravity=stepper.scene.gravity,
    )
