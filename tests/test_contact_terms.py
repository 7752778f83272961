"""Contact terms of a scene: who meets whom, with which friction, found by what; slots that are too few; bad input."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.hazards import Hazard, Overflow
from pbfd_torch.contact.height_field import HeightField
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.pairing import friction_between
from pbfd_torch.contact.shapes import Box, Capsule, Collider, ConvexHull, Cylinder, Ellipsoid, Point, Shape, Sphere
from pbfd_torch.errors import ContactOverflowError, InputError
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.native.engine import Torch
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from tests.bodies import diagonal
from tests.states import implicit

BALL = Sphere(0.1)
HULL = ConvexHull(np.array([[0.0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0, 0, 0.2]]))
Names = set[frozenset[str]]


def link(name: str, parent: str = "", *kinds: JointKind) -> Link:
    joints = tuple(Joint(f"{name}_{k}", kind, ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))[k % 3]) for k, kind in enumerate(kinds))
    return Link(name, parent, joints=joints, mass=1.0, inertia=diagonal(0.1, 0.1, 0.1))


def tree() -> Articulation:
    """Stand and post are fixed to the world; plate rides on upper, foot on lower, which hangs on plate by three hinges."""
    hinge = JointKind.HINGE
    return Articulation.from_links(
        [
            link("stand"),
            link("post", "stand"),
            link("upper", "post", hinge),
            link("plate", "upper"),
            link("lower", "plate", hinge, hinge, hinge),
            link("foot", "lower"),
            link("hand", "upper", hinge),
            link("free", "", JointKind.FREE),
        ]
    )


def names_met(terms: Sequence[object], articulation: Articulation, obstacles: Sequence[Obstacle] = ()) -> Names:
    """Pairs of bodies that terms between round bodies know of."""
    names = (*articulation.link_names, *(x.name for x in obstacles))
    found = set()
    for term in terms:
        if isinstance(term, BodyContact):
            finder = term.finder
            first, second = (getattr(finder, side).tolist() for side in ("first", "second"))
            found |= {frozenset((names[a], names[b])) for a, b in zip(first, second, strict=True)}
    return found


def pairs(text: str) -> Names:
    """«a-b a-c» as a set of pairs."""
    return {frozenset(x.split("-")) for x in text.split()}


# who meets whom -----------------------------------------------------------------------------------------------------------

BETWEEN_LINKS = pairs(
    "stand-upper stand-plate stand-lower stand-foot stand-hand stand-free post-upper post-plate post-lower post-foot post-hand "
    "post-free upper-free plate-free lower-free foot-free hand-free lower-hand foot-hand"
)


@pytest.mark.parametrize(
    ("excluded", "gone"),
    [
        ((), ""),
        ([("hand", "foot"), ("free", "hand")], "foot-hand free-hand"),
        ({("upper", "lower"), ("post", "free")}, "post-free"),
    ],
)
def test_links_that_meet(excluded: Collection[tuple[str, str]], gone: str) -> None:
    """Not: links fixed to one another, and those that the joints of one link join, however many; but what is joined to the world
    meets it."""
    a = tree()
    colliders = [Collider(name, name, BALL) for name in a.link_names]
    (term,) = contact_terms(a, colliders, (), ContactRules(excluded=excluded))
    assert names_met([term], a) == BETWEEN_LINKS - pairs(gone)
    assert contact_terms(a, colliders, (), ContactRules(excluded=excluded, between_links=False)) == []


def test_obstacles_that_meet() -> None:
    """Nothing that stands meets an obstacle; excluded pairs do not either, of whichever kind the obstacle is."""
    a = tree()
    capsules = [Collider(name, name, Capsule(0.1, 0.2)) for name in a.link_names]
    stone = Obstacle("stone", BALL)
    rules = ContactRules(excluded=[("stone", "foot"), ("hand", "ground")], between_links=False)
    plane, round_pairs = contact_terms(a, capsules, (HalfSpace(), stone), rules)
    assert isinstance(plane, Contact)
    assert {one for one, _ in plane.pairs} == {"upper", "plate", "lower", "foot", "free"}
    assert names_met([round_pairs], a, [stone]) == pairs("stone-upper stone-plate stone-lower stone-hand stone-free")


@pytest.mark.parametrize(
    ("one", "other", "meet"),
    [((1, 1), (1, 1), True), ((1, 0), (0, 1), True), ((0, 1), (1, 0), True), ((1, 0), (1, 0), False), ((2, 4), (3, 8), False)],
)
def test_groups_and_masks(one: tuple[int, int], other: tuple[int, int], meet: bool) -> None:
    a = two_free()
    colliders = [Collider(n, n, BALL, group=g, mask=m) for n, (g, m) in zip(("a", "b"), (one, other), strict=True)]
    assert bool(contact_terms(a, colliders)) == meet
    alone, wall = colliders[:1], Obstacle("wall", Box((1, 1, 1)), group=other[0], mask=other[1])
    assert bool(contact_terms(a, alone, (wall,))) == meet


# which friction -----------------------------------------------------------------------------------------------------------


def test_friction_of_every_pair() -> None:
    a = tree()
    moving = {"upper": 0.2, "hand": 0.5, "free": 0.3}
    colliders = [Collider(name, name, Capsule(0.1, 0.2), friction=mu) for name, mu in moving.items()]
    colliders[2] = dataclasses.replace(colliders[2], priority=1)
    obstacles = (HalfSpace(friction=0.4), Obstacle("stone", BALL, friction=0.1, frictionless=True))
    plane, others = contact_terms(a, colliders, obstacles)
    assert isinstance(plane, Contact)
    assert isinstance(others, BodyContact)
    assert plane.grip is not None
    assert plane.grip.tolist() == [0.4, 0.4, 0.5, 0.5, 0.3, 0.3]  # two ends of a capsule each; the free one has priority
    finder = others.finder
    number, first, second = (getattr(finder, x).tolist() for x in ("pair", "first", "second"))
    solids = {a.link_index(c.link): c for c in colliders} | {a.nlink: obstacles[1]}
    expected = [friction_between(solids[i], solids[j]) for i, j in zip(first, second, strict=True)]
    assert others.grip[number].tolist() == expected
    assert sorted(expected) == [0.2, 0.3, 0.3, 0.3, 0.5]


# found by what ------------------------------------------------------------------------------------------------------------


def two_free() -> Articulation:
    return Articulation.from_links([link("a", "", JointKind.FREE), link("b", "", JointKind.FREE)])


ROUND, POLYTOPES, BALL_BOX, CURVED = ["RoundPairs"], ["PolytopePairs"], ["BallBoxPairs"], ["CurvedPairs"]
CLOSEST = ["ClosestPairs"]
BETWEEN: list[tuple[Shape, Shape, list[str]]] = [
    (BALL, BALL, ROUND),
    (BALL, Capsule(0.1, 0.2), ROUND),
    (Capsule(0.1, 0.2), Capsule(0.1, 0.2), ROUND),
    (BALL, Box((0.1, 0.1, 0.1)), BALL_BOX),
    (Box((0.1, 0.1, 0.1)), BALL, BALL_BOX),
    (Box((0.1, 0.1, 0.1)), Box((0.1, 0.1, 0.1)), POLYTOPES),
    (Capsule(0.1, 0.2), Box((0.1, 0.1, 0.1)), POLYTOPES),
    (HULL, BALL, POLYTOPES),
    (BALL, Cylinder(0.1, 0.2), ["BallCylinderPairs"]),
    (BALL, Ellipsoid((0.1, 0.2, 0.3)), CLOSEST),
    (Capsule(0.1, 0.2), Ellipsoid((0.1, 0.2, 0.3)), CLOSEST),
    (Ellipsoid((0.1, 0.2, 0.3)), Ellipsoid((0.1, 0.2, 0.3)), CLOSEST),
    (Cylinder(0.1, 0.2), Ellipsoid((0.1, 0.2, 0.3)), CURVED),
    (Cylinder(0.1, 0.2), Box((0.1, 0.1, 0.1)), CURVED),
    (Point(), BALL, []),
    (Point(), Point(), []),
]


@pytest.mark.parametrize(("one", "other", "finders"), BETWEEN)
def test_finder_between_links(one: Shape, other: Shape, finders: list[str]) -> None:
    terms = contact_terms(two_free(), [Collider("one", "a", one), Collider("other", "b", other)])
    assert [type(x.finder).__name__ for x in terms if isinstance(x, BodyContact)] == finders
    assert len(terms) == len(finders)


TERRAIN = HeightField(np.zeros((3, 3)), (1.0, 1.0))
AGAINST: list[tuple[Shape, HalfSpace | Obstacle, str]] = [
    *((shape, HalfSpace(), "Contact") for shape in (Point(), BALL, Box((0.1, 0.1, 0.1)), HULL)),
    *((shape, Obstacle("o", TERRAIN), "Contact") for shape in (BALL, HULL)),
    *((shape, Obstacle("o", Box((1, 1, 1))), "Contact") for shape in (Point(), BALL)),
    (BALL, Obstacle("o", HULL), "Contact"),
    (Capsule(0.1, 0.2), Obstacle("o", BALL), "RoundPairs"),
    (Box((0.1, 0.1, 0.1)), Obstacle("o", BALL), "BallBoxPairs"),
    (Cylinder(0.1, 0.2), Obstacle("o", BALL), "BallCylinderPairs"),
    (Ellipsoid((0.1, 0.2, 0.3)), Obstacle("o", BALL), "ClosestPairs"),
    (Capsule(0.1, 0.2), Obstacle("o", Box((1, 1, 1))), "PolytopePairs"),
    (HULL, Obstacle("o", Cylinder(0.1, 0.2)), "CurvedPairs"),
]


@pytest.mark.parametrize(("shape", "obstacle", "kind"), AGAINST)
def test_term_against_an_obstacle(shape: Shape, obstacle: HalfSpace | Obstacle, kind: str) -> None:
    """Candidate points where these say all there is to say, and contact between bodies only elsewhere."""
    (term,) = contact_terms(two_free(), [Collider("one", "a", shape)], (obstacle,))
    assert (type(term.finder).__name__ if isinstance(term, BodyContact) else type(term).__name__) == kind


def test_one_term_of_each_kind() -> None:
    """Many pairs of one kind share a term, numbered so that each has its own μ; a scene without colliders has none."""
    a = tree()
    shapes: dict[str, Shape] = {
        "stand": BALL,
        "upper": HULL,
        "lower": BALL,
        "hand": Capsule(0.1, 0.1),
        "free": Box((0.1, 0.1, 0.1)),
    }
    terms = contact_terms(a, [Collider(name, name, shape) for name, shape in shapes.items()], (HalfSpace(),))
    assert [type(x).__name__ for x in terms] == ["Contact", "BodyContact", "BodyContact", "BodyContact"]
    numbers = [k for x in terms if isinstance(x, BodyContact) for k in x.finder.pair.tolist()]  # type: ignore[attr-defined]
    assert sorted(numbers) == list(range(len(numbers)))
    assert contact_terms(a, [], (HalfSpace(), Obstacle("o", HULL))) == []


def test_fcl_is_needed_for_hulls_alone() -> None:
    """Steps in PyTorch do not import it for a chain on the ground, nor for boxes on boxes; a hull beside a box needs it."""
    program = """
