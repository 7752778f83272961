"""Some worlds of a batch: what is taken for them acts as it did in the whole batch, bitwise; what is shared is not copied."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.surface import Plane
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.load import JointLoad, LinkLoad, Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import place
from tests.random_trees import generator, random_q, random_tree
from tests.term_cases import TERMS, Situation, TermCase, actuators, coefficients, contact, dry_torque, pushes, situation

TREE = random_tree(0)
POINTS = len(contact(situation(0), None).link)

# As many worlds as there are actuators, degrees of freedom, coordinates, links, joints or candidates: sizes must not matter.
SIZES = sorted({6, TREE.nv, TREE.nq, TREE.nlink, TREE.topology.njoint, POINTS})
BATCHES = ((), (2, 3), (1, 3), *((size,) for size in SIZES))
# Leading dimensions of a parameter, and the batch that they broadcast to.
LEADS = (((2, 3), (2, 3)), ((1, 3), (2, 3)), ((2, 1), (2, 3)), *(((size,), (size,)) for size in SIZES))

all_terms = pytest.mark.parametrize("case", TERMS, ids=str)
all_batches = pytest.mark.parametrize("batch", BATCHES, ids=str)
all_leads = pytest.mark.parametrize(("lead", "batch"), LEADS, ids=str)


def some(batch: tuple[int, ...]) -> Worlds:
    """The last but one, the first and the last world, in this order, where there are that many."""
    last = math.prod(batch) - 1
    return Worlds(batch, torch.tensor([last - 1, 0, last] if last > 1 else [0]))


def every(batch: tuple[int, ...]) -> Worlds:
    """All worlds in their order."""
    return Worlds(batch, torch.arange(math.prod(batch)))


def taken(s: Situation, worlds: Worlds) -> Situation:
    """The situation of some worlds."""
    return dataclasses.replace(
        s,
        articulation=s.articulation.take(worlds),
        state=s.state.take(worlds),
        q=worlds.pick(s.q, 1),
        control=None if s.control is None else worlds.pick(s.control, 1),
    )


def load_tensors(s: Situation, term: Term) -> list[tuple[Tensor, int]]:
    """The tensors of the term's load, each with the number of its own dimensions; forces held still have no stiffness."""
    load = term.load(term.prepare(s.context(s.q)), place(s.articulation, s.q))
    if isinstance(load, LinkLoad):
        return [(load.moment, 3)] + [(load.stiffness, 3)] * (not isinstance(term, Pushes))
    assert isinstance(load, JointLoad)
    return [(load.residual, 1), (load.stiffness, 2)]


def assert_equal(value: Tensor, expected: Tensor) -> None:
    assert torch.equal(value, expected)


def assert_close(value: Tensor, expected: Tensor) -> None:
    """Equal up to rounding: torch's matrix products and arc tangents round differently at other places in memory."""
    assert value.shape == expected.shape
    assert float((value - expected).abs().max()) <= 1e-15 * float(expected.abs().max())


def assert_taken_load_is_the_same(s: Situation, term: Term) -> None:
    """Load of the taken term in the taken situation = rows of the load in the whole batch, not all of them zero: bitwise where all
    worlds are taken in their order."""
    whole = load_tensors(s, term)
    for worlds, check in ((every(s.q.shape[:-1]), assert_equal), (some(s.q.shape[:-1]), assert_close)):
        for (value, rank), (part, _) in zip(whole, load_tensors(taken(s, worlds), term.take(worlds)), strict=True):
            assert value.shape[: value.ndim - rank] == worlds.batch
            check(part, worlds.pick(value, rank))
            assert bool((part != 0).any())


@all_terms
@all_batches
def test_load_of_some_worlds(case: TermCase, batch: tuple[int, ...]) -> None:
    """Every term with the parameters that it shares between worlds, with per-world limits and, for contacts, ground heights."""
    s = situation(0, batch)
    assert_taken_load_is_the_same(s, case.build(s))


# Parameters per world -------------------------------------------------------------------------------------------------


def spread(value: float | Tensor, lead: tuple[int, ...], event: tuple[int, ...] = ()) -> Tensor:
    """`[*lead, *event]` between one and two times the value, which broadcasts to that shape; the entries of one world share a
    factor, so that coefficients of a rotation stay equal about its three axes."""
    factor = 1 + torch.rand(*lead, *[1] * len(event), dtype=torch.float64, generator=generator(23))
    return (factor * torch.as_tensor(value, dtype=torch.float64)).expand(*lead, *event)


def tilted(s: Situation, lead: tuple[int, ...]) -> Contact:
    """A contact of points whose ground has another normal, and whose candidates other places, in every world."""
    made = contact(s, CoulombFriction(0.7, 50.0))
    assert isinstance(made.surface, Plane)
    normal = made.surface.normal + 0.02 * torch.randn(*lead, 1, 3, dtype=torch.float64, generator=generator(29))
    unit = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    return dataclasses.replace(made, surface=Plane(unit, made.surface.offset), position=spread(made.position, lead, (POINTS, 3)))


