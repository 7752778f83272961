"""Friction with anchors in the compiled core: the reference's forces, steps and memory; what stands does not creep."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.bench.hard_cases_scenes import box_on_slope
from pbfd_torch.bench.starts import scattered
from pbfd_torch.contact.primitives import SegmentSurface
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Point, Shape, Sphere
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Native, Torch
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import NativeStepper, uncovered
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction, DryFriction
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.kinematics import place
from tests.native_parity import DT, compared, require_balance, resting
from tests.test_native_contact import (
    BALLS,
    CONVEX,
    CURVED,
    GROUND,
    SOLIDS,
    WALL,
    Solid,
    beside,
    free_body,
    require_touching,
    touching,
)
from tests.test_native_fallbacks import started

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

STRETCH = 1e-3


def anchored(scene: Scene, stretch: float = STRETCH, plain: Sequence[int] = ()) -> Scene:
    """The same with anchors in all contacts, but for some terms."""

    def held(k: int, term: Term) -> Term:
        if k in plain or not isinstance(term, Contact) or not isinstance(term.friction, DryFriction):
            return term
        return dataclasses.replace(term, friction=AnchoredFriction(term.friction.mu, stretch))

    return dataclasses.replace(scene, terms=tuple(held(k, term) for k, term in enumerate(scene.terms)))


def stretched(scene: Scene, state: Any, size: float = STRETCH, seed: int = 7) -> Any:
    """A state in which anchors are behind by something, to all sides."""
    random = torch.Generator().manual_seed(seed)
    blank = [term.memory(tuple(state.q.shape[:-1])) for term in scene.terms if isinstance(term, Contact)]
    drawn = (torch.randn(x.shape, dtype=torch.float64, generator=random).to(x.dtype) for x in blank)
    return dataclasses.replace(state, memory=tuple(size * x for x in drawn))


def require_kept(
    native: NativeStepper[Any], state: Any, control: Tensor | None, after: Any, solution: Solution, rounding: float = 1e-12
) -> int:
    """What is remembered after steps that were not halved is what the reference keeps of steps that ended there; how many were."""
    whole = solution.solved & (solution.status != int(Status.HALVED))
    placement = place(native.eager.articulation, after.q)
    kept = native.eager.objective(state, control).aftermath(placement).memory
    assert [x.shape for x in after.memory] == [x.shape for x in kept]
    for ours, theirs in zip(after.memory, kept, strict=True):
        assert torch.allclose(ours[whole], theirs[whole], rtol=0, atol=rounding)
    return int(whole.sum())


KINDS: list[tuple[Sequence[Shape], Sequence[Solid], Any]] = [
    ((Point(), Box((0.05, 0.04, 0.03))), (GROUND, WALL), Contact),
    ((Point(), Sphere(0.05), Capsule(0.03, 0.1)), (WALL, GROUND), Contact),
    (CURVED, (GROUND, WALL), CurvedContact),
    *((BALLS, (solid,), Contact) for solid in SOLIDS.values()),
    *((CURVED, (SOLIDS[name],), CurvedContact) for name in sorted(SOLIDS.keys() - CONVEX.keys())),
]


@pytest.mark.parametrize(("shapes", "solids", "kind"), KINDS)
def test_every_kind_of_contact(shapes: Sequence[Shape], solids: Sequence[Solid], kind: Any) -> None:
    """The same forces and derivatives, short of the stretch and beyond it, and the same memory after a step."""
    scene = anchored(touching(shapes, solids, kind))
    state, q = beside(scene, 120)
    state = stretched(scene, state)
    require_touching(scene, state, q)
    require_balance(scene, state, q)
    start, _ = beside(scene, 24, 5)
    for integrator in (None, ImplicitEuler()):
        simulator = Simulator(scene, DT, integrator)
        state = stretched(scene, started(simulator, start.q, start.v))
        native = NativeStepper(simulator.eager)
        after, solution, _ = native.made(state, None)
        assert require_kept(native, state, None, after, solution) >= 20
        assert max(float(x.abs().max()) for x in after.memory) > 0.1 * STRETCH


def on_the_world() -> Scene:
    """Two links that move and one that rides on the world, all with colliders of all; anchors in two of three contacts."""
    eye = ((0.01, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.015))
    links = [
        Link("first", joints=(Joint("free", JointKind.FREE),), mass=1.0, inertia=eye),
        Link("fixed", position=(0.3, 0.0, 0.1)),
        Link("second", "first", (0.3, 0.0, 0.1), joints=(Joint("hinge", JointKind.HINGE),), mass=0.5, inertia=eye),
    ]
    a = Articulation.from_links(links)
    links_of = ("second", "fixed", "first", "fixed", "second")
    shapes: list[Shape] = [Sphere(0.05), Sphere(0.1), *BALLS]
    colliders = [Collider(f"c{k}", links_of[k], shape, (0.05 * k, 0.02, 0.0)) for k, shape in enumerate(shapes)]
    contacts = [
        Contact.between(a, some, solid, NormalForce(1e5), friction)
        for some, solid, friction in (
            (colliders, GROUND, AnchoredFriction(0.7, STRETCH)),
            (colliders[:3], SOLIDS["terrain"], CoulombFriction(0.7)),
            (colliders[::-1], WALL, AnchoredFriction(0.4, 3 * STRETCH)),
        )
    ]
    return Scene(a, (Inertia(), *contacts), torch.tensor([0.3, 0.0, -9.81], dtype=torch.float64))


def test_anchors_beside_contacts_without() -> None:
    """And beside links that do not move, whose anchors have nothing to be behind by."""
    scene = on_the_world()
    fixed = scene.articulation.link_index("fixed")
    contacts = [term for term in scene.terms if isinstance(term, Contact)]

    def behind(state: Velocities) -> Velocities:
        state = stretched(scene, state)
        moves = [(contact.link != fixed).double()[:, None] for contact in contacts]
        some = zip(state.memory, moves, strict=True)
        return dataclasses.replace(state, memory=tuple(x * y if x.numel() else x for x, y in some))

    state, q = beside(scene, 120)
    require_balance(scene, behind(state), q)
    state = behind(beside(scene, 24, 5)[0])
    native = NativeStepper(Simulator(scene, DT).eager)
    after, solution, _ = native.made(state, None)
    assert [x.shape[1:] for x in after.memory] == [(5, 3), (0, 3), (5, 3)]
    assert require_kept(native, state, None, after, solution) >= 20


@pytest.mark.parametrize("solid", ["box", "cylinder", "terrain", "grid"])
def test_steps_end_where_the_reference_ends(solid: str) -> None:
    """With the same memory, step after step."""
    scene = anchored(touching(BALLS, (SOLIDS[solid], GROUND)))
    simulator = Simulator(scene, DT)
    native = NativeStepper(simulator.eager)
    start, _ = beside(scene, 12, 5)
    state = stretched(scene, simulator.initial_state(start.q, start.v))
    pairs = compared(native, state, None, 6)
    pairs.require_roots()
    pairs.require_same()
    for ours, theirs in zip(pairs.after.memory, pairs.expected.memory, strict=True):
        assert torch.allclose(ours[pairs.alike], theirs[pairs.alike], rtol=0, atol=1e-7)


def block(slope: float, shares: Sequence[float]) -> tuple[Scene, Tensor]:
    """A flat block on a slope [rad] that is these shares of the cone of its friction, one a world."""
    mu = math.tan(slope) / torch.tensor(shares, dtype=torch.float64)[:, None]
    scene, q = box_on_slope(AnchoredFriction(mu), torch.tensor([slope], dtype=torch.float64))
    return dataclasses.replace(scene, gravity=scene.gravity[0]), q.expand(len(shares), -1)


@pytest.mark.parametrize("integrator", [None, ImplicitEuler()])
def test_what_stands_does_not_creep(integrator: Any) -> None:
    """For 1000 steps at half and .98 of the cone, and to the reference it would stand on; at 1.02 of it the block slides."""
    scene, q = block(0.4, (0.5, 0.98, 1.02))
    compiled, defined = (Simulator(scene, 0.1, integrator, engine=engine) for engine in (Native(), Torch()))
    state = compiled.initial_state(q)
    assert isinstance(compiled.stepper, NativeStepper)
    states, solution = compiled.stepper.run(state, None, 1000)
    assert bool(solution.solved.all())
    moved = (states.q[-1] - states.q[499])[:, :3].norm(dim=-1)
    assert float(moved[:2].max()) < 1e-9 * 50
    assert float(moved[2]) > 1.0
    assert float((states.q[-1] - q)[:2].abs().max()) < 1e-4
    assert float(states.memory[0][-1, :2].norm(dim=-1).amax(-1).min()) > 0.2 * 1e-5
    for k in range(100):
        state, _, _ = defined.stepper.made(state, None)
        assert torch.allclose(states.memory[0][k], state.memory[0], rtol=0, atol=1e-9)
        assert torch.allclose(states.q[k], state.q, rtol=1e-7, atol=1e-7)
    last = Worlds((3,), torch.tensor([0, 1]))
    end = mapped(lambda x: x[-1], states).take(last)
    again, _, _ = defined.stepper.take(last).made(end, None)
    assert torch.allclose(again.memory[0], end.memory[0], rtol=0, atol=1e-11)


def test_stick_and_slip() -> None:
    """A sled that is pushed back and forth beyond what its runners hold stops, stands and slides as the reference has it."""
    inertia = ((0.02, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.02))
    joints = (Joint("x", JointKind.SLIDE, (1.0, 0.0, 0.0)), Joint("z", JointKind.SLIDE, (0.0, 0.0, 1.0)))
    a = Articulation.from_links([Link("sled", joints=joints, mass=1.0, inertia=inertia)])
    contact = Contact.between(
        a, [Collider("runners", "sled", Box((0.2, 0.1, 0.05)))], GROUND, NormalForce(1e6), AnchoredFriction(0.5)
    )
    terms: tuple[Term, ...] = (Inertia(), contact, Actuators.from_list(a, [Actuator.motor("push", "x")]))
    scene = Scene(a, terms, torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64))
    steps, worlds = 150, 4
    time = DT * torch.arange(steps, dtype=torch.float64)[:, None, None]
    push = 6.0 * torch.sin(2.5 * time + torch.arange(worlds)[:, None])
    q = torch.tensor([0.0, 0.05 - 1.56e-3], dtype=torch.float64).expand(worlds, -1)
    records, memories = [], []
    for engine in (Native(), Torch()):
        simulator = Simulator(scene, DT, engine=engine)
        state, states = simulator.initial_state(q, control=push[0]), []
        for control in push:
            state, solution = simulator.step(state, control)
            assert bool(solution.solved.all())
            states.append(state)
        records.append(torch.stack([x.q for x in states]))
        memories.append(torch.stack([x.memory[0] for x in states]))
    moved = records[1].diff(dim=0)[..., 0].abs()
    stuck = moved < 1e-5
    assert bool((stuck[1:] & ~stuck[:-1]).any(0).all())
    assert bool((~stuck[1:] & stuck[:-1]).any(0).all())
    assert torch.allclose(records[0], records[1], rtol=0, atol=1e-6)
    assert torch.allclose(memories[0], memories[1], rtol=0, atol=1e-8)


WORLDS = 33
FALLBACKS = [("walker", 0.05, None), ("chain-slope", 0.1, None), ("hopper", 0.1, ImplicitEuler())]


def thrown(name: str, dt: float, integrator: Any, dtype: torch.dtype = torch.float64) -> tuple[NativeStepper[Any], Any, Tensor]:
    """Worlds that overlap and spin at the start, with anchors, and random controls."""
    setup = SCENES[name](worlds=WORLDS, dtype=dtype)
    simulator = Simulator(anchored(setup.scene), dt, integrator)
    random = torch.Generator().manual_seed(1)
    controls = 2 * torch.rand(20, WORLDS, setup.scene.nu, dtype=torch.float64, generator=random) - 1
    return NativeStepper(simulator.eager), started(simulator, *scattered(setup, 0, 0.3, 3.0)), controls.to(dtype)


@pytest.mark.parametrize(("name", "dt", "integrator"), FALLBACKS)
def test_through_fallbacks(name: str, dt: float, integrator: Any) -> None:
    """What is remembered after detours and easier steps is of where they have ended."""
    native, state, controls = thrown(name, dt, integrator)
    counted = torch.zeros(4, dtype=torch.int64)
    judged = 0
    for control in controls:
        after, solution, _ = native.made(state, control)
        assert bool(solution.solved.all())
        judged += require_kept(native, state, control, after, solution)
        counted += solution.fallbacks.sum(0)
        state = after
    assert judged > 0.7 * WORLDS * len(controls)
    assert int(counted[:3].sum()) > 20


def test_through_shorter_steps() -> None:
    """Each hands its anchors on to the next: to the reference's memory. Plates that are thrown at the ground, spinning fast."""
    scene, worlds = anchored(free_body(Box((0.15, 0.1, 0.02)), GROUND)), 90
    random = torch.Generator().manual_seed(3)
    q = scene.articulation.rest.repeat(worlds, 1)
    q[:, 2] = 0.05 + 0.005 * torch.arange(worlds)
    v = torch.randn(worlds, 6, dtype=torch.float64, generator=random)
    v[:, 2] -= 2.0
    v[:, 3:] *= 12.0
    native, state, judged = NativeStepper(Simulator(scene, 0.07).eager), resting(q, v), 0
    for _ in range(8):
        after, solution, _ = native.made(state, None)
        halved = Worlds((worlds,), (solution.status == int(Status.HALVED)).nonzero().squeeze(-1))
        end, found, _ = native.eager.take(halved).made(state.take(halved), None)
        ours = after.take(halved)
        alike = (found.status == int(Status.HALVED)) & ((end.q - ours.q).abs().amax(-1) < 1e-7)
        assert torch.allclose(ours.memory[0][alike], end.memory[0][alike], rtol=0, atol=1e-9)
        judged += int((end.memory[0][alike] != 0).any(-1).any(-1).sum())
        state = after
    assert judged >= 5


