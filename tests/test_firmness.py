"""How firm contacts and limits are by default: what presses them the hardest makes a small dent, whatever the scene."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Point, Sphere
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.contact_laws import ContactLaws
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.firmness import DEEPEST, DEEPEST_BALL, LEAPING, RESTING, Meeting, side_of
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_limits import HELD, JointLimits
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.tree.articulation import force_scale
from pbfd_torch.tree.kinematics import place
from tests.bodies import GRAVITY, diagonal, down

INERTIA = diagonal(1e-4, 1e-4, 1e-4)


def doubles(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def two_links(base: Joint) -> Articulation:
    """A base and an arm of 1 kg each, the arm's hinge .3 m from the base's frame."""
    links = [
        Link("base", joints=(base,), mass=1.0, inertia=INERTIA),
        Link(
            "arm",
            parent="base",
            position=(0.3, 0, 0),
            joints=(Joint("elbow", JointKind.HINGE, (0, 1, 0)),),
            mass=1.0,
            inertia=INERTIA,
        ),
    ]
    return Articulation.from_links(links)


@pytest.mark.parametrize(
    ("half", "ball", "depth"),
    [(0.01, False, RESTING * 0.01), (1.0, False, DEEPEST), (1.0, True, DEEPEST_BALL), (math.inf, False, DEEPEST)],
)
def test_the_weight_rests_where_it_should(half: float, ball: bool, depth: float) -> None:
    """C⊥ d² is the weight at the depth that is meant, a share of the thinner body or a millimetre."""
    stiffness = Meeting(half, ball, 0.0, 0.0).stiffness(doubles(20.0))
    torch.testing.assert_close(stiffness * depth**2, doubles(20.0), rtol=1e-12, atol=0)


def test_what_lasts_and_what_does_not() -> None:
    """A force that lasts rests as deep as the weight; a leap may be deeper, and counts only where it asks for more."""
    weight, half = doubles(20.0), 0.01
    lasting = Meeting(half, False, 200.0, 0.0).stiffness(weight)
    torch.testing.assert_close(lasting * (RESTING * half) ** 2, doubles(220.0), rtol=1e-12, atol=0)
    leaping = Meeting(half, False, 0.0, 5000.0).stiffness(weight)
    torch.testing.assert_close(leaping * (LEAPING * half) ** 2, doubles(5020.0), rtol=1e-12, atol=0)
    assert Meeting(half, False, 0.0, 50.0).stiffness(weight).tolist() == Meeting(half, False, 0.0, 0.0).stiffness(weight).tolist()


def test_pressure_through_a_lever() -> None:
    """A slide presses with its force, a hinge with its torque over the distance to the farthest point; the strongest counts. It can
    go on with it where every joint is driven; what nothing bounds cannot be reckoned with."""
    a = two_links(Joint("slide", JointKind.SLIDE, (1, 0, 0)))
    shape = Sphere(0.05)
    side = side_of(a, (3.0, 10.0), 1, shape, 0.25)
    assert (side.force, side.held, side.half) == (10.0 / 0.25, True, 0.05)
    assert side_of(a, (60.0, 10.0), 1, shape, 0.25).force == 60.0
    assert side_of(a, (0.0, 10.0), 1, shape, 0.25).held is False
    unbounded = side_of(a, (math.inf, 10.0), 1, shape, 0.25)
    assert (unbounded.force, unbounded.held) == (40.0, True)
    turning = two_links(Joint("shoulder", JointKind.HINGE, (0, 1, 0)))
    assert side_of(turning, (55.0, 0.0), 1, shape, 0.25).force == pytest.approx(55.0 / 0.55)
    assert side_of(turning, (55.0, 0.0), 0, shape, 0.05).force == pytest.approx(55.0 / 0.05)


@pytest.mark.parametrize(
    ("actuator", "largest"),
    [
        (Actuator("a", "elbow", gear=5.0, control_range=(-2.0, 3.0)), 15.0),
        (Actuator.motor("a", "elbow", gear=5.0, effort=2.0), 10.0),
        (Actuator("a", "elbow", gear=5.0, control_range=(-2.0, 3.0), force_range=(-1.0, 1.0)), 5.0),
        (Actuator("a", "elbow", gain=0.0, bias=4.0), 4.0),
        (Actuator("a", "elbow", gain=10.0, stiffness=10.0, control_range=(-1.0, 1.0)), 10.0 + 10.0 * 0.5),
        (Actuator.motor("a", "elbow"), math.inf),
        (Actuator.position("a", "elbow", kp=10.0), math.inf),
    ],
)
def test_largest_force_of_an_actuator(actuator: Actuator, largest: float) -> None:
    """Whatever bounds it: control range, force range, and what its joint's limits allow a spring to pull."""
    elbow = Joint("elbow", JointKind.HINGE, (0, 1, 0), lower=-0.5, upper=0.2)
    a = Articulation.from_links([Link("arm", joints=(elbow,), mass=1.0, inertia=INERTIA)])
    found = Actuators.from_list(a, [actuator])
    assert found.largest(a).tolist() == [largest]
    assert found.efforts(a) == [largest]