def lagged(s: Situation, lead: tuple[int, ...]) -> Contact:
    """A contact whose friction is held at the normal forces of each world."""
    made = contact(s, CoulombFriction(spread(0.4, lead, (POINTS,)), 50.0))
    return made.lagged(made.prepare(s.context(s.q)), place(s.articulation, s.q))


def actuators_per_world(s: Situation, lead: tuple[int, ...]) -> Actuators:
    bank = actuators(s)
    names = ("gear", "gain", "bias", "stiffness", "damping", "control_range", "force_range")
    changes: dict[str, Any] = {name: spread(getattr(bank, name), lead, getattr(bank, name).shape) for name in names}
    return dataclasses.replace(bank, **changes)


def pushes_per_world(s: Situation, lead: tuple[int, ...]) -> Pushes:
    one = pushes(s)
    return Pushes(spread(one.force, lead, one.force.shape), spread(one.point, lead, one.point.shape))


def with_law(s: Situation, stiffness: Tensor) -> Contact:
    return dataclasses.replace(contact(s, CoulombFriction(0.7, 50.0)), normal_force=NormalForce(stiffness))


def firm(s: Situation, lead: tuple[int, ...]) -> Contact:
    """How firm candidates are, and how deep they may be."""
    return dataclasses.replace(contact(s, None), firm=spread(2.0, lead, (POINTS,)), deep=spread(1e-3, lead, (POINTS,)))


@dataclass(frozen=True)
class ParameterCase:
    """`build` makes a term whose parameters have the leading dimensions `lead`."""

    name: str
    build: Callable[[Situation, tuple[int, ...]], Term]

    def __str__(self) -> str:
        return self.name


PARAMETERS = (
    ParameterCase("C⊥ per world", lambda s, lead: with_law(s, spread(1e4, lead, (1,)))),
    ParameterCase("C⊥ per candidate", lambda s, lead: with_law(s, spread(1e4, lead, (POINTS,)))),
    ParameterCase("firmness per candidate", firm),
    ParameterCase("μ per world", lambda s, lead: contact(s, CoulombFriction(spread(0.4, lead, (1,)), 50.0))),
    ParameterCase("μ per candidate", lambda s, lead: contact(s, CoulombFriction(spread(0.4, lead, (POINTS,)), 50.0))),
    ParameterCase("C∥ per candidate", lambda s, lead: contact(s, PbfdFriction.as_printed(spread(5e4, lead, (POINTS,))))),
    ParameterCase("lagged friction", lagged),
    ParameterCase("normals and places", tilted),
    ParameterCase("limits", lambda s, lead: JointLimits(spread(coefficients(s, 50.0), lead, (TREE.nv,)))),
    ParameterCase("damping", lambda s, lead: JointDamping(spread(coefficients(s, 1.0), lead, (TREE.nv,)))),
    ParameterCase("armature", lambda s, lead: Armature(spread(coefficients(s, 0.1), lead, (TREE.nv,)))),
    ParameterCase(
        "springs", lambda s, lead: JointSprings(spread(coefficients(s, 20.0), lead, (TREE.nv,)), random_q(TREE, 17, lead))
    ),
    ParameterCase("dry friction", lambda s, lead: JointDryFriction(spread(dry_torque(s), lead, (TREE.nv,)), 50.0)),
    ParameterCase("actuators", actuators_per_world),
    ParameterCase("pushes", pushes_per_world),
)
all_parameters = pytest.mark.parametrize("case", PARAMETERS, ids=str)


@all_parameters
@all_leads
def test_load_of_some_worlds_with_their_own_parameters(case: ParameterCase, lead: tuple[int, ...], batch: tuple[int, ...]) -> None:
    """As above where the term's parameters differ from world to world, or along one of two batch dimensions."""
    s = situation(0, batch)
    assert_taken_load_is_the_same(s, case.build(s, lead))


def test_parameter_cases_reach_every_tensor() -> None:
    """Each tensor of each term, law and articulation differs between worlds in some case, but for what is always shared."""
    s = situation(0, (5,))
    shared = {"link", "radius", "margin", "coordinate", "dof"}
    seen: dict[tuple[str, str], bool] = {}

    def visit(thing: object) -> None:
        if dataclasses.is_dataclass(thing):
            for field in dataclasses.fields(thing):
                value = getattr(thing, field.name)
                visit(value)
                if isinstance(value, Tensor) and field.name not in shared:
                    key = (type(thing).__name__, field.name)
                    seen[key] = seen.get(key, False) or value.shape[:1] == (5,)

    for case in PARAMETERS:
        visit(case.build(s, (5,)))
    visit(varied(s, (5,)).articulation)
    assert len(seen) > 20
    assert [key for key, per_world in seen.items() if not per_world] == []


