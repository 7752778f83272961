"""Worlds that differ in their parameters, in the compiled core: each as the reference has it, and none that knows another."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.bench.starts import scattered
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Cylinder, Ellipsoid, Point, Sphere
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.integrators.energy_momentum import EnergyMomentum, Velocities
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.models import SCENES
from pbfd_torch.native.library import library
from pbfd_torch.native.plan import planned
from pbfd_torch.native.stepper import NativeStepper, uncovered
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.tree.articulation import homogeneous
from pbfd_torch.tree.kinematics import place, retract
from pbfd_torch.tree.rotations import quaternion_exp, quaternion_matrix
from tests.bodies import diagonal
from tests.native_parity import DT, compared, require_balance, require_steps, resting

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

WORLDS, SICK = 21, 4
Difference = Callable[[Tensor, torch.Generator], Tensor]  # a parameter of each world, of the one that all have


def robot(dtype: torch.dtype = torch.float64) -> Scene:
    """A free body with a hinge and a slide on it, and everything that acts; on the ground, beside a wall."""
    inertia = diagonal(0.01, 0.02, 0.015)
    free, hinge = Joint("free", JointKind.FREE), Joint("hinge", JointKind.HINGE, (0.6, 0.0, 0.8), lower=-0.3, upper=0.3)
    slide = Joint("slide", JointKind.SLIDE, (0.0, 1.0, 0.0), lower=-0.1, upper=0.2)
    a = Articulation.from_links(
        [
            Link("base", joints=(free,), mass=1.0, com=(0.01, 0.0, 0.02), inertia=inertia),
            Link("upper", "base", (0.3, 0.0, 0.1), joints=(hinge,), mass=0.5, inertia=inertia),
            Link("lower", "upper", (0.0, 0.2, 0.0), joints=(slide,), mass=0.4, inertia=inertia),
            Link("tool", "lower", (0.0, 0.1, 0.05), mass=0.1, inertia=inertia),
        ],
        dtype,
    )

    def dofs(*values: float) -> Tensor:
        return torch.tensor([0.0] * 6 + list(values), dtype=dtype)

    servo = Actuator("turn", "hinge", 1.5, 20.0, 0.1, 20.0, 1.0, (-1.0, 1.0), (-15.0, 15.0))
    colliders = [
        Collider("ball", "base", Sphere(0.05), (0.0, 0.0, -0.05), margin=1e-3),
        Collider("foot", "upper", Box((0.05, 0.04, 0.03)), (0.1, 0.0, -0.1)),
        Collider("end", "tool", Point(), (0.05, 0.0, -0.1)),
    ]
    law, friction = NormalForce(1e5), CoulombFriction(0.7)
    curved = [Collider("egg", "lower", Ellipsoid((0.08, 0.05, 0.06)), (0.0, 0.0, -0.1))]
    terms = (
        *(Inertia(), JointSprings(dofs(3.0, 20.0), a.rest + 0.02), JointDamping(dofs(0.2, 1.0)), Armature(dofs(0.01, 0.1))),
        *(JointDryFriction(dofs(0.1, 0.2)), JointLimits.for_articulation(a)),
        Actuators.from_list(a, [servo, Actuator.motor("push", "slide", 3.0)]),
        Pushes(torch.tensor([[0.0, 1.0, 2.0], [0.0] * 3, [1.0, 0.0, 0.5], [0.0] * 3], dtype=dtype), a.rest.new_full((4, 3), 0.05)),
        Contact.between(a, colliders, HalfSpace(), law, friction),
        CurvedContact.between(a, curved, HalfSpace("wall", (-0.8, 0.0, 0.6), -0.2), law, friction),
    )
    return Scene(a, terms, torch.tensor([0.3, 0.0, -9.81], dtype=dtype))


def on(solid: Obstacle) -> Scene:
    """A free body with a ball and a point, above a solid."""
    a = Articulation.from_links(
        [Link("body", joints=(Joint("free", JointKind.FREE),), mass=1.0, inertia=diagonal(0.01, 0.02, 0.03))]
    )
    colliders = [Collider("ball", "body", Sphere(0.05), (0.1, 0.0, 0.0)), Collider("point", "body", Point())]
    contact = Contact.between(a, colliders, solid, NormalForce(1e5), CoulombFriction(0.7))
    return Scene(a, (Inertia(), contact), torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64))


# How a parameter may differ -----------------------------------------------------------------------------------------------


def drawn(shape: tuple[int, ...], like: Tensor, random: torch.Generator) -> Tensor:
    """From −1 to 1, `[worlds, *shape]`."""
    return (2 * torch.rand(WORLDS, *shape, dtype=torch.float64, generator=random) - 1).to(like.dtype)


def scaled(value: Tensor, random: torch.Generator) -> Tensor:
    """Each number by up to a tenth, of each world another."""
    event = tuple(value.shape) or (1,)
    return value * (1 + 0.1 * drawn(event, value, random))


def one(difference: Difference) -> Difference:
    """Of a solid, one for all candidates."""
    return lambda value, random: difference(value.reshape(1, -1), random)


def heavier(value: Tensor, random: torch.Generator) -> Tensor:
    """Masses and inertias of each link."""
    return value * (1 + 0.3 * drawn((len(value), 1, 1), value, random))


def placed(value: Tensor, random: torch.Generator) -> Tensor:
    """Frames `[*, 4, 4]` turned and moved."""
    turn = quaternion_matrix(quaternion_exp(0.2 * drawn((*value.shape[:-2], 3), value, random)))
    return value @ homogeneous(turn, 0.01 * drawn((*value.shape[:-2], 3), value, random))


def mounted(value: Tensor, random: torch.Generator) -> Tensor:
    """Frames of joints, but for those of a free one."""
    return torch.cat((value[:1].expand(WORLDS, 1, 4, 4), placed(value[1:], random)), 1)


def tilted(value: Tensor, random: torch.Generator) -> Tensor:
    """Unit vectors."""
    turned = value + 0.1 * drawn(tuple(value.shape), value, random)
    return turned / torch.linalg.vector_norm(turned, dim=-1, keepdim=True)


def longer(value: Tensor, random: torch.Generator) -> Tensor:
    """Lengths of which some are zero in some worlds, but not in all."""
    return (value + 0.02 * drawn(tuple(value.shape), value, random)).clamp_min(0)


def swollen(value: Tensor, random: torch.Generator) -> Tensor:
    """Forms of ellipsoids."""
    return value * (1 + 0.2 * drawn((len(value), 1, 1), value, random))


def pushed(value: Tensor, random: torch.Generator) -> Tensor:
    """Links that are pushed in some worlds only."""
    return value + torch.where(drawn((len(value), 1), value, random) > 0.5, 2.0, 0.0)


CONTACT, CURVED = "terms.8.", "terms.9."
BODIES: dict[str, Difference] = {
    "articulation.pseudo_inertia": heavier,
    "articulation.link_frame": placed,
    "articulation.lower": scaled,
    "articulation.upper": scaled,
    "articulation.joint_ref": lambda value, random: value + 0.05 * drawn(tuple(value.shape), value, random),
}
JOINTS = dict.fromkeys(
    [
        *("terms.1.stiffness", "terms.1.rest", "terms.2.damping", "terms.3.inertia", "terms.4.torque", "terms.5.stiffness"),
        *(f"terms.6.{x}" for x in ("gear", "gain", "bias", "stiffness", "damping", "control_range", "force_range")),
    ],
    scaled,
)
CONTACTS: dict[str, Difference] = {
    f"{CONTACT}radius": longer,
    f"{CONTACT}margin": longer,
    f"{CONTACT}surface.normal": one(tilted),
    f"{CONTACT}surface.offset": lambda value, random: value + 1e-3 * drawn((1,), value, random),
    f"{CURVED}form": swollen,
    f"{CURVED}axis": tilted,
    **dict.fromkeys([f"{CONTACT}{x}" for x in ("position", "normal_force.stiffness", "friction.mu")], scaled),
    **dict.fromkeys([f"{CURVED}{x}" for x in ("position", "friction.mu", "surface.offset")], scaled),
}
AXES: dict[str, Difference] = {"articulation.joint_axis": tilted, "articulation.joint_frame": mounted}  # the reference wants both
OTHERS: dict[str, Difference] = {"gravity": scaled, "terms.7.force": pushed, "terms.7.point": scaled}
DIFFERENCES = BODIES | AXES | JOINTS | CONTACTS | OTHERS


def differing(scene: Scene, differences: Mapping[str, Difference], seed: int = 0) -> Scene:
    """The scene with such parameters of its own for each world."""
    known, random = parameters(scene), torch.Generator().manual_seed(seed)
    return with_parameters(scene, {name: difference(known[name], random) for name, difference in differences.items()})


def state_of(simulator: Simulator[Any]) -> Any:
    """Where steps may begin, in all worlds."""
    a = simulator.articulation
    v = 0.3 * drawn((a.nv,), a.rest, torch.Generator().manual_seed(4))
    q = retract(a, a.rest.expand(WORLDS, -1), 0.5 * v)
    q[:, 2] += 0.1
    return simulator.initial_state(q, v)


def start(scene: Scene, seed: int = 1, contact: int = 8) -> tuple[Velocities, Tensor]:
    """States, and configurations at which a step of theirs may end: the deepest candidate a millimetre deep, or two."""
    a, random = scene.articulation, torch.Generator().manual_seed(seed)
    v, moved, off = (x * drawn((a.nv,), a.rest, random) for x in (0.3, 0.3, 1e-4))
    moved[:, :3] = torch.tensor([0.0, 0.0, 1.0]) + 0.1 * moved[:, :3]  # above it
    q = retract(a, a.rest.expand(WORLDS, -1), moved)
    touching = scene.terms[contact]
    assert isinstance(touching, Contact)
    for _ in range(30):
        q[:, 2] += touching.depth(place(a, q)).amax(-1) - 1e-3
    state = resting(retract(a, q, off - DT * v), v)
    assert float((Simulator(scene, DT).eager.objective(state).push(q) > 0).double().mean()) > 0.5
    return state, q


def control(scene: Scene) -> Tensor | None:
    return drawn((scene.nu,), scene.gravity, torch.Generator().manual_seed(3)) if scene.nu else None


# As the reference ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DIFFERENCES)
def test_each_parameter(name: str) -> None:
    """r and J, and steps that end where the reference's do."""
    scene = differing(robot(), AXES if name in AXES else {name: DIFFERENCES[name]})
    state, q = start(scene)
    plan = planned(Simulator(scene, DT).eager)
    assert plan.own.shape[0] == WORLDS
    assert len(plan.which) > 0
    require_balance(scene, state, q, control(scene))
    require_steps(scene, state, control(scene), 3)