import sys
import torch
from pbfd_torch.contact.shapes import Box, Collider
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Torch
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.terms.contact_terms import contact_terms
from pbfd_torch.terms.inertia import Inertia
from tests.test_contact_terms import HULL, two_free

def simulate(scene, q=None):
    simulator = Simulator(scene, 0.01, engine=Torch())
    state = simulator.initial_state(q)
    for _ in range(2):
        state, solution = simulator.step(state)
        assert bool(solution.solved.all())

chain = SCENES["chain-ground"](worlds=2)
simulate(chain.scene, chain.q)
for shape in (Box((0.1, 0.1, 0.1)), HULL):
    assert "fcl" not in sys.modules
    a = two_free()
    terms = contact_terms(a, [Collider("one", "a", Box((0.2, 0.2, 0.1))), Collider("other", "b", shape)])
    q = a.rest.clone()
    q[9] = 0.1 - shape.candidates()[0][:, 2].min() + 0.005
    simulate(Scene(a, (Inertia(), *terms), torch.zeros(3, dtype=torch.float64)), q[None])
assert "fcl" in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True, cwd=Path(__file__).parents[1])


# slots that are too few, and motion that is too fast ------------------------------------------------------------------------


def three_balls(**rules: object) -> Simulator:
    """Three free balls of .1 m without gravity."""
    a = Articulation.from_links([link(name, "", JointKind.FREE) for name in "abc"])
    colliders = [Collider(name, name, BALL) for name in "abc"]
    terms = contact_terms(a, colliders, (), ContactRules(NormalForce(1e5), **rules))  # type: ignore[arg-type]
    return implicit(Scene(a, (Inertia(), *terms), torch.zeros(3, dtype=torch.float64)), 0.01)


