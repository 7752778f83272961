"""One body on a plane, and what its contact sees over a step."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Shape
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.contact_laws import ContactPoints
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.load import LinkLoad
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import place
from pbfd_torch.tree.rotations import quaternion_exp
from tests.states import state_of


def one_body(
    shape: Shape, friction: FrictionLaw | None, stiffness: float = 1e6, margin: float = 0.0
) -> tuple[Articulation, Contact]:
    """A free body of 1 kg with one collider at its origin, on the plane z = 0."""
    eye = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))
    articulation = Articulation.from_links([Link("body", joints=(Joint("free", JointKind.FREE),), mass=1.0, inertia=eye)])
    colliders = [Collider("c", "body", shape, margin=margin)]
    return articulation, Contact.between(articulation, colliders, HalfSpace(), NormalForce(stiffness), friction)


def contact_points(
    articulation: Articulation, made: Contact, before: Tensor, after: Tensor, dt: float
) -> tuple[ContactPoints, LinkLoad]:
    """What the contact sees over a step from one configuration to the next."""
    time = torch.tensor(dt, dtype=torch.float64)
    gravity = torch.zeros(3, dtype=torch.float64)
    prepared = made.prepare(ImplicitEuler().context(articulation, state_of(before, before), time, gravity, None))
    placement = place(articulation, after)
    return made.points(prepared, placement), made.load(prepared, placement)


def pose(position: tuple[float, float, float], turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tensor:
    return torch.cat((torch.tensor(position, dtype=torch.float64), quaternion_exp(torch.tensor(turn, dtype=torch.float64))))