VECTORS = ("start", "end", "half_extents")


@pytest.mark.parametrize(
    ("solid", "names"),
    [
        (Sphere(0.2), ["radius"]),
        (Capsule(0.1, 0.2), ["start", "end", "radius"]),
        (Box((0.2, 0.15, 0.1)), ["half_extents"]),
        (Cylinder(0.2, 0.1), ["radius", "half_length"]),
    ],
)
def test_each_solid(solid: Any, names: list[str]) -> None:
    """Its sizes, and where it is."""
    scene = on(Obstacle("solid", solid, (0.0, 0.0, 0.3), (0.8, 0.3, -0.4, 0.2)))
    differences = {f"terms.1.surface.{name}": one(scaled) if name in VECTORS else scaled for name in names}
    scene = differing(scene, differences | {"terms.1.carrier.start": placed})
    state, q = start(scene, contact=1)
    require_balance(scene, state, q)
    require_steps(scene, state, steps=3)


def test_batches_broadcast() -> None:
    """Parameters of some dimensions of the batch only, and of one row and one column of it."""
    scene, random = robot(), torch.Generator().manual_seed(0)
    known = parameters(scene)
    mass = heavier(known["articulation.pseudo_inertia"], random)[:3]
    wide = with_parameters(scene, {"articulation.pseudo_inertia": mass, "gravity": scaled(known["gravity"], random)[:7, None]})
    state, _ = start(scene)
    fields = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
    shaped = replaced(state, **{name: x.unflatten(0, (7, 3)) for name, x in fields.items() if isinstance(x, Tensor)})
    whole, solution, _ = NativeStepper(Simulator(wide, DT).eager).made(shaped, None)
    assert solution.status.shape == (7, 3)
    each, worlds = torch.arange(21).reshape(7, 3), parameters(wide)
    for row, column in ((0, 0), (5, 2)):
        own = {"articulation.pseudo_inertia": mass[column], "gravity": worlds["gravity"][row, 0]}
        some = Worlds((21,), each[row, column][None])
        alone, _, _ = NativeStepper(Simulator(with_parameters(scene, own), DT).eager).made(state.take(some), None)
        assert torch.equal(alone.q[0], whole.q[row, column])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("scheme", [EnergyMomentum, ImplicitEuler])
