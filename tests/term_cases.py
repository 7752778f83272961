"""Every term in a random situation, for the tests that all terms must pass. A new term: append one case."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Curved, Cylinder, Ellipsoid, Point, Shape, Sphere
from pbfd_torch.contact.surface import Plane
from pbfd_torch.integrators.implicit_euler import ImplicitEuler, Positions
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.load import LinkLoad, StepContext, Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbd_friction import PbdFriction
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.terms.static_friction import StaticFriction
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Placement, place
from tests.random_trees import generator, moved_q, random_q, random_tree
from tests.states import state_of

QUICK = 50.0  # [m/s] at which contacts let go where bodies are thrown about at random
NORMAL = (0.3, -0.5, 1.1)  # of the ground; scaled to unit length by HalfSpace


@dataclass(frozen=True, eq=False)
class Situation:
    """A tree in the middle of a step: where it was (θ_{n−1}, θ_n), and the iterate q at which terms are asked for their load."""

    articulation: Articulation
    state: Positions
    q: Tensor
    dt: Tensor
    gravity: Tensor
    control: Tensor | None

    def context(self, q: Tensor) -> StepContext:
        """The step's context for worlds like those of q, which may have further leading dimensions."""
        state = state_of(self.state.q.expand_as(q), self.state.q_previous.expand_as(q))
        control = self.control if self.control is None else self.control.expand(*q.shape[:-1], self.control.shape[-1])
        return ImplicitEuler().context(self.articulation, state, self.dt, self.gravity, control)

    def balance(self, terms: Sequence[Term], q: Tensor) -> Balance:
        """Residual and Jacobian of the terms alone: a link load of zero goes with them, as the assembly needs one."""
        context, placement = self.context(q), place(self.articulation, q)
        loads = [term.load(term.prepare(context), placement) for term in terms]
        return Balance(placement, [no_load(placement), *loads])


def no_load(placement: Placement) -> LinkLoad:
    """Zero forces on all links."""
    zero = torch.zeros_like(placement.poses[..., :3, :])
    return LinkLoad(zero, lambda: zero.new_zeros((*zero.shape[:-2], 6, 6)))


def situation(seed: int, batch: tuple[int, ...] = (), turn: float = 0.1) -> Situation:
    """A random tree in random motion, a third of its hinges and slides below their range and a third above it, and a control for
    six actuators. turn: how far each degree of freedom moves over the step, roughly [rad or m]."""
    random = generator(3000 + seed)
    articulation = random_tree(seed)
    q = random_q(articulation, seed, batch)
    now = moved_q(articulation, q, seed, turn)
    before = moved_q(articulation, now, seed + 1, turn)
    x = articulation.topology.scalar_v
    lower, upper = articulation.lower.expand(*batch, -1).clone(), articulation.upper.expand(*batch, -1).clone()
    side = torch.arange(len(x)) % 3
    gap = 0.1 + torch.rand(*batch, len(x), dtype=torch.float64, generator=random)
    centre = q[..., articulation.topology.scalar_q]
    lower[..., x] = torch.where(side == 0, centre + gap, centre - 3 * gap)
    upper[..., x] = torch.where(side == 1, centre - gap, centre + 3 * gap)
    return Situation(
        dataclasses.replace(articulation, lower=lower, upper=upper),
        state_of(now, before),
        q,
        torch.tensor(0.02, dtype=torch.float64),
        torch.tensor([0.4, -0.2, -9.81], dtype=torch.float64),
        torch.randn(*batch, 6, dtype=torch.float64, generator=random),
    )


def colliders_of(articulation: Articulation, shapes: Sequence[Shape], margin: float = 0.0) -> list[Collider]:
    """One collider on every link that can move, the shapes in turn, at random places."""
    random = generator(7)
    colliders = []
    movable = [name for name, node in zip(articulation.link_names, articulation.topology.link_node, strict=True) if node]
    for k, link in enumerate(movable):
        x, y, z = (0.1 * torch.randn(3, dtype=torch.float64, generator=random)).tolist()
        turn = torch.randn(4, dtype=torch.float64, generator=random)
        a, b, c, d = (turn / torch.linalg.vector_norm(turn)).tolist()
        colliders.append(Collider(f"collider{k}", link, shapes[k % len(shapes)], (x, y, z), (a, b, c, d), margin=margin))
    return colliders


