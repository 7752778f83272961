"""Torsional friction in the compiled core: the reference's torques and how they answer, its steps and records, and the closed form
of a ball that stops spinning."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.cli.options import Friction, with_friction
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.motion import Turntable
from pbfd_torch.contact.shapes import Capsule, Collider, Ellipsoid, Point, Shape, Sphere
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.models.setup import Setup
from pbfd_torch.native.engine import Native
from pbfd_torch.native.library import library
from pbfd_torch.native.plan import planned
from pbfd_torch.native.stepper import NativeStepper, uncovered
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbd_friction import PbdFriction
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.terms.static_friction import StaticFriction
from pbfd_torch.terms.torsional_friction import TorsionalFriction
from pbfd_torch.tree.kinematics import retract
from tests.bodies import diagonal
from tests.native_moving import MOTIONS, SCHEMES, drawn, timed
from tests.native_parity import DT, gaps, require_same_steps, require_single_precision, require_starts, require_steps, resting
from tests.test_native_contact import GROUND, SOLIDS, WALL, Solid, beside, require_touching, touching
from tests.test_native_laws import lifted, require_fallbacks_alike, require_records
from tests.test_native_moving import placed
from tests.test_torsional_friction import require_stop

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

ROUND: tuple[Shape, ...] = (Sphere(0.05), Capsule(0.03, 0.1), Point())
BESIDE: dict[str, tuple[Solid, ...]] = {"half-spaces": (GROUND, WALL)} | {x: (solid, GROUND) for x, solid in SOLIDS.items()}


def braked(scene: Scene, patch: float | Tensor = 0.05, spin_speed: float = 0.1, mu: float | Tensor = 0.7) -> Scene:
    """The scene with torsional friction on all its contacts, with another patch and speed each."""
    contacts = [term for term in scene.terms if isinstance(term, Contact)]
    added = [TorsionalFriction(contact, mu, (k + 1) * patch, (k + 1) * spin_speed) for k, contact in enumerate(contacts)]
    return dataclasses.replace(scene, terms=(*added[:1], *scene.terms, *added[1:]))


def lawful(scene: Scene, friction: FrictionLaw | None, exponent: float = 2.0, restitution: Restitution | None = None) -> Scene:
    """The scene with these laws in all contacts."""

    def change(term: Any) -> Any:
        if not isinstance(term, Contact):
            return term
        law = dataclasses.replace(term.normal_force, exponent=exponent)
        return dataclasses.replace(term, friction=friction, normal_force=law, restitution=restitution)

    return dataclasses.replace(scene, terms=tuple(map(change, scene.terms)))


def unbraked(scene: Scene) -> Scene:
    """The same without."""
    return dataclasses.replace(scene, terms=tuple(term for term in scene.terms if not isinstance(term, TorsionalFriction)))


def share(scene: Scene, state: Any, q: Tensor) -> float:
    """Which part of r and J is torsional friction's, at most over the worlds: the lesser of both."""
    here, other = (Simulator(x, DT).eager.objective(state).evaluate(q) for x in (scene, unbraked(scene)))
    pairs = ((here.residual, other.residual), (here.jacobian.flatten(-2), other.jacobian.flatten(-2)))
    return min(float(((x - y).abs().amax(-1) / x.abs().amax(-1)).max()) for x, y in pairs)


def require_exact(scene: Scene, state: Any, q: Tensor, least: float) -> None:
    """r and J where torsional friction is more than this part of them in some world: r to 1e-11 and J to 1e-10 of the largest
    entry, or as well as without it. A millimetre's depth metres from the origin is rounded by 1e-12."""
    assert share(scene, state, q) >= least
    for found, without, tight in zip(gaps(scene, state, q), gaps(unbraked(scene), state, q), (1e-11, 1e-10), strict=True):
        assert float(found.max()) <= max(tight, 2 * float(without.max()))


@pytest.mark.parametrize("spin_speed", [100.0, 0.3, 1e-3])
@pytest.mark.parametrize("solids", BESIDE)
def test_torques_and_how_they_answer(solids: str, spin_speed: float) -> None:
    """Of balls and capsules, beside points without any: sticking, sliding and between."""
    scene = touching(ROUND, BESIDE[solids])
    state, q = beside(scene, 60)
    require_touching(scene, state, q)
    require_exact(braked(scene, 100.0 if spin_speed > 1 else 5.0, spin_speed), state, q, 0.1)


LAWS: dict[str, Callable[[Scene], Scene]] = {
    "none": lambda scene: lawful(scene, None),
    "static": lambda scene: lawful(scene, StaticFriction(0.9, 0.5)),
    "paper": lambda scene: lawful(scene, PbfdFriction.as_derived(3e5)),
    "gradient": lambda scene: lawful(scene, PbdFriction(3e5)),
    "anchored": lambda scene: lawful(scene, AnchoredFriction(0.7)),
    "exponent": lambda scene: lawful(scene, CoulombFriction(0.7), 1.5),
    "thrown back": lambda scene: lawful(scene, CoulombFriction(0.7), 2.0, Restitution(0.7, 0.05)),
}