def test_everything_at_once(scheme: Any, dtype: torch.dtype) -> None:
    """Both integrators, in both precisions: what the core solves directly are roots by the reference's own error."""
    scene = differing(robot(dtype), DIFFERENCES)
    simulator: Simulator[Any] = Simulator(scene, DT, scheme())
    native, tolerance = NativeStepper(simulator.eager), Fallbacks().direct.tolerance_for(dtype)
    beside, _ = start(scene)
    state, held = simulator.initial_state(beside.q, 0.1 * beside.v), control(scene)
    pairs = compared(native, state, None if held is None else held[None], 5)
    pairs.require_roots(tolerance)
    near = (pairs.after.q - pairs.expected.q).abs().amax(-1) < (1e-7 if dtype == torch.float64 else 1e-3)
    assert int((pairs.both & near).sum()) >= 0.95 * int(pairs.both.sum())
    assert int(pairs.both.sum()) > 0.8 * 5 * WORLDS


def test_a_solid_of_its_own_for_each_candidate() -> None:
    """Is said not to be covered; no worlds at all are."""
    scene = robot()
    normals = parameters(scene)[f"{CONTACT}surface.normal"].expand(10, 3)
    each = with_parameters(scene, {f"{CONTACT}surface.normal": normals.clone()})
    words = "the core does not know contact with 'ground' of its own for each candidate"
    assert uncovered(Simulator(each, DT).eager) == words
    simulator, none = Simulator(differing(scene, BODIES), DT), Worlds((WORLDS,), torch.zeros(0, dtype=torch.long))
    after, _, _ = NativeStepper(simulator.eager).take(none).made(state_of(simulator).take(none), None)
    assert after.q.shape == (0, scene.articulation.nq)