def varied(s: Situation, lead: tuple[int, ...]) -> Situation:
    """The situation with masses, frames, axes, references, limits and a rest configuration of their own in each world."""
    a = s.articulation
    random = generator(31)

    def near(value: Tensor) -> Tensor:
        return value + 0.02 * torch.randn(*lead, *value.shape, dtype=torch.float64, generator=random)

    moved = {name: getattr(a, name).repeat(*lead, 1, 1, 1) for name in ("joint_frame", "link_frame")}
    for frames in moved.values():
        frames[..., :3, 3] = near(frames[(0,) * len(lead)][:, :3, 3])
    axis = near(a.joint_axis)
    changes = {
        **moved,
        "joint_axis": axis / torch.linalg.vector_norm(axis, dim=-1, keepdim=True),
        "joint_ref": near(a.joint_ref),
        "pseudo_inertia": spread(a.pseudo_inertia, lead, a.pseudo_inertia.shape),
        "rest": near(a.rest),
    }
    return dataclasses.replace(s, articulation=dataclasses.replace(a, **changes))


@all_leads
def test_articulations_of_some_worlds(lead: tuple[int, ...], batch: tuple[int, ...]) -> None:
    """Per-world masses, frames, axes, references and limits: the poses and the inertial loads are those of the whole batch."""
    s = varied(situation(0, batch), lead)
    worlds = some(batch)
    assert_taken_load_is_the_same(s, Inertia())
    part = taken(s, worlds)
    assert part.articulation.topology is s.articulation.topology
    for field in dataclasses.fields(Articulation):
        value = getattr(part.articulation, field.name)
        if isinstance(value, Tensor):
            assert value.shape[0] == len(worlds.index)


# What is shared, and the parts ----------------------------------------------------------------------------------------


@all_terms
@pytest.mark.parametrize("size", SIZES)
def test_what_worlds_share_is_not_copied(case: TermCase, size: int) -> None:
    """A term without parameters per world is its own part, however many worlds there are; so is such an articulation."""
    term = case.build(situation(0))
    worlds = some((size,))
    assert term.take(worlds) is term
    assert TREE.take(worlds) is TREE


@pytest.mark.parametrize("friction", [CoulombFriction, PbfdFriction.as_printed], ids=["Coulomb", "PBFD"])
def test_only_what_differs_is_copied(friction: Callable[[Tensor], FrictionLaw]) -> None:
    """A friction coefficient per world: the rest of the contact, and a coefficient `[npoint]`, stay the same objects."""
    s = situation(0)
    worlds = some((POINTS,))
    made = contact(s, friction(torch.full((POINTS, POINTS), 0.5, dtype=torch.float64)))
    part = made.take(worlds)
    assert part is not made
    assert part.friction is not made.friction
    for name in ("link", "position", "radius", "margin", "surface", "normal_force", "pairs"):
        assert getattr(part, name) is getattr(made, name)
    shared = contact(s, friction(torch.full((POINTS,), 0.5, dtype=torch.float64)))
    assert shared.take(worlds) is shared


@all_terms
def test_some_of_some_worlds(case: TermCase) -> None:
    """Worlds 1 and 2 of worlds (4, 0, 5) are worlds (0, 5)."""
    s = situation(0, (2, 3))
    term = case.build(s)
    first, second = some((2, 3)), Worlds((3,), torch.tensor([1, 2]))
    both = Worlds((2, 3), first.index[second.index])
    twice = load_tensors(taken(taken(s, first), second), term.take(first).take(second))
    once = load_tensors(taken(s, both), term.take(both))
    assert all(torch.equal(a, b) for (a, _), (b, _) in zip(twice, once, strict=True))


def test_pick() -> None:
    """Rows in the order of the index; numbers and values without leading dimensions come back themselves; gradients pass."""
    worlds = Worlds((2, 3), torch.tensor([4, 0, 4]))
    value = torch.arange(12, dtype=torch.float64).view(2, 3, 2).requires_grad_()
    assert worlds.pick(value, 1).tolist() == [[8, 9], [0, 1], [8, 9]]
    assert worlds.pick(value[1:], 1).tolist() == [[8, 9], [6, 7], [8, 9]]
    assert worlds.pick(value[1], 1).tolist() == [[8, 9], [6, 7], [8, 9]]
    assert worlds.pick(value[:, :1, 0], 0).tolist() == [6, 0, 6]
    worlds.pick(value, 1).sum().backward()
    assert value.grad is not None
    assert value.grad[..., 0].tolist() == [[1, 0, 0], [0, 2, 0]]
    for shared, rank in ((torch.ones(()), 0), (torch.ones(()), 1), (torch.ones(3), 1), (torch.ones(2, 3), 2)):
        assert worlds.pick(shared, rank) is shared
    assert worlds.pick(0.5, 1) == 0.5
    alone = torch.ones(4)
    assert Worlds((), torch.tensor([0])).pick(alone, 1) is alone


def test_replaced() -> None:
    """Changes fields, skips the checks, leaves cached properties behind; without a change it gives the instance itself."""
    made = contact(situation(0), None)
    assert not made.rounded
    assert replaced(made) is made
    assert replaced(made, radius=made.radius, friction=None) is made
    other = replaced(made, radius=made.radius + 1)
    assert other.rounded
    assert not made.rounded
    assert other.position is made.position
    assert replaced(NormalForce(1.0), stiffness=-1.0).stiffness == -1.0
