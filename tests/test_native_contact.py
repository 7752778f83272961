"""Contact in the compiled core: the reference's forces and derivatives wherever bodies touch, and its roots."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.contact.distance_grid import DistanceGrid
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.height_field import HeightField
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.primitives import SphereSurface
from pbfd_torch.contact.shapes import Box, Capsule, Collider, ConvexHull, Cylinder, Ellipsoid, Point, Shape, Sphere
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import uncovered
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.kinematics import place, retract
from tests.bodies import diagonal
from tests.native_parity import DT, gaps, require_balance, require_starts, require_steps, resting

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

GROUND, WALL = HalfSpace(), HalfSpace("wall", (-0.8, 0.0, 0.6), -0.1)
Solid = HalfSpace | Obstacle


def two_links() -> Articulation:
    """A free body that carries another one on a hinge."""
    eye = ((0.01, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.015))
    free, hinge = Joint("free", JointKind.FREE), Joint("hinge", JointKind.HINGE, (0.6, 0.0, 0.8))
    first = Link("first", joints=(free,), mass=1.0, inertia=eye, com=(0.01, 0.0, 0.02))
    return Articulation.from_links([first, Link("second", "first", (0.3, 0.0, 0.1), joints=(hinge,), mass=0.5, inertia=eye)])


def require_touching(scene: Scene, state: Velocities, q: Tensor) -> None:
    """Something touches in a third of the worlds at least."""
    assert float((Simulator(scene, DT).eager.objective(state).push(q) > 0).double().mean()) > 0.3


def require_alike(scene: Scene, worlds: int, speed: float = 0.3) -> None:
    """The same forces and derivatives beside all solids."""
    state, q = beside(scene, worlds, speed=speed)
    require_touching(scene, state, q)
    require_balance(scene, state, q)


def touching(shapes: Sequence[Shape], solids: Sequence[Solid], kind: Any = Contact, dtype: torch.dtype = torch.float64) -> Scene:
    """The two links, with these shapes on the second, against these solids, each with other speeds."""
    a = two_links().to(dtype)
    colliders = [
        Collider(f"c{k}", "second", shape, (0.05 * k, 0.02, 0.0), (0.9, 0.3, 0.1, 0.3), margin=1e-3 * k)
        for k, shape in enumerate(shapes)
    ]
    terms: list[Term] = [Inertia()]
    for k, solid in enumerate(solids):
        law = NormalForce(1e5, release=0.1 * (k + 1))
        terms.append(kind.between(a, colliders, solid, law, CoulombFriction(0.7, slip_speed=1e-3 * (1 + 2 * k))))
    return Scene(a, tuple(terms), torch.tensor([0.3, 0.0, -9.81], dtype=dtype))


def beside(scene: Scene, worlds: int, seed: int = 0, speed: float = 0.3, time: Tensor | None = None) -> tuple[Velocities, Tensor]:
    """Random states, and configurations at which a step of theirs may end, with one candidate at the surface of one solid: up to
    a centimetre deeper or less. speed: standard deviation [m/s, rad/s]; time: of the states `[worlds]` [s]."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=random).to(a.dtype)

    def at(state: Velocities) -> Velocities:
        return state if time is None else dataclasses.replace(state, time=time.to(a.dtype))

    a = scene.articulation
    contacts = [term for term in scene.terms if isinstance(term, Contact)]
    q = retract(a, a.rest.expand(worlds, -1), normal(worlds, a.nv))
    depth = 0.003 * normal(worlds)
    every = torch.arange(worlds)
    for _ in range(4):  # along the normals until the depths fit
        still = at(resting(q, torch.zeros_like(q[..., 1:])))
        step = Simulator(scene, DT).eager.objective(still).step
        for k, contact in enumerate(contacts):
            mine = every % len(contacts) == k
            found = contact.points(contact.prepare(step), place(a, q))
            i = (every // len(contacts)) % len(contact.link)
            shift = (found.depth[every, i] - depth)[:, None] * found.normal[every, i]
            q[:, :3] += torch.where(mine[:, None], shift, 0.0)
    q[:, :3] += 1e-4 * normal(worlds, 3)  # off the borders between faces
    v = speed * normal(worlds, a.nv)
    return at(resting(retract(a, q, -DT * v + 1e-4 * normal(worlds, a.nv)), v)), q


@pytest.mark.parametrize(
    "shapes", [(Point(), Box((0.05, 0.04, 0.03))), (Sphere(0.05), Capsule(0.03, 0.1)), (Point(), Sphere(0.05))]
)
def test_half_spaces(shapes: Sequence[Shape]) -> None:
    """Contacts with different release and slip speeds too."""
    scene = touching(shapes, (GROUND, WALL))
    require_alike(scene, 45)
    require_steps(scene, beside(scene, 12, 5)[0])


def test_friction_of_each_world() -> None:
    """Beside contacts whose friction is one for all."""
    scene = touching((Sphere(0.05), Point()), (GROUND, WALL))
    worlds, contact = 60, scene.terms[1]
    assert isinstance(contact, Contact)
    mu = torch.linspace(0.1, 1.5, worlds, dtype=torch.float64)[:, None]
    scene = dataclasses.replace(
        scene, terms=(scene.terms[0], dataclasses.replace(contact, friction=CoulombFriction(mu)), scene.terms[2])
    )
    state, q = beside(scene, worlds)
    require_balance(scene, state, q)
    some = Worlds((worlds,), torch.arange(12))
    scene, state = scene.take(some), state.take(some)
    require_steps(scene, state)
    require_starts(scene, state.q, state.v)


class OwnSurface(SphereSurface):
    """A user's own."""


@dataclass(frozen=True)
class Own:
    """A solid of it."""

    def surface(self, dtype: torch.dtype, device: torch.device) -> OwnSurface:
        return OwnSurface(torch.tensor([0.1], dtype=dtype, device=device))


@pytest.mark.parametrize(
    ("law", "solid", "words"),
    [
        (NormalForce(1e5).seen_from(1e-3), GROUND, "normal force on 'ground', a DistantForce"),
        (NormalForce(1e5), Obstacle("own", Own()), "contact with 'own', which is a OwnSurface"),
    ],
)
def test_what_is_not_covered_is_said(law: NormalForce, solid: Solid, words: str) -> None:
    a = two_links()
    contact = Contact.between(a, [Collider("c", "second", Sphere(0.1))], solid, law, CoulombFriction(0.7))
    scene = Scene(a, (Inertia(), contact), torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64))
    assert uncovered(Simulator(scene, DT).eager) == f"the core does not know {words}"