def balls_at(simulator: Simulator, *distances: float) -> torch.Tensor:
    """One world for each distance between neighbours, at the corners of a triangle."""
    q = simulator.scene.articulation.rest.repeat(len(distances), 1)
    for k, distance in enumerate(distances):
        q[k, [7, 14, 15]] = q.new_tensor([distance, 0.5 * distance, 0.75**0.5 * distance])
    return q


def three_steps(simulator: Simulator, *distances: float) -> Rollout:
    return simulator.rollout(simulator.initial_state(balls_at(simulator, *distances)), steps=3)


def test_too_few_slots_are_flagged_in_their_world_alone() -> None:
    """The middle world has three pairs near and two slots; the others have none, and one that is not near."""
    rollout = three_steps(three_balls(slots=2), 0.4, 0.199, 0.25)
    assert rollout.hazards.tolist() == [[0, int(Hazard.CANDIDATES_DROPPED), 0]] * 3
    state, _ = (simulator := three_balls(slots=2)).step(simulator.initial_state(balls_at(simulator, 0.199, 0.4)))
    assert state.hazards.tolist() == [int(Hazard.CANDIDATES_DROPPED), 0]
    assert not bool(three_steps(three_balls(slots=3), 0.4, 0.199).hazards.any())
    assert not bool(three_steps(three_balls(), 0.4, 0.199).hazards.any())