@pytest.mark.parametrize("integrator", [None, ImplicitEuler()])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_no_lane_knows_another(dtype: torch.dtype, integrator: Any) -> None:
    """To the bit, memory and all: in a batch, in another place of it, by itself, on threads, in one call and in many."""
    native, state, controls = thrown("walker", 0.05, integrator, dtype)
    states, solution = native.run(state, controls, 20)
    assert int(solution.fallbacks.sum()) > 20
    memory = states.memory[0]
    assert memory.dtype == dtype
    assert float(memory.abs().amax()) > 0.9 * STRETCH
    order = torch.randperm(WORLDS, generator=torch.Generator().manual_seed(3))
    for index in (order, order[:5], order[7:8], order[8:9]):
        some, _ = native.run(state.take(Worlds((WORLDS,), index)), controls[:, index], 20)
        assert torch.equal(some.q, states.q[:, index])
        assert torch.equal(some.memory[0], memory[:, index])
    threaded, _ = NativeStepper(native.eager, threads=3).run(state, controls, 20)
    assert torch.equal(threaded.memory[0], memory)
    for k, control in enumerate(controls):
        after, solution, _ = native.made(state, control)
        assert torch.equal(after.q, states.q[k])
        assert torch.equal(after.memory[0], memory[k])
        require_kept(native, state, control, after, solution, 1e-12 if dtype is torch.float64 else 2e-6)
        state = after


