"""What a record lists, as the C++ core sees it: links, slots of contacts, and dangers; and what rides on the world."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.native.aligned import aligned
from pbfd_torch.native.plan import Plan
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.load import Hazardous, StepContext
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import place


@dataclass(frozen=True, eq=False)
class Roster:
    """See `pbfd_roster` in src/interface.h. still: of the contacts that ride on the world, which never change: their slots `[n]`,
    and what a record has of them, `[n]` or `[n, 3]`."""

    slots: int
    carrier: Tensor
    slot: Tensor
    danger: Tensor
    frame: Tensor
    mass: Tensor
    first_limit: int
    still_moment: Tensor
    still_energy: Tensor
    still_strain: Tensor
    still_suspect: int
    still: tuple[Tensor, dict[str, Tensor]]


@torch.no_grad()
def rostered(stepper: EagerStepper[Any], plan: Plan) -> Roster:
    """Of a stepper's scene, with its plan."""
    a = aligned(stepper.articulation)
    carrier = torch.tensor(a.topology.link_node, dtype=torch.int32) - 1
    dangers, first_limit = _dangers(stepper)
    moment = (a.link_frame @ a.pseudo_inertia)[carrier < 0][:, :3, 3].sum(0)
    still = _Still(stepper, dangers)
    return Roster(
        slots=len(dangers),
        carrier=carrier,
        slot=torch.tensor(plan.order, dtype=torch.int32),
        danger=torch.tensor([dangers[i] for i in plan.order], dtype=torch.int32),
        frame=a.link_frame[:, :3].contiguous(),
        mass=a.mass.sum().reshape(1),
        first_limit=first_limit,
        still_moment=moment,
        still_energy=(still.energy - (stepper.scene.gravity * moment).sum()).reshape(1),
        still_strain=a.rest.new_tensor([still.strain]),
        still_suspect=still.suspect,
        still=(torch.tensor(still.slots, dtype=torch.long), still.seen),
    )


def _dangers(stepper: EagerStepper[Any]) -> tuple[list[int], int]:
    """The number among the dangers of what is in each slot, and that of the first limit; −1: there are no limits."""
    slots: list[int] = []
    count, first_limit = 0, -1
    for term in stepper.terms:
        if isinstance(term, Contact):
            slots += range(count, count + len(term.link))
        elif isinstance(term, JointLimits):
            first_limit = count
        if isinstance(term, Hazardous):
            count += len(term.dangers(stepper.articulation))
    return slots, first_limit


class _Still:
    """The contacts that ride on the world: their slots and what is seen of them, the energy [J] that they store together, and of
    the one that is deepest beyond its measure how far, and its number among the dangers."""

    def __init__(self, stepper: EagerStepper[Any], dangers: list[int]) -> None:
        a = stepper.articulation
        step = _resting(stepper, a)
        self.slots: list[int] = []
        self.energy, self.strain, self.suspect = a.rest.new_zeros(()), -math.inf, 0
        parts: dict[str, list[Tensor]] = {name: [a.rest.new_zeros((0, *event))] for name, event in CONTACT.items()}
        first = 0
        for term in stepper.terms:
            if not isinstance(term, Contact):
                continue
            here = [i for i, link in enumerate(term.link.tolist()) if a.topology.link_node[link] == 0]
            if here:
                prepared = term.prepare(step)
                points = term.points(prepared, step.previous)
                for name, event in CONTACT.items():
                    values = getattr(points, name.removeprefix("contact_"))
                    parts[name].append(values.reshape(-1, len(term.link), *event)[0, here])  # of one world: all slips are zero
                force, depth = parts["contact_force"][-1], parts["contact_depth"][-1]
                self.energy = self.energy + (torch.linalg.vector_norm(force, dim=-1) * depth.clamp_min(0)).sum() / 3
                turned = torch.zeros(a.topology.nlink, dtype=torch.bool)
                share = term.strain(prepared, step.previous, turned)[0].reshape(-1, len(term.link))[0]
                for i in here:
                    if float(share[i]) > self.strain:
                        self.strain, self.suspect = float(share[i]), dangers[first + i]
            self.slots += [first + i for i in here]
            first += len(term.link)
        self.seen = {name: torch.cat(values) for name, values in parts.items()}


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