def test_the_deepest_ones_are_kept() -> None:
    """One slot for three pairs: the ball pushed in deeper is the one that is felt."""
    simulator = three_balls(slots=1)
    q = balls_at(simulator, 0.199)
    q[0, 7] = 0.19
    state = simulator.initial_state(q)
    (after,) = simulator.rollout(state, steps=1).q[-1]
    assert float(after[7]) > 0.1901
    assert after[14:16].tolist() == q[0, 14:16].tolist()


def test_overflow_can_raise() -> None:
    """Balls that fly together: the error comes in the step in which they are near, and brings the steps before it along."""
    simulator = three_balls(slots=2, overflow=Overflow.RAISE)
    q = balls_at(simulator, 0.28)
    v = -1.0 * (q[:, [0, 1, 2, 7, 8, 9, 14, 15, 16]] - q.new_tensor([0.14, 0.08, 0]).repeat(3))
    speeds = q.new_zeros(1, 18)
    speeds[:, [0, 1, 2, 6, 7, 8, 12, 13, 14]] = v
    with pytest.raises(ContactOverflowError, match=r"the 2 slots hold in 1 worlds: give more slots") as caught:
        simulator.rollout(simulator.initial_state(q, speeds), steps=100)
    rollout = caught.value.rollout
    assert isinstance(rollout, Rollout)
    assert 5 < len(rollout.status) < 100
    assert not bool(rollout.hazards.any())
    near = balls_at(simulator, 0.199)
    crowded = dataclasses.replace(simulator.initial_state(q), q=near, q_previous=near)
    with pytest.raises(ContactOverflowError) as caught:
        simulator.step(crowded)
    assert caught.value.rollout is None


