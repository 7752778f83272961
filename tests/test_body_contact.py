"""Contact between bodies: exact Jacobians, action and reaction, who meets whom."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Cylinder, Ellipsoid, Shape, Sphere
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import place
from pbfd_torch.tree.rotations import unskew
from tests.finite_differences import jacobian, relative_error
from tests.random_trees import generator, moved_q
from tests.states import state_of
from tests.term_cases import QUICK, Situation

STICKING = CoulombFriction(1.0, slip_speed=50.0)
SLIDING = CoulombFriction(1.0, slip_speed=1e-4)
SHAPES: dict[str, tuple[Shape, Shape]] = {
    "sphere, sphere": (Sphere(0.2), Sphere(0.15)),
    "sphere, capsule": (Sphere(0.2), Capsule(0.15, 0.3)),
    "capsules": (Capsule(0.15, 0.3), Capsule(0.2, 0.2)),
    "sphere, box": (Sphere(0.2), Box((0.2, 0.3, 0.15))),
    "boxes": (Box((0.2, 0.3, 0.15)), Box((0.25, 0.2, 0.2))),
    "capsule, box": (Capsule(0.15, 0.3), Box((0.25, 0.2, 0.2))),
    "cylinder, box": (Cylinder(0.2, 0.2), Box((0.25, 0.2, 0.2))),
    "box, ellipsoid": (Box((0.25, 0.2, 0.2)), Ellipsoid((0.2, 0.25, 0.15))),
    "cylinder, capsule": (Cylinder(0.2, 0.2), Capsule(0.15, 0.3)),
    "sphere, cylinder": (Sphere(0.2), Cylinder(0.2, 0.2)),
    "ellipsoids": (Ellipsoid((0.2, 0.25, 0.15)), Ellipsoid((0.15, 0.2, 0.25))),
    "ellipsoid, sphere": (Ellipsoid((0.2, 0.25, 0.15)), Sphere(0.2)),
    "ellipsoid, capsule": (Ellipsoid((0.2, 0.25, 0.15)), Capsule(0.15, 0.3)),
    "cylinders": (Cylinder(0.2, 0.3), Cylinder(0.15, 0.3)),
    "cylinder, ellipsoid": (Cylinder(0.2, 0.2), Ellipsoid((0.2, 0.25, 0.15))),
}
APART = {"ellipsoid, capsule": 0.33, "cylinders": 0.33, "cylinder, capsule": 0.33}  # [m] so that nothing is past its middle


def two_arms(shapes: tuple[Shape, Shape], batch: tuple[int, ...], apart: float = 0.3) -> tuple[Situation, list[Collider]]:
    """A free body, and a hinged arm whose second link it meets so far away [m], in the middle of a step; different in every
    world."""
    inertia = ((0.02, 0.0, 0.0), (0.0, 0.03, 0.0), (0.0, 0.0, 0.04))
    links = [
        Link("base", joints=(Joint("swing", JointKind.HINGE, axis=(0.2, 1.0, 0.1)),), mass=1.0, inertia=inertia),
        Link(
            "arm", "base", (0.4, 0.1, 0.0), joints=(Joint("turn", JointKind.BALL),), mass=1.0, com=(0.1, 0.0, 0.0), inertia=inertia
        ),
        Link("free", joints=(Joint("float", JointKind.FREE),), mass=0.7, com=(0.0, 0.02, 0.01), inertia=inertia),
    ]
    articulation = Articulation.from_links(links)
    random = generator(5)
    q = articulation.rest.expand(*batch, -1).clone()
    q = moved_q(articulation, q, 3, 0.3)
    arm = place(articulation, q).poses[..., 1, :3, 3]
    t = articulation.topology
    out = torch.nn.functional.normalize(torch.randn(*batch, 3, dtype=torch.float64, generator=random), dim=-1)
    q[..., t.free_q[0]] = arm + apart * out
    now = moved_q(articulation, q, 4, 0.01)
    before = moved_q(articulation, now, 5, 0.01)
    s = Situation(
        articulation, state_of(now, before), q, torch.tensor(0.02, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), None
    )
    return s, [Collider("one", "arm", shapes[0]), Collider("other", "free", shapes[1], (0.01, 0.0, -0.02), (0.9, 0.1, 0.3, 0.2))]


def contacts(s: Situation, colliders: list[Collider], friction: FrictionLaw | None, release: float = math.inf) -> list[BodyContact]:
    rules = ContactRules(NormalForce(1e4, release=release), friction)
    terms = [term for term in contact_terms(s.articulation, colliders, (), rules) if isinstance(term, BodyContact)]
    return [dataclasses.replace(term, grip=0.7 * torch.ones_like(term.grip), slack=1.0) for term in terms]


@pytest.mark.parametrize(
    ("friction", "release"),
    [(None, math.inf), (STICKING, math.inf), (SLIDING, math.inf), (SLIDING, QUICK)],
    ids=["smooth", "sticking", "sliding", "letting go"],
)
@pytest.mark.parametrize("kind", SHAPES)
def test_jacobian_is_exact(kind: str, friction: FrictionLaw | None, release: float) -> None:
    """J of both bodies and their coupling against central differences of r, in worlds that touch."""
    s, colliders = two_arms(SHAPES[kind], (4,), APART.get(kind, 0.3))
    terms = contacts(s, colliders, friction, release)
    placement = place(s.articulation, s.q)
    depth = torch.cat([term.force(term.prepare(s.context(s.q)), placement).at.depth for term in terms], -1)
    assert bool((depth > 1e-3).any(-1).all())

    def balance(q: Tensor) -> Tensor:
        return s.balance(terms, q).residual

    expected = jacobian(s.articulation, balance, s.q)
    assert relative_error(s.balance(terms, s.q).jacobian, expected, floor=1e-3 * balance(s.q).abs().amax(-1)) <= 1e-7


@pytest.mark.parametrize("kind", SHAPES)
def test_momentum_is_kept(kind: str) -> None:
    """The wrenches about the world's origin sum to zero over the links."""
    s, colliders = two_arms(SHAPES[kind], (4,), APART.get(kind, 0.3))
    placement = place(s.articulation, s.q)
    loads = [term.load(term.prepare(s.context(s.q)), placement) for term in contacts(s, colliders, SLIDING)]
    moment = torch.stack([load.moment for load in loads]).sum(0)
    size = float(moment.abs().max())
    assert size > 1
    assert float(moment[..., 3].sum(-2).abs().max()) <= 1e-13 * size
    assert float(unskew(moment[..., :3]).sum(-2).abs().max()) <= 1e-12 * size


def test_obstacle_as_a_body() -> None:
    """A box against a fixed box: the Jacobian, and nothing but the box feels it."""
    s, colliders = two_arms((Box((0.2, 0.3, 0.15)), Box((0.25, 0.2, 0.2))), (3,))
    arm = place(s.articulation, s.q).poses[..., 1, :, :]
    wall = Obstacle("wall", Box((0.25, 0.2, 0.2)), arm[..., :3, 3] + 0.2)
    (term,) = contact_terms(s.articulation, colliders[:1], (wall,), ContactRules(NormalForce(1e4, release=math.inf), SLIDING))
    expected = jacobian(s.articulation, lambda q: s.balance([term], q).residual, s.q)
    balance = s.balance([term], s.q)
    assert float(balance.residual.abs().max()) > 1
    assert float(balance.residual[..., s.articulation.topology.free_v].abs().max()) == 0
    assert relative_error(balance.jacobian, expected, floor=1e-3 * balance.residual.abs().amax(-1)) <= 1e-7