@dataclass(frozen=True)
class Bubble:
    """A ball, by samples of its signed distance."""

    def surface(self, dtype: torch.dtype, device: torch.device) -> DistanceGrid:
        x, y, z = np.meshgrid(*(np.linspace(-0.3, 0.3, 13),) * 3, indexing="ij")
        return DistanceGrid.through(np.sqrt(x * x + y * y + z * z) - 0.2, (-0.3, -0.3, -0.3), 0.05, dtype, device)


TILTED = ((0.1, -0.2, 0.3), (0.8, 0.3, -0.4, 0.2))
HILLS = HeightField.from_function(lambda x, y: 0.1 * np.sin(5 * x) * np.cos(4 * y), (1.0, 0.8), 0.1)
ROCK = np.random.default_rng(3).uniform(-0.2, 0.2, (14, 3))
CONVEX = {
    "sphere": Obstacle("ball", Sphere(0.2), *TILTED),
    "capsule": Obstacle("pill", Capsule(0.1, 0.2), *TILTED),
    "box": Obstacle("block", Box((0.2, 0.15, 0.1)), *TILTED),
    "cylinder": Obstacle("drum", Cylinder(0.2, 0.1), *TILTED),
    "hull": Obstacle("rock", ConvexHull(ROCK), *TILTED),
}
SOLIDS = CONVEX | {"terrain": Obstacle("terrain", HILLS, *TILTED), "grid": Obstacle("bubble", Bubble(), *TILTED)}
BALLS, CURVED = (Point(), Sphere(0.05), Sphere(0.02)), (Ellipsoid((0.08, 0.05, 0.03)), Cylinder(0.06, 0.04))


@pytest.mark.parametrize("solid", SOLIDS)
def test_balls_on_solids(solid: str) -> None:
    scene = touching(BALLS, (SOLIDS[solid], GROUND))
    require_alike(scene, 240)
    state, _ = beside(scene, 12, 5)
    require_steps(scene, state)
    require_starts(scene, state.q, state.v)


@pytest.mark.parametrize("solid", CONVEX)
def test_fast_balls_do_not_pass_through(solid: str) -> None:
    """Planes stand for what they would pass."""
    scene = touching(BALLS, (CONVEX[solid],))
    state, q = beside(scene, 120, speed=10.0)
    prepared = Simulator(scene, DT).eager.objective(state).prepared[1]
    assert 0.2 < float(prepared.surface.passed.double().mean()) < 0.8
    require_balance(scene, state, q)
    require_starts(scene, state.q[:20], state.v[:20])


@pytest.mark.parametrize("shape", CURVED)
def test_curved_bodies_on_half_spaces(shape: Shape) -> None:
    scene = touching((shape,), (GROUND, WALL), CurvedContact)
    require_alike(scene, 120)
    state, _ = beside(scene, 12, 5)
    require_steps(scene, state)
    require_starts(scene, state.q, state.v)


