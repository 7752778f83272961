"""Free bodies that touch the ground and each other, for tests."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Collider, Shape
from pbfd_torch.models.stacks import solid_box
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.rotations import quaternion_exp
from tests.bodies import down

STIFFNESS = 1e8  # C⊥ [N/m²]
SLIP_SPEED = 1e-3  # ε_v [m/s]
Pose = tuple[float, ...]  # x, y, z [m], and a rotation vector unless the body stands upright


def free_bodies(
    shapes: Sequence[Shape],
    masses: Sequence[float],
    obstacles: Sequence[HalfSpace | Obstacle] = (HalfSpace(),),
    mu: float = 0.5,
    gravity: Tensor | None = None,
) -> Scene:
    """Free bodies with one shape each, with the inertia of the boxes around them."""
    links = []
    for k, (shape, mass) in enumerate(zip(shapes, masses, strict=True)):
        centers, radii = shape.candidates()
        x, y, z = (abs(centers) + radii[:, None]).max(0).clip(1e-3).tolist()
        links.append(solid_box(f"body{k}", (x, y, z), mass))
    articulation = Articulation.from_links(links)
    colliders = [Collider(link.name, link.name, shape) for link, shape in zip(links, shapes, strict=True)]
    rules = ContactRules(NormalForce(STIFFNESS), CoulombFriction(mu, SLIP_SPEED))
    terms = contact_terms(articulation, colliders, obstacles, rules)
    return Scene(articulation, (Inertia(), *terms), down() if gravity is None else gravity, colliders)


def posed(*poses: Pose) -> Tensor:
    """Configuration `[1, nq]` of free bodies."""
    numbers = torch.tensor([(*p, 0.0, 0.0, 0.0)[:6] for p in poses], dtype=torch.float64)
    return torch.cat((numbers[:, :3], quaternion_exp(numbers[:, 3:])), -1).reshape(1, -1)


def stored(rollout: Rollout, first: int) -> Tensor:
    """Energy C⊥ d³/3 of the recorded contacts from the `first` on, those between bodies, which a rollout's own energy lacks
    [J] `[T, *batch]`: it is known of the steps' contacts, and not of a state."""
    return STIFFNESS / 3 * (rollout.contact_depth[..., first:].clamp_min(0) ** 3).sum(-1)