@pytest.mark.parametrize("law", LAWS)
def test_beside_other_laws(law: str) -> None:
    """The normal force is that of the depth, whatever else holds the contact; steps, fallbacks and records too."""
    scene = braked(LAWS[law](touching(ROUND, BESIDE["half-spaces"])), 5.0)
    state, q = beside(scene, 60)
    require_exact(scene, state, q, 0.05)
    scene = braked(LAWS[law](touching(ROUND, BESIDE["half-spaces"])))
    q, v = lifted(scene, 16) if law == "thrown back" else (state.q[:16], state.v[:16])
    require_steps(scene, resting(q, v), steps=3)
    require_records(scene, q, v)
    require_fallbacks_alike(scene, q, 5 * v, 2, 0.5)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("solid", ["plane", *SOLIDS])
def test_on_solids_that_move(solid: str, motion: str) -> None:
    """The turn is that relative to the solid; at other times in each world."""
    there: Solid = HalfSpace("plane", (0.1, -0.2, 0.9), -0.1) if solid == "plane" else SOLIDS[solid]
    scene = touching(ROUND, (placed(there, 60, MOTIONS[motion]), GROUND))
    state, q = beside(scene, 60, time=drawn(60, seed=5) + 1)
    require_exact(braked(scene, 5.0), state, q, 0.05)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("solids", ["half-spaces", "terrain", "turntable"])
def test_steps(solids: str, scheme: Any) -> None:
    """To the same root as the reference's, and on from it alike, where both solve the step directly."""
    there: Sequence[Solid] = (HalfSpace("table", motion=Turntable(3.0)),) if solids == "turntable" else BESIDE[solids]
    scene = braked(touching(ROUND, there))
    start, _ = beside(scene, 16, 5)
    native = NativeStepper(Simulator(scene, DT, scheme).eager)
    state = timed(native.initial_state(start.q, start.v, None), drawn(16, seed=6) + 1)
    require_same_steps(native, state, 4, 40)


@pytest.mark.parametrize("solids", ["half-spaces", "box", "grid"])
def test_starts_and_single_steps(solids: str) -> None:
    """What is made of a trial step, where it is no sudden force; a world goes alone as in a batch."""
    scene = braked(touching(ROUND, BESIDE[solids]))
    state, _ = beside(scene, 12, 5)
    require_starts(scene, state.q, state.v)
    require_steps(scene, state)


def test_worlds_that_differ() -> None:
    """In ℓ and μ, in radii, some of which are zero, and in the stiffness of the contact; the scene of some of them is known by the
    numbers of its contact, which another one has made."""
    worlds = 40
    some = torch.linspace(0.0, 1.0, worlds, dtype=torch.float64)[:, None]
    scene = touching((Sphere(0.05), Sphere(0.02), Point()), (GROUND, WALL))
    contact = scene.terms[1]
    assert isinstance(contact, Contact)
    radius = contact.radius * (some > 0.2)
    other = dataclasses.replace(contact, radius=radius, normal_force=NormalForce(1e5 * (1 + some)))
    scene = dataclasses.replace(scene, terms=(scene.terms[0], other, scene.terms[2]))
    for big in (1.0, 0.01):
        here = braked(scene, 5.0 * big * some, 0.1, 0.3 + some * torch.linspace(0.1, 1.0, len(contact.link), dtype=torch.float64))
        assert uncovered(Simulator(here, DT).eager) == ""
        state, q = beside(here, worlds)
        require_exact(here, state, q, 0.05 if big == 1.0 else 0.0)
    require_steps(here, state)
    part = here.take(index := Worlds((worlds,), torch.tensor([3, 17, 30, 22, 8, 39])))
    friction = part.terms[0]
    assert isinstance(friction, TorsionalFriction)
    assert friction.contact is not part.terms[2]
    require_exact(part, state.take(index), q[index.index], 0.0)
    require_steps(part, state.take(index))