def test_overflow_can_grow() -> None:
    """One slot that doubles until all fit gives the run with enough slots, where PyTorch makes both to the last bit."""
    rules: tuple[dict[str, object], ...] = ({"slots": 1, "overflow": Overflow.GROW}, {"slots": 4})
    grown, enough = (
        three_steps(Simulator(three_balls(**x).scene, 0.01, ImplicitEuler(), engine=Torch()), 0.4, 0.199) for x in rules
    )
    assert bool(grown.solved.all())
    assert not bool(grown.hazards.any())
    assert torch.equal(grown.q, enough.q)
    assert float(grown.q[-1, 1, 7] - grown.q[-1, 1, 0]) > 0.199 + 1e-4


def test_moving_further_than_detection_looked() -> None:
    """A motor pushes one world's ball .1 m in the first step, where its free motion is to stay."""
    a = Articulation.from_links([link("slider", "", JointKind.SLIDE), link("free", "", JointKind.FREE)])
    terms = contact_terms(a, [Collider(name, name, BALL) for name in a.link_names])
    motor = Actuators.from_list(a, [Actuator.motor("push", "slider_0")])
    simulator = implicit(Scene(a, (Inertia(), motor, *terms), torch.zeros(3, dtype=torch.float64)), 0.01)
    q = a.rest.repeat(3, 1)
    q[:, 2] = 1.0
    control = q.new_tensor([[0.0], [1000.0], [50.0]])
    rollout = simulator.rollout(simulator.initial_state(q), control[None].expand(2, 3, 1))
    assert rollout.q[1, :, 0].tolist() == pytest.approx([0, 0.1, 0.005], abs=1e-12)
    assert rollout.hazards.tolist() == [[0, int(Hazard.MOVED_TOO_FAR), 0]] * 2


# bad input ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Collider("c", "a", BALL, friction=-0.1), r"friction of collider 'c' is -0\.1: must be ≥ 0"),
        (lambda: Obstacle("o", BALL, friction=float("nan")), r"friction of obstacle 'o' is nan: must be ≥ 0"),
        (lambda: HalfSpace(friction=-1.0), r"friction of 'ground' is -1\.0"),
        (lambda: NormalForce(0.0), r"C⊥|stiffness"),
        (lambda: NormalForce(-1.0), r"C⊥|stiffness"),
        (lambda: Box((1.0, 0.0, 1.0)), r"box half extents is \(1\.0, 0\.0, 1\.0\): must be > 0"),
        (lambda: Sphere(-1.0), r"sphere radius is -1\.0: must be > 0"),
        (lambda: ContactRules(slots=0), r"slots is 0: must be ≥ 1"),
        (lambda: ContactRules(slots=-3), r"slots is -3: must be ≥ 1"),
        (lambda: contact_terms(two_free(), [Collider("c", "x", BALL)]), r"'x'.*a, b"),
        (
            lambda: contact_terms(two_free(), [], (HalfSpace(),), ContactRules(excluded=[("a", "x")])),
            r"excluded pairs name 'x': must be a link or an obstacle, of a, b, ground",
        ),
    ],
)
def test_bad_input(make: Callable[[], object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()