def contact(
    s: Situation,
    friction: FrictionLaw | None,
    exponent: float = 2.0,
    shapes: Sequence[Shape] = (Point(),),
    margin: float = 0.0,
    release: float = math.inf,
) -> Contact:
    """Contact with a tilted plane that about half of the candidates have pierced, none being closer to it than necessary."""
    colliders = colliders_of(s.articulation, shapes, margin)
    kind = CurvedContact if isinstance(shapes[0], Curved) else Contact
    made = kind.between(s.articulation, colliders, HalfSpace(normal=NORMAL), NormalForce(1e4, exponent, release), friction)
    depth = made.depth(place(s.articulation, s.q))
    ordered = depth.sort(-1).values
    quarter = depth.shape[-1] // 4
    gaps = ordered.diff(dim=-1)[..., quarter : depth.shape[-1] - quarter]
    at = gaps.argmax(-1, keepdim=True) + quarter
    middle = 0.5 * (ordered.gather(-1, at) + ordered.gather(-1, at + 1))
    return raised(made, -middle)


def raised(made: Contact, height: Tensor) -> Contact:
    """A contact with a half-space whose surface is moved by a height `[*batch, 1]` along its normal."""
    assert isinstance(made.surface, Plane)
    return dataclasses.replace(made, surface=Plane(made.surface.normal, made.surface.offset + height))


def actuators(s: Situation) -> Actuators:
    """Six actuators: two motors, one of them past its effort; two position and two velocity servos, one of each past its effort.
    Two of them drive one joint."""
    names = [s.articulation.joint_names[int(j)] for j in s.articulation.topology.scalar_joint]
    return Actuators.from_list(
        s.articulation,
        [
            Actuator.motor("motor", names[0], gear=2.0),
            Actuator.motor("weak motor", names[1], effort=1e-3),
            Actuator("position", names[2], gear=-1.5, gain=30.0, bias=0.2, stiffness=30.0, damping=2.0),
            Actuator.position("weak position", names[3], kp=3000.0, kv=20.0, effort=0.1),
            Actuator("velocity", names[0], gear=0.5, gain=4.0, damping=4.0),
            Actuator.velocity("weak velocity", names[4], kv=400.0, effort=0.1),
        ],
    )


def pushes(s: Situation) -> Pushes:
    """A random force of some newtons at a random point of every link."""
    force, point = torch.randn((2, s.articulation.nlink, 3), generator=generator(71), dtype=torch.float64)
    return Pushes(5 * force, 0.1 * point)


def coefficients(s: Situation, size: float) -> Tensor:
    """Random `[nv]` > 0, equal about the three axes of a rotation and along those of a translation."""
    value = size * (0.5 + torch.rand(s.articulation.nv, dtype=torch.float64, generator=generator(11)))
    for rows in (s.articulation.topology.turning_v, s.articulation.topology.free_v):
        value[rows] = value[rows[:, :1]].expand_as(rows)
    return value


def dry_torque(s: Situation) -> Tensor:
    """Dry friction of hinges and slides, `[nv]`."""
    torque = torch.zeros(s.articulation.nv, dtype=torch.float64)
    torque[s.articulation.topology.scalar_v] = coefficients(s, 2.0)[s.articulation.topology.scalar_v]
    return torque


@dataclass(frozen=True)
class TermCase:
    """`build` makes the term for a situation. `stores`: its method that gives the energy, "energy" or "potential", or ""."""

    name: str
    build: Callable[[Situation], Term]
    stores: str = ""

    def __str__(self) -> str:
        return self.name


ROUND = (Sphere(0.1), Capsule(0.05, 0.2))
CURVED = (Cylinder(0.1, 0.05), Ellipsoid((0.1, 0.2, 0.05)))
STICKING = CoulombFriction(0.7, slip_speed=50.0)  # one metre of slip over a step of .02 s: all slips are far below
SLIDING = CoulombFriction(0.7, slip_speed=1e-4)  # two micrometres: all slips are far above
WEAKENING = StaticFriction(0.7, 0.4, slip_speed=1e-4, stribeck_speed=10.0)  # falls over some decimetres