def test_points_have_no_thickness_that_counts() -> None:
    """A body of points alone rests a millimetre deep, as it always did."""
    a = Articulation.from_links([Link("body", joints=(Joint("free", JointKind.FREE),), mass=2.0, inertia=INERTIA)])
    (term,) = contact_terms(a, [Collider("tip", "body", Point())], [HalfSpace()])
    assert isinstance(term, ContactLaws)
    assert term.firm is not None
    torch.testing.assert_close(term.firm, torch.ones_like(term.firm), rtol=1e-12, atol=0)


def test_a_force_of_somebodys_choice_stays() -> None:
    """Whoever gives C⊥ gets it for all pairs."""
    a = two_links(Joint("free", JointKind.FREE))
    rules = ContactRules(NormalForce(1e5))
    (term,) = contact_terms(a, [Collider("tip", "arm", Sphere(0.01))], [HalfSpace()], rules)
    assert isinstance(term, ContactLaws)
    assert term.firm is None
    assert term.normal_force.stiffness == 1e5


def test_laws_that_go_by_the_depth_are_as_firm() -> None:
    """Four times as firm and half as deep: the same normal force and the same friction, with the paper's law too."""
    a = Articulation.from_links([Link("body", joints=(Joint("free", JointKind.FREE),), mass=2.0, inertia=INERTIA)])
    contact = Contact.between(a, [Collider("tip", "body", Point())], HalfSpace(), None, PbfdFriction.as_derived(1e7))
    firm = dataclasses.replace(contact, firm=doubles(4.0))
    simulator = Simulator(Scene(a, (Inertia(), contact), down()), 0.01)
    forces = []
    for term, depth in ((contact, 1e-3), (firm, 5e-4)):
        q = a.rest[None].clone()
        q[0, 2] = -depth
        prepared = term.prepare(simulator.objective(simulator.initial_state(q)).step)
        q[0, 0] = 1e-3  # it has slipped by a millimetre
        forces.append(term.force(prepared, place(a, q)).force)
    assert bool((forces[0][..., 0] < 0).all())
    torch.testing.assert_close(forces[1], forces[0], rtol=1e-9, atol=0)


def rod_between_fingers(force: float, dt: float) -> Rollout:
    """Pads of 50 g on slides hold a rod of 1 cm and 45 g between them."""
    fingers = [
        Link(name, position=(x, 0, 0.3), joints=(Joint(f"slide {name}", JointKind.SLIDE, (-x, 0, 0)),), mass=0.05, inertia=INERTIA)
        for name, x in (("left", -0.012), ("right", 0.012))
    ]
    inertia = diagonal(1.4e-5, 1.4e-5, 6e-7)
    rod = Link("rod", position=(0, 0, 0.3), joints=(Joint("free", JointKind.FREE),), mass=0.045, inertia=inertia)
    a = Articulation.from_links([*fingers, rod])
    pad = Box((0.006, 0.02, 0.02))
    colliders = [Collider("pad", "left", pad), Collider("other pad", "right", pad)]
    colliders.append(Collider("rod", "rod", Capsule(0.005, 0.03), quaternion=(math.sqrt(0.5), math.sqrt(0.5), 0, 0)))
    drives = [Actuator(f"press {x}", f"slide {x}", control_range=(-300.0, 300.0)) for x in ("left", "right")]
    actuators = Actuators.from_list(a, drives)
    terms = contact_terms(a, colliders, (), ContactRules(actuators=actuators))
    simulator = Simulator(Scene(a, (Inertia(), actuators, *terms), down()), dt)
    control = torch.full((round(0.2 / dt), 1, 2), force, dtype=torch.float64)
    return simulator.rollout(simulator.initial_state(a.rest[None], None, control[0]), control)


