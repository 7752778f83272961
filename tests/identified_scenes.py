"""Scenes whose numbers the tests of system identification look for."""

from __future__ import annotations

import torch

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Sphere
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_springs import JointDamping
from pbfd_torch.terms.normal_force import NormalForce

HALF = (0.15, 0.12, 0.1)  # half extents of the box [m]
ROUNDING = 0.01  # of its corners [m]
MU = "terms.1.friction.mu"
DAMPING, GAIN, STIFFNESS = "terms.1.damping", "terms.2.gain", "terms.2.stiffness"
GRAVITY = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)


def pushed_box(mass: float, com: tuple[float, float, float], mu: float) -> Scene:
    """A box on level ground; the controls are the force [N] that holds and throws it at the middle of its hull, in world axes."""
    x, y, z = (2 * h for h in HALF)
    rows = ((y * y + z * z, 0.0, 0.0), (0.0, x * x + z * z, 0.0), (0.0, 0.0, x * x + y * y))
    inertia = tuple((mass / 12 * a, mass / 12 * b, mass / 12 * c) for a, b, c in rows)
    along = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    joints = [*(Joint(name, JointKind.SLIDE, axis) for name, axis in along.items()), Joint("turn", JointKind.BALL)]
    articulation = Articulation.from_links([Link("box", joints=tuple(joints), mass=mass, com=com, inertia=inertia)])
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).tolist()
    colliders = [
        Collider(
            f"corner_{k}", "box", Sphere(ROUNDING), (i * (HALF[0] - ROUNDING), j * (HALF[1] - ROUNDING), h * (HALF[2] - ROUNDING))
        )
        for k, (i, j, h) in enumerate(signs)
    ]
    contact = Contact.between(
        articulation, colliders, HalfSpace(), NormalForce.for_weight(20.0, 2e-3), CoulombFriction(mu, slip_speed=0.01)
    )
    push = Actuators.from_list(articulation, [Actuator.motor(name, name) for name in along])
    return Scene(articulation, (Inertia(), contact, push), GRAVITY, colliders, (HalfSpace(),), "pushed-box")


def servo_arm(damping: tuple[float, float], gain: float) -> Scene:
    """Two links that swing in a vertical plane; a servo holds the elbow."""
    links = [
        Link(
            name,
            parent,
            position=(0.0, 0.0, -length),
            joints=(Joint(joint, JointKind.HINGE, (0.0, 1.0, 0.0)),),
            mass=1.0,
            com=(0.0, 0.0, -0.2),
            inertia=((0.013, 0.0, 0.0), (0.0, 0.013, 0.0), (0.0, 0.0, 0.001)),
        )
        for name, parent, joint, length in (("upper", "", "shoulder", 0.0), ("fore", "upper", "elbow", 0.4))
    ]
    articulation = Articulation.from_links(links)
    servo = Actuators.from_list(articulation, [Actuator.position("servo", "elbow", gain)])
    return Scene(
        articulation, (Inertia(), JointDamping(torch.tensor(damping, dtype=torch.float64)), servo), GRAVITY, name="servo-arm"
    )