CONTACTS = (
    TermCase("contact, α = 2", lambda s: contact(s, None), "potential"),
    TermCase("contact, α = 2.5", lambda s: contact(s, None, 2.5), "potential"),
    TermCase("contact, round", lambda s: contact(s, None, shapes=ROUND), "potential"),
    TermCase("contact, point with margin", lambda s: contact(s, None, margin=0.07), "potential"),
    TermCase("contact, letting go", lambda s: contact(s, None, release=QUICK), "energy"),
    TermCase("contact, α = 3, round, letting go", lambda s: contact(s, None, 3.0, ROUND, release=QUICK), "energy"),
    TermCase("Coulomb, sliding, letting go", lambda s: contact(s, SLIDING, release=QUICK)),
    TermCase("Coulomb, sticking", lambda s: contact(s, STICKING)),
    TermCase("Coulomb, sliding", lambda s: contact(s, SLIDING)),
    TermCase("Coulomb, sticking, α = 2.5", lambda s: contact(s, STICKING, 2.5)),
    TermCase("Coulomb, sliding, margin", lambda s: contact(s, SLIDING, margin=0.07)),
    TermCase("Coulomb, sticking, boxes", lambda s: contact(s, STICKING, shapes=(Box((0.1, 0.2, 0.05)),))),
    TermCase("Coulomb, sliding, boxes", lambda s: contact(s, SLIDING, shapes=(Box((0.1, 0.2, 0.05)),))),
    TermCase("Coulomb, sticking, rolling", lambda s: contact(s, STICKING, shapes=ROUND)),
    TermCase("Coulomb, sliding, rolling", lambda s: contact(s, SLIDING, shapes=ROUND)),
    TermCase("Coulomb, sliding, all shapes", lambda s: contact(s, SLIDING, shapes=(*ROUND, Point(), Box((0.1, 0.2, 0.05))))),
    TermCase("contact, α = 3, curved", lambda s: contact(s, None, 3.0, CURVED), "energy"),
    TermCase("contact, curved, margin, letting go", lambda s: contact(s, None, 3.0, CURVED, 0.03, QUICK), "energy"),
    TermCase("Coulomb, sticking, curved", lambda s: contact(s, STICKING, shapes=CURVED)),
    TermCase("Coulomb, sliding, curved", lambda s: contact(s, SLIDING, shapes=CURVED)),
    TermCase("PBFD as printed, curved", lambda s: contact(s, PbfdFriction.as_printed(5e4), shapes=CURVED)),
    TermCase("PBFD as printed", lambda s: contact(s, PbfdFriction.as_printed(5e4))),
    TermCase("PBFD as derived", lambda s: contact(s, PbfdFriction.as_derived(5e4))),
    TermCase("PBFD as printed, β = .5, γ = 1.5", lambda s: contact(s, PbfdFriction.as_printed(5e4, 0.5, 1.5))),
    TermCase("PBFD as derived, β = 2, γ = .5", lambda s: contact(s, PbfdFriction.as_derived(5e4, 2.0, 0.5), 2.5)),
    TermCase("PBFD as printed, rolling", lambda s: contact(s, PbfdFriction.as_printed(5e4), shapes=ROUND)),
    TermCase("PBD", lambda s: contact(s, PbdFriction(5e4))),
    TermCase("PBD, β = 2, γ = 1.5", lambda s: contact(s, PbdFriction(5e4, 2.0, 1.5), 2.5)),
    TermCase("PBD, rolling", lambda s: contact(s, PbdFriction(5e4), shapes=ROUND)),
    TermCase("static, sticking", lambda s: contact(s, StaticFriction(0.7, 0.4, slip_speed=50.0))),
    TermCase("static, weakening", lambda s: contact(s, WEAKENING)),
    TermCase("static, weakening, rolling", lambda s: contact(s, WEAKENING, shapes=ROUND)),
    TermCase("anchored, sticking", lambda s: contact(s, AnchoredFriction(0.7, stretch=1.0))),
    TermCase("anchored, sliding, rolling", lambda s: contact(s, AnchoredFriction(0.7, stretch=1e-6), shapes=ROUND)),
)
TERMS = (
    TermCase("inertia", lambda s: Inertia(), "energy"),
    *CONTACTS,
    TermCase("joint limits", lambda s: JointLimits(coefficients(s, 50.0), math.inf), "potential"),
    TermCase("joint limits, letting go", lambda s: JointLimits(coefficients(s, 50.0), QUICK), "energy"),
    TermCase("joint damping", lambda s: JointDamping(coefficients(s, 1.0)), "energy"),
    TermCase("armature", lambda s: Armature(coefficients(s, 0.1)), "energy"),
    TermCase("joint springs", lambda s: JointSprings(coefficients(s, 20.0), random_q(s.articulation, 17)), "potential"),
    TermCase("joint dry friction, sticking", lambda s: JointDryFriction(dry_torque(s), slip_speed=50.0)),
    TermCase("joint dry friction, sliding", lambda s: JointDryFriction(dry_torque(s), slip_speed=1e-4)),
    TermCase("pushes", pushes, "energy"),
    TermCase("actuators", actuators),
)