def test_batches_of_any_shape() -> None:
    """And a world that is not finite keeps its memory, while the others are as without it."""
    scene, q = block(0.4, (0.7,))
    simulator = Simulator(scene, 0.02)
    native = NativeStepper(simulator.eager)
    state = stretched(scene, simulator.initial_state(q.repeat(6, 1)), 1e-5)
    flat, _, _ = native.made(state, None)
    folded, _, _ = native.made(mapped(lambda x: x.reshape(2, 3, *x.shape[1:]), state), None)
    assert folded.memory[0].shape == (2, 3, 8, 3)
    assert torch.equal(folded.memory[0].reshape(6, 8, 3), flat.memory[0])
    alone, _, _ = native.made(state.take(Worlds((6,), torch.tensor([2]))), None)
    assert torch.equal(alone.memory[0][0], flat.memory[0][2])
    state.v[4] = torch.nan
    sick, solution, _ = native.made(state, None)
    assert solution.status.tolist() == [0, 0, 0, 0, int(Status.NON_FINITE), 0]
    assert torch.equal(sick.memory[0][4], state.memory[0][4])
    others = torch.tensor([0, 1, 2, 3, 5])
    assert torch.equal(sick.memory[0][others], flat.memory[0][others])


def test_rollouts_record_what_the_engine_in_pytorch_records() -> None:
    """Contact forces and slips from anchors too, also from a state that remembers nothing yet."""
    scene, q = block(0.4, (0.5, 0.98))
    records = []
    for engine in (Native(), Torch()):
        simulator = Simulator(scene, 0.05, engine=engine)
        start = dataclasses.replace(simulator.initial_state(q), memory=())
        records.append(simulator.rollout(start, steps=12))
    for name, values in vars(records[1]).items():
        if isinstance(values, Tensor) and name not in ("iterations", "evaluations", "residual_norm", "lanes"):
            assert torch.allclose(getattr(records[0], name).double(), values.double(), rtol=1e-6, atol=1e-6), name


class OwnFriction(CoulombFriction):
    """A user's own, which the core cannot know."""


def test_what_is_not_covered_is_said() -> None:
    """Other laws, and capsules that lie askew in their own frames, in which anchors are told."""
    scene = touching(BALLS, (SOLIDS["capsule"],))
    contact = scene.terms[1]
    assert isinstance(contact, Contact)
    assert isinstance(contact.surface, SegmentSurface)
    skew = dataclasses.replace(contact.surface, start=contact.surface.start + 0.01)
    for changes, words in (
        ({"friction": OwnFriction(0.5)}, "OwnFriction"),
        ({"friction": AnchoredFriction(0.5), "surface": skew}, "anchors on 'pill', a capsule that does not lie along z"),
    ):
        other = dataclasses.replace(scene, terms=(scene.terms[0], dataclasses.replace(contact, **changes)))
        assert uncovered(Simulator(other, DT).eager) == f"the core does not know {words}"