@pytest.mark.parametrize("solid", sorted(SOLIDS.keys() - CONVEX.keys()))
def test_curved_bodies_on_uneven_solids(solid: str) -> None:
    scene = touching(CURVED, (SOLIDS[solid],), CurvedContact)
    require_alike(scene, 240)


@pytest.mark.parametrize("solid", CONVEX)
def test_curved_bodies_on_convex_solids_are_not_compiled(solid: str) -> None:
    """`contact_terms` makes no such terms."""
    scene = touching(CURVED, (CONVEX[solid],), CurvedContact)
    assert f"curved bodies on '{CONVEX[solid].name}'" in Simulator(scene, DT).engine_reason


def free_body(shape: Shape, solid: Solid, kind: Any = Contact) -> Scene:
    """One body at the world's axes, where borders are where they are told to be."""
    a = Articulation.from_links(
        [Link("body", joints=(Joint("free", JointKind.FREE),), mass=1.0, inertia=diagonal(0.01, 0.02, 0.03))]
    )
    contact = kind.between(a, [Collider("body", "body", shape)], solid, NormalForce(1e5), CoulombFriction(0.7))
    return Scene(a, (Inertia(), contact), torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64))


CORNERS = np.array([(x, y, z) for x in (-0.2, 0.2) for y in (-0.15, 0.15) for z in (-0.1, 0.1)])
NEAR = (-1e-6, -1e-9, -1e-13, 0.0, 1e-13, 1e-9, 1e-6)


@pytest.mark.parametrize(
    ("shape", "solid", "places"),
    [
        # edges and corners of a box, the rim and the end of a cylinder's side, the ends of a capsule, borders between cells
        (Sphere(0.05), Obstacle("o", Box((0.2, 0.15, 0.1))), [(0.2, 0.15, 0.14), (0.2, 0.0, 0.14), (0.2, 0.15, 0.1)]),
        (
            Sphere(0.05),
            Obstacle("o", Cylinder(0.2, 0.1)),
            [(0.2, 0.0, 0.14), (0.0, 0.2, 0.14), (0.0, 0.0, 0.14), (-0.24, 0.0, 0.1)],
        ),
        (Sphere(0.05), Obstacle("o", Capsule(0.1, 0.2)), [(0.0, 0.14, 0.2), (0.14, 0.0, -0.2), (0.0, 0.0, 0.34)]),
        (Sphere(0.05), Obstacle("o", ConvexHull(CORNERS)), [(0.2, 0.15, 0.14), (0.2, 0.0, 0.14), (0.2, 0.15, 0.1)]),
        (Sphere(0.05), Obstacle("o", HILLS), [(0.1, 0.0, 0.08), (0.0, -0.4, 0.04), (-0.5, 0.4, 0.04), (0.7, 0.6, 0.04)]),
        (Sphere(0.05), Obstacle("o", Bubble()), [(0.0, 0.0, 0.24), (0.15, 0.1, 0.15)]),
    ],
)
def test_borders(shape: Shape, solid: Obstacle, places: Sequence[tuple[float, float, float]]) -> None:
    """Forces do not jump there, so that they are the same whichever side rounding takes; nor do they where something ends."""
    scene = free_body(shape, solid)
    off = torch.tensor([(x, y, z) for x in NEAR for y in NEAR for z in (0.0, 1e-12, -1e-9)], dtype=torch.float64)
    at = (torch.tensor(places, dtype=torch.float64)[:, None] + off).flatten(0, 1)
    q = scene.articulation.rest.expand(len(at), -1).clone()
    q[:, :3] = at
    before = q.clone()
    before[:, 0] += 1e-4
    state = resting(before, torch.zeros_like(q[:, 1:]))
    require_touching(scene, state, q)
    assert float(gaps(scene, state, q)[0].max()) < 1e-6


def test_tips_and_rims() -> None:
    """A body that stands on its tip, and a cylinder that lies, stands, and tips from one to the other."""
    turns = torch.tensor([0.0, 1e-12, 1e-9, 1e-4, 0.015, 0.02, 0.05, 0.1, 0.2, 1.570796326, 0.5 * math.pi], dtype=torch.float64)
    for shape in (Ellipsoid((0.03, 0.05, 0.1)), Cylinder(0.06, 0.04)):
        scene = free_body(shape, GROUND, CurvedContact)
        a, contact = scene.articulation, scene.terms[1]
        assert isinstance(contact, Contact)
        tilted = torch.zeros(len(turns), 6, dtype=torch.float64)
        tilted[:, 3] = turns
        q = retract(a, a.rest.expand(len(turns), -1), tilted)
        q[:, 2] += contact.depth(place(a, q)).amax(-1) - 1e-3
        state = resting(retract(a, q, torch.full_like(tilted, 1e-4)), torch.zeros_like(tilted))
        require_touching(scene, state, q)
        require_balance(scene, state, q)