@pytest.mark.parametrize("dt", [0.005, 0.02])
@pytest.mark.parametrize("force", [12.0, 60.0, 200.0])
def test_a_rod_between_fingers(force: float, dt: float) -> None:
    """It keeps its 10 mm to a fifth of a millimetre, and nothing is a hazard."""
    rollout = rod_between_fingers(force, dt)
    x = rollout.link_poses[-1, 0, :, 0, 3]
    assert 10.0 - 0.2 < 1e3 * float(x[1] - x[0] - 0.012) < 10.0
    assert bool(rollout.solved.all())
    assert not bool(rollout.hazards.any())


def pushed(effort: float, torque: float, force: float, dt: float, integrator: str) -> Tensor:
    """How far a hinge and a light slide are past their limits at most [rad, m], pushed for a while. effort: of the motors."""
    hinge = Joint("h", JointKind.HINGE, (0, 1, 0), lower=-0.5, upper=0.5)
    slide = Joint("s", JointKind.SLIDE, (1, 0, 0), lower=0.0, upper=0.04)
    swing = Link("swing", joints=(hinge,), mass=0.1, com=(0, 0, -0.05), inertia=diagonal(1e-4, 1e-4, 1e-5))
    a = Articulation.from_links([swing, Link("sled", joints=(slide,), mass=0.02, inertia=diagonal(1e-6, 1e-6, 1e-6))])
    motors = Actuators.from_list(a, [Actuator.motor("turn", "h", effort=effort), Actuator.motor("push", "s", effort=effort)])
    limits = JointLimits.for_articulation(a, actuators=motors)
    simulator = Simulator(Scene(a, (Inertia(), motors, limits), torch.zeros(3).double()), dt, INTEGRATORS[integrator]())
    control = doubles(torque, force).expand(round(max(0.3, 10 * dt) / dt), 1, 2)
    rollout = simulator.rollout(simulator.initial_state(a.rest[None], None, control[0]), control)
    assert bool(rollout.solved.all())
    return (rollout.q[:, 0] - a.upper).amax(0)


@pytest.mark.parametrize("effort", [300.0, math.inf], ids=["bounded", "unbounded"])
@pytest.mark.parametrize("integrator", ["energy-momentum", "implicit-euler"])
@pytest.mark.parametrize("dt", [0.002, 0.01, 0.05])
def test_limits_hold_what_pushes(dt: float, integrator: str, effort: float) -> None:
    """20 N m and 200 N, or a twentieth, into the limits: less than a milliradian and a millimetre past them."""
    for share in (0.05, 1.0):
        assert bool((pushed(effort, 20.0 * share, 200.0 * share, dt, integrator) < 1e-3).all())


def test_limits_of_what_is_driven() -> None:
    """At HELD the limit carries the weight and the largest force; without actuators the weight at 2 mrad."""
    a = two_links(Joint("slide", JointKind.SLIDE, (1, 0, 0)))
    actuators = Actuators.from_list(a, [Actuator.motor("a", "elbow", effort=30.0)])
    load = force_scale(a, GRAVITY)
    expected = torch.stack((load[0] / 2e-3**2, (load[1] + 30.0) / HELD**2))
    torch.testing.assert_close(JointLimits.for_articulation(a, GRAVITY, actuators=actuators).stiffness, expected)
    torch.testing.assert_close(JointLimits.for_articulation(a, GRAVITY).stiffness, load / 2e-3**2)


def test_limits_soften() -> None:
    """A softened limit, which continuation needs, works with what the whole one has prepared."""
    a = Articulation.from_links(
        [Link("arm", joints=(Joint("j", JointKind.SLIDE, (1, 0, 0), lower=0.0, upper=1.0),), mass=1.0, inertia=INERTIA)]
    )
    limits = JointLimits(doubles(1e6))
    simulator = Simulator(Scene(a, (Inertia(), limits), torch.zeros(3).double()), 0.01)
    prepared = limits.prepare(simulator.objective(simulator.initial_state(doubles(1.0)[None])).step)
    at = place(a, doubles(1.01)[None])
    whole = limits.load(prepared, at).residual
    assert float(whole) == pytest.approx(1e6 * 0.01**2)
    torch.testing.assert_close(limits.softened(0.01).load(prepared, at).residual, 0.01 * whole)
