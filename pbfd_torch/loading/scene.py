"""From a robot to a scene: its terms, and contact of its colliders with flat obstacles."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider
from pbfd_torch.kinematics import place
from pbfd_torch.loading.robot import Robot
from pbfd_torch.simulator import Scene
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce


def robot_scene(robot: Robot, obstacles: Sequence[HalfSpace] | None = None, penetration: float = 1e-3) -> Scene:
    """The robot with everything its file asks for, on its own obstacles or on `obstacles`.

    C⊥ is chosen so that the whole weight on one point would rest `penetration` [m] deep; friction is Coulomb's, μ from the file."""
    articulation = robot.articulation
    obstacles = robot.obstacles if obstacles is None else tuple(obstacles)
    weight = float(articulation.mass.sum()) * max(1.0, sum(x * x for x in robot.gravity) ** 0.5)
    terms: list[Term] = [Inertia(), *robot.joint_terms]
    if robot.actuators is not None:
        terms.append(robot.actuators)
    for obstacle in obstacles:
        touching = [c for c in robot.colliders if touch(c, obstacle)]
        if touching:
            mu = [friction_between(c, obstacle) for c in touching for _ in c.shape.candidates()[1]]
            friction = CoulombFriction(torch.tensor(mu, dtype=articulation.dtype, device=articulation.device))
            terms.append(Contact.between(articulation, touching, obstacle, NormalForce.for_weight(weight, penetration), friction))
    gravity = torch.tensor(robot.gravity, dtype=articulation.dtype, device=articulation.device)
    return Scene(articulation, tuple(terms), gravity, robot.colliders, obstacles, robot.name)


def touch(a: Collider | HalfSpace, b: Collider | HalfSpace) -> bool:
    """Whether two things collide by their groups and masks (MuJoCo's contype and conaffinity)."""
    return bool((a.group & b.mask) or (b.group & a.mask))


def friction_between(a: Collider | HalfSpace, b: Collider | HalfSpace) -> float:
    """μ of a pair: that of the higher priority, else the larger one; 0 where all that decide are frictionless (MuJoCo's rule)."""
    highest = max(a.priority, b.priority)
    deciding = [x for x in (a, b) if x.priority == highest]
    return 0.0 if all(x.frictionless for x in deciding) else max(x.friction for x in deciding)


def ground_below(robot: Robot) -> HalfSpace:
    """Level ground that the robot's lowest collider just touches in the rest configuration; z = 0 for a robot without colliders."""
    articulation = robot.articulation
    if not robot.colliders:
        return HalfSpace()
    probe = Contact.between(articulation, robot.colliders, HalfSpace(), NormalForce(1.0), None)
    depth = probe.depth(place(articulation, articulation.rest))
    return HalfSpace(offset=-float(depth.max()))
