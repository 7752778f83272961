"""Bodies that several hard cases share: one that floats, and one on a plane."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Collider, Shape
from pbfd_torch.models.stacks import solid_box
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.rotations import quaternion_exp

GRAVITY = 9.81
SLIP_SPEED = 1e-3  # ε_v of Coulomb's law [m/s]
STIFFNESS = 1e8  # C⊥ [N/m²]
FLAT = (0.1, 0.1, 0.02)  # half extents [m] of a box that does not tip on any slope here


def row(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def down(slope: Tensor | float = 0.0) -> Tensor:
    """Gravity on a plane that falls off towards +x by `slope` [rad], `[*, 3]`: turned instead of the plane."""
    angle = torch.as_tensor(slope, dtype=torch.float64)
    return GRAVITY * torch.stack((torch.sin(angle), torch.zeros_like(angle), -torch.cos(angle)), -1)


def weightless() -> Tensor:
    return torch.zeros(3, dtype=torch.float64)


def placed(height: float, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tensor:
    """A free body over the origin, turned by a rotation vector, `[7]`."""
    return torch.cat((row(0.0, 0.0, height), quaternion_exp(row(*turn))))


def body(half: tuple[float, float, float], mass: float = 1.0) -> Articulation:
    """A free homogeneous box."""
    return Articulation.from_links([solid_box("body", half, mass)])


def ball(radius: float) -> Articulation:
    """A free homogeneous ball of 1 kg."""
    moment = 0.4 * radius**2
    rows = ((moment, 0.0, 0.0), (0.0, moment, 0.0), (0.0, 0.0, moment))
    return Articulation.from_links([Link("body", joints=(Joint("free", JointKind.FREE),), mass=1.0, inertia=rows)])


def on_plane(
    articulation: Articulation, shape: Shape, friction: FrictionLaw, slope: Tensor | float = 0.0, stiffness: float = STIFFNESS,
    turn: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> Scene:  # fmt: skip
    """The body with one collider over a half-space."""
    colliders = [Collider("shape", "body", shape, quaternion=turn)]
    contact = Contact.between(articulation, colliders, HalfSpace(), NormalForce(stiffness), friction)
    return Scene(articulation, (Inertia(), contact), down(slope), colliders)


def sunk(load: Tensor | float, points: int = 4, stiffness: float = STIFFNESS) -> Tensor:
    """How deep `points` points rest under a load [N], in m."""
    return (torch.as_tensor(load, dtype=torch.float64) / points / stiffness).sqrt()


def box_on_slope(friction: FrictionLaw, slope: Tensor) -> tuple[Scene, Tensor]:
    """A flat box of 1 kg at its rest depth on slopes `[worlds]` [rad], and its start."""
    q = placed(FLAT[2]).repeat(len(slope), 1)
    q[:, 2] -= sunk(GRAVITY * torch.cos(slope))
    return on_plane(body(FLAT), Box(FLAT), friction, slope), q


def coulomb(mu: Tensor | float) -> CoulombFriction:
    """Coulomb's law, μ a number or `[worlds]`."""
    return CoulombFriction(mu[:, None] if isinstance(mu, Tensor) else mu, SLIP_SPEED)


def slide(slope: Tensor, mu: Tensor) -> Tensor:
    """Acceleration of a body that slides down a slope [m/s²]; ≤ 0: it holds."""
    return GRAVITY * (torch.sin(slope) - mu * torch.cos(slope))


def degrees(*angles: float) -> Tensor:
    return row(*(math.radians(x) for x in angles))
