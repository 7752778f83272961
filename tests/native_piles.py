"""Piles of bodies that touch each other, and arms that do, for the compiled core to be compared on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Capsule, Collider, ConvexHull, Shape, Sphere
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.rotations import quaternion_exp

WEDGE = ((0.1, 0.08, -0.06), (-0.1, 0.08, -0.06), (0.1, -0.08, -0.06), (-0.1, -0.08, -0.06), (0.1, 0.0, 0.08), (-0.1, 0.0, 0.08))
SHAPES: dict[str, tuple[Shape, ...]] = {
    "round": (Sphere(0.1), Capsule(0.08, 0.12), Capsule(0.1, 0.06)),
    "balls on boxes": (Sphere(0.1), Box((0.12, 0.1, 0.08)), Sphere(0.07)),
    "boxes": (Box((0.12, 0.1, 0.08)), Box((0.08, 0.1, 0.12))),
    "polytopes": (ConvexHull(np.array(WEDGE)), Box((0.12, 0.1, 0.08)), Capsule(0.08, 0.12)),
}
TABLE = Obstacle("table", Box((0.6, 0.6, 0.1)), (0.0, 0.0, -0.1))


def pile(
    shapes: Sequence[Shape],
    friction: FrictionLaw | None = None,
    obstacles: Sequence[HalfSpace | Obstacle] = (HalfSpace(), TABLE),
    dtype: torch.dtype = torch.float64,
) -> Scene:
    """Free bodies and a chain of three links that carries the same shapes."""
    inertia = ((0.01, 0.0, 0.0), (0.0, 0.012, 0.0), (0.0, 0.0, 0.009))
    free = [Link(f"free{k}", joints=(Joint(f"f{k}", JointKind.FREE),), mass=1.0 + k, inertia=inertia) for k in range(len(shapes))]
    arm = [
        Link("arm0", joints=(Joint("turn", JointKind.HINGE, axis=(0.0, 0.0, 1.0)),), mass=1.0, inertia=inertia),
        Link("arm1", "arm0", (0.0, 0.0, 0.3), joints=(Joint("ball", JointKind.BALL),), mass=1.0, inertia=inertia),
        Link(
            "arm2",
            "arm1",
            (0.4, 0.0, 0.0),
            joints=(Joint("slide", JointKind.SLIDE, axis=(1.0, 0.0, 0.0)),),
            mass=0.7,
            inertia=inertia,
        ),
    ]
    articulation = Articulation.from_links([*free, *arm], dtype)
    colliders = [Collider(f"c{k}", f"free{k}", x, (0.02, 0.0, 0.01), friction=0.5 + 0.1 * k) for k, x in enumerate(shapes)]
    colliders += [Collider(f"a{k}", f"arm{k}", x, (0.1, 0.0, 0.0), (0.8, 0.0, 0.6, 0.0)) for k, x in enumerate(shapes[:3])]
    rules = ContactRules(friction=friction or CoulombFriction(1.0))
    terms = contact_terms(articulation, colliders, obstacles, rules)
    gravity = torch.tensor([0.0, 0.0, -9.81], dtype=dtype)
    return Scene(articulation, (Inertia(), *terms), gravity, colliders, tuple(obstacles))


def thrown_together(scene: Scene, worlds: int, seed: int = 0, spread: float = 0.25) -> tuple[Tensor, Tensor]:
    """Configurations in which free bodies lie about the arm, within `spread` [m], and velocities."""
    a = scene.articulation
    random = torch.Generator().manual_seed(seed)

    def drawn(*shape: int) -> Tensor:
        return (2 * torch.rand(*shape, generator=random, dtype=torch.float64) - 1).to(a.dtype)

    q, v = a.rest.repeat(worlds, 1), 0.5 * drawn(worlds, a.nv)
    for first, size in zip(a.topology.q_start, a.topology.joint_sizes, strict=True):
        if size == (7, 6):
            q[:, first : first + 3] = spread * drawn(worlds, 3) + a.rest.new_tensor([0.2, 0.0, 0.05 + spread])
            q[:, first + 3 : first + 7] = quaternion_exp(1.5 * drawn(worlds, 3))
        elif size == (4, 3):
            q[:, first : first + 4] = quaternion_exp(0.5 * drawn(worlds, 3))
        else:
            q[:, first] = 0.1 * drawn(worlds)
    return q, v