# In a plane ---------------------------------------------------------------------------------------------------------------


def about(axis: int, value: Tensor, random: torch.Generator) -> Tensor:
    """Frames of joints `[n, 4, 4]`, the first of which is turned about an axis of the world, by up to one radian."""
    turn = torch.zeros(WORLDS, 3, dtype=value.dtype)
    turn[:, axis] = drawn((), value, random)
    first = homogeneous(quaternion_matrix(quaternion_exp(turn)), torch.zeros_like(turn)) @ value[0]
    return torch.cat((first[:, None], value[1:].expand(WORLDS, *value[1:].shape)), 1)


@pytest.mark.parametrize(
    ("differences", "dimension"),
    [
        ({"terms.5.friction.mu": scaled}, 2),
        ({"articulation.pseudo_inertia": heavier, "articulation.joint_ref": BODIES["articulation.joint_ref"]}, 3),
        ({"articulation.joint_frame": lambda value, random: about(2, value, random)}, 3),  # another plane in each world
        ({"articulation.joint_frame": lambda value, random: about(0, value, random)}, 3),  # which is oblique to the ground
        ({"gravity": lambda value, random: value + 0.1 * drawn((3,), value, random)}, 3),
    ],
)
def test_planes(differences: Mapping[str, Difference], dimension: int) -> None:
    """Worlds that differ by more than their friction are seen in space, whatever the plane of each."""
    setup = SCENES["hopper"](worlds=WORLDS)
    scene = differing(setup.scene, differences)
    assert planned(Simulator(scene, DT).eager).dimension == dimension
    q, v = scattered(setup, 0, 0.3, 1.0)
    require_balance(scene, resting(q, v), retract(scene.articulation, q, DT * v), control(scene))
    require_steps(scene, resting(q, v), control(scene))