def test_in_a_plane() -> None:
    """Nothing turns about a normal there: the core is spared the third dimension, and PyTorch finds no torque."""
    ways = {"x": (1.0, 0.0, 0.0), "z": (0.0, 0.0, 1.0)}
    joints = (*(Joint(name, JointKind.SLIDE, axis) for name, axis in ways.items()), Joint("turn", JointKind.HINGE, (0.0, 1.0, 0.0)))
    a = Articulation.from_links([Link("body", joints=joints, mass=1.0, inertia=diagonal(0.01, 0.02, 0.03))])
    ball = [Collider("ball", "body", Sphere(0.1), (0.03, 0.0, 0.0))]
    contact = Contact.between(a, ball, HalfSpace(), NormalForce(1e5), CoulombFriction(0.7))
    bare = Scene(a, (Inertia(), contact), torch.tensor([1.0, 0.0, -9.81], dtype=torch.float64))
    scene = braked(bare, 5.0)
    assert planned(Simulator(scene, DT).eager).dimension == 2
    v = drawn(20, 3)
    q = torch.tensor([1.0, 2e-3, 1.0], dtype=torch.float64) * drawn(20, 3, seed=1)
    q[:, 1] += 0.1
    state, end = resting(q, v), retract(a, q, DT * v)
    here, without = (Simulator(x, DT).eager.objective(state).evaluate(end) for x in (scene, bare))
    torch.testing.assert_close(here.residual, without.residual, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(here.jacobian, without.jacobian, rtol=1e-13, atol=1e-9)
    assert all(float(gap.max()) < 1e-10 for gap in gaps(scene, state, end))
    require_steps(scene, state)


@pytest.mark.parametrize("dt", [0.005, 0.02])
def test_spinning_ball_stops(dt: float) -> None:
    """After ω_0 I/(ℓ μ m g)."""
    require_stop(dt, Native())


def test_no_world_knows_another() -> None:
    """In batches of any size, in any lane, to the bit; those whose numbers differ too."""
    scene = touching(ROUND, BESIDE["box"])
    state, _ = beside(scene, 19)
    for patch in (0.05, 0.05 * torch.linspace(0.0, 1.0, 19, dtype=torch.float64)[:, None]):
        native = NativeStepper(Simulator(braked(scene, patch), DT).eager)
        start = native.initial_state(state.q, state.v, None)
        states, _ = native.run(start, None, 6)
        for index in ([3], [18, 0, 3], [7, 8, 9, 10, 11, 12, 13, 14, 15]):
            alone, _ = native.take(part := Worlds((19,), torch.tensor(index))).run(start.take(part), None, 6)
            assert torch.equal(alone.q, states.q[:, index])
            assert torch.equal(alone.v, states.v[:, index])


def test_single_precision() -> None:
    """Steps go on as those in double precision do."""
    require_single_precision(
        lambda dtype: braked(touching(ROUND, (GROUND, WALL), dtype=dtype)), lambda scene: beside(scene, 12, 5)[0]
    )


@pytest.mark.parametrize("choice", Friction)
def test_choices_of_the_command(choice: Friction) -> None:
    """Another law of the contact leaves it the one that the torsional friction belongs to."""
    scene = braked(touching(ROUND, (GROUND, WALL)))
    state, q = beside(scene, 30)
    chosen = with_friction(Setup(scene, state.q, state.v, 1.0, DT), choice, DT).scene
    assert Simulator(chosen, DT).engine == "native"
    require_exact(chosen, state, q, 0.0)


def test_what_curves_has_no_patch() -> None:
    """Ellipsoids have no radius, and so no torque here or there."""
    scene = touching((Ellipsoid((0.08, 0.05, 0.03)),), (GROUND, WALL), CurvedContact)
    state, q = beside(scene, 30)
    assert share(braked(scene), state, q) == 0.0
    assert all(float(gap.max()) < 1e-9 for gap in gaps(braked(scene), state, q))


def test_what_is_not_covered_is_said() -> None:
    """By name: what belongs to no contact, or to one that has its own; a normal force that is held; a user's own kind."""
    scene = touching(ROUND, (GROUND,))
    contact = scene.terms[1]
    assert isinstance(contact, Contact)

    class Own(TorsionalFriction):
        pass

    def words(*added: Any) -> str:
        return uncovered(Simulator(dataclasses.replace(scene, terms=(*scene.terms, *added)), DT, EnergyMomentum()).eager)

    good, stiffer = TorsionalFriction(contact, 0.7, 0.05), dataclasses.replace(contact, normal_force=NormalForce(2e5))
    lost = "torsional friction of a contact that is not among the scene's terms"
    assert words(good) == words(TorsionalFriction(dataclasses.replace(contact), 0.7, 0.05)) == ""
    assert words(good, dataclasses.replace(contact), TorsionalFriction(contact, 0.3, 0.01)) == ""
    assert words(TorsionalFriction(stiffer, 0.7, 0.05)) == f"the core does not know {lost}"
    assert words(good, good) == "the core does not know two torsional frictions of one contact"
    held = dataclasses.replace(good, held=torch.ones(len(contact.link), dtype=torch.float64))
    assert words(held) == "the core does not know torsional friction with a normal force that is held"
    assert words(Own(contact, 0.7, 0.05)) == "the core does not know Own"
