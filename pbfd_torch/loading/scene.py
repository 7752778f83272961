"""From a robot to a scene: its terms, and the contacts of its colliders with obstacles and with each other."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Curved
from pbfd_torch.loading.bounds import SLOW_PAIRS, pair_count
from pbfd_torch.loading.report import announced
from pbfd_torch.loading.robot import Robot
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce, default_stiffness
from pbfd_torch.tree.kinematics import place


def robot_scene(
    robot: Robot,
    obstacles: Sequence[HalfSpace | Obstacle] | None = None,
    penetration: float | None = None,
    friction: FrictionLaw | None = None,
) -> Scene:
    """The robot with everything its file asks for, on its own obstacles or on `obstacles`.

    penetration: how deep the whole weight would rest on one point [m] > 0; None: every pair is as firm as its size, the weight and
    the robot's actuators ask for (`firmness`). friction: the law for μ = 1, of which every pair has the file's μ; None: Coulomb's.
    """
    articulation = robot.articulation
    obstacles = robot.obstacles if obstacles is None else tuple(obstacles)
    firm = None if penetration is None else default_stiffness(articulation, penetration)
    terms: list[Term] = [Inertia(), *robot.joint_terms]
    if robot.actuators is not None:
        terms.append(robot.actuators)
    names = {*articulation.link_names, *(x.name for x in obstacles)}
    excluded = [pair for pair in robot.excluded if names.issuperset(pair)]  # others name obstacles of the file that are not here
    rules = ContactRules(firm, excluded=excluded, actuators=robot.actuators)
    if friction is not None:
        rules = dataclasses.replace(rules, friction=friction)
    with announced("contacts", pair_count(robot.colliders, obstacles), SLOW_PAIRS):
        terms += contact_terms(articulation, robot.colliders, obstacles, rules)
    gravity = torch.tensor(robot.gravity, dtype=articulation.dtype, device=articulation.device)
    return Scene(articulation, tuple(terms), gravity, robot.colliders, obstacles, robot.name, robot.visuals)


def ground_below(robot: Robot) -> HalfSpace:
    """Level ground that the robot's lowest collider just touches in the rest configuration; z = 0 for a robot without colliders."""
    articulation = robot.articulation
    if not robot.colliders:
        return HalfSpace()
    at_rest = place(articulation, articulation.rest)
    deepest = -math.inf
    for kind, curved in ((Contact, False), (CurvedContact, True)):
        if some := [x for x in robot.colliders if isinstance(x.shape, Curved) is curved]:
            probe = kind.between(articulation, some, HalfSpace(), NormalForce(1.0))
            deepest = max(deepest, float(probe.depth(at_rest).max()))
    return HalfSpace(offset=-deepest)
