"""Obstacles that move, in the compiled core: the reference's forces and derivatives beside them wherever they are, its steps from
any time on, halved ones too, its records; and a world goes its way whatever the times of the others are."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.motion import Motion, Turntable
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Collider, Sphere
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Native
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import NativeStepper, uncovered
from pbfd_torch.solvers.objective import Status
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.tree.kinematics import place, retract
from tests.bodies import diagonal
from tests.native_moving import MOTIONS, SCHEMES, crowd, drawn, laid, riding, thrown, timed
from tests.native_parity import DT, fields, require_balance, require_same_steps, resting
from tests.native_parity import begun as begun_from
from tests.native_piles import SHAPES
from tests.test_native_anchors import anchored, require_kept, stretched
from tests.test_native_contact import BALLS, CONVEX, CURVED, GROUND, SOLIDS, beside, require_touching, touching
from tests.test_native_fallbacks import require_equal
from tests.test_native_records import recorded, require_same

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

PLANE = {"plane": HalfSpace("plane", (0.1, -0.2, 0.9), -0.1)}
BESIDE: list[tuple[str, Any]] = [(name, Contact) for name in (PLANE | SOLIDS)]
BESIDE += [(name, CurvedContact) for name in sorted((PLANE | SOLIDS).keys() - CONVEX.keys())]


def placed(solid: Any, worlds: int, motion: Motion) -> Any:
    """The solid in motion, elsewhere in each world if it is an obstacle."""
    if isinstance(solid, HalfSpace):
        return dataclasses.replace(solid, motion=motion)
    position, quaternion = torch.tensor(solid.position).double(), torch.tensor(solid.quaternion).double()
    moved = position + 0.1 * drawn(worlds, 3, seed=3), quaternion + 0.1 * drawn(worlds, 4, seed=4)
    return dataclasses.replace(solid, position=moved[0], quaternion=moved[1], motion=motion)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize(("solid", "kind"), BESIDE)
def test_candidates_beside_solids(solid: str, kind: Any, motion: str) -> None:
    """Forces and derivatives, at other times in each world."""
    worlds = 60
    moving = placed((PLANE | SOLIDS)[solid], worlds, MOTIONS[motion])
    scene = touching(BALLS if kind is Contact else CURVED, (moving, GROUND), kind)
    state, q = beside(scene, worlds, time=drawn(worlds, seed=5) + 1)
    require_touching(scene, state, q)
    require_balance(scene, state, q)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize(("solid", "kind"), BESIDE)
def test_anchors_are_carried_along(solid: str, kind: Any, motion: str) -> None:
    """Forces and derivatives with what anchors remember, and what they remember after a step."""
    worlds = 24
    moving = placed((PLANE | SOLIDS)[solid], worlds, MOTIONS[motion])
    scene = anchored(touching(BALLS if kind is Contact else CURVED, (moving, GROUND), kind))
    state, q = beside(scene, worlds, time=drawn(worlds, seed=5) + 1)
    state = stretched(scene, state)
    require_balance(scene, state, q)
    native = NativeStepper(Simulator(scene, DT).eager)
    after, solution, _ = native.made(state, None)
    assert require_kept(native, state, None, after, solution) >= 15
    assert max(float(x.abs().max()) for x in after.memory) > 1e-4


@pytest.mark.parametrize(("solid", "kind"), BESIDE)
def test_what_is_thrown_back(solid: str, kind: Any) -> None:
    """By how fast it meets the solid as that moves."""
    moving = placed((PLANE | SOLIDS)[solid], 60, MOTIONS["rocking"])
    scene = touching(BALLS if kind is Contact else CURVED, (moving, GROUND), kind)
    terms = [dataclasses.replace(x, restitution=Restitution(0.5)) if isinstance(x, Contact) else x for x in scene.terms]
    scene = dataclasses.replace(scene, terms=terms)
    state, q = beside(scene, 60, speed=1.0, time=drawn(60, seed=5) + 1)
    objective = Simulator(scene, DT).eager.objective(state)
    assert any(bool((x.bounce > 0).any()) for x in objective.prepared if x is not None and getattr(x, "bounce", None) is not None)
    require_balance(scene, state, q)


@pytest.mark.parametrize("solid", CONVEX)
def test_fast_balls_do_not_pass_through(solid: str) -> None:
    worlds = 60
    scene = touching(BALLS, (placed(CONVEX[solid], worlds, MOTIONS["rocking"]),))
    state, q = beside(scene, worlds, speed=10.0, time=drawn(worlds, seed=5) + 1)
    prepared = Simulator(scene, DT).eager.objective(state).prepared[1]
    assert 0.2 < float(prepared.surface.passed.double().mean()) < 0.8
    require_balance(scene, state, q)


@pytest.mark.parametrize("shapes", SHAPES)
@pytest.mark.parametrize("motion", MOTIONS)
def test_bodies_on_obstacles(motion: str, shapes: str) -> None:
    """Several at once; where the table begins elsewhere in each world too, as far as the core knows that of one at rest."""
    worlds = 60
    starts = [0] if motion == "conveyor" else [0, worlds]
    for own in starts:
        scene = crowd(MOTIONS[motion], SHAPES[shapes], own)
        q, v = thrown(scene, worlds)
        state = timed(resting(q, v), drawn(worlds, seed=2) + 1)
        end = retract(scene.articulation, q, DT * v)
        require_touching(scene, state, end)
        require_balance(scene, state, end)


RIDES = [("turntable", "boxes"), ("tilted", "polytopes"), ("lift", "balls on boxes"), ("rocking", "round"), ("conveyor", "boxes")]
EACH = [(EnergyMomentum(), *ride) for ride in RIDES] + [
    *((scheme, *RIDES[k]) for k, scheme in enumerate(SCHEMES)),
    *((scheme, *RIDES[3 - k]) for k, scheme in enumerate(SCHEMES)),
]


def begun(scene: Scene, worlds: int, scheme: Any, dt: float = DT, before: int = 15) -> tuple[NativeStepper[Any], Any]:
    """States that have made some steps, at other times in each world."""
    native = NativeStepper(Simulator(scene, dt, scheme).eager)
    time = (drawn(worlds, seed=6) + 1).to(scene.articulation.dtype)
    state = native.initial_state(*laid(scene, time), None)
    states, _ = native.run(timed(state, time), None, before)
    return native, mapped(lambda x: x[-1], states)


@pytest.mark.parametrize(("scheme", "motion", "shapes"), EACH)
def test_steps(scheme: Any, motion: str, shapes: str) -> None:
    """To the same root as the reference's, and on from it alike, where both solve the step directly."""
    native, state = begun(riding(MOTIONS[motion], SHAPES[shapes]), 12, scheme)
    require_same_steps(native, state, 3, 18)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("motion", "shapes"), RIDES)
def test_starts(motion: str, shapes: str, scheme: Any) -> None:
    """What the reference makes of where the core's trial ends, which feels obstacles as they move from t = 0 on."""
    native = NativeStepper(Simulator(riding(MOTIONS[motion], SHAPES[shapes], height=0.1), DT, scheme).eager)
    q, v = laid(native.scene, torch.zeros(12, dtype=torch.float64))
    start = begun_from(native, q, v, None)
    for name, ours, theirs in fields(start.state, start.reference):
        size = 1.0 + float(theirs.nan_to_num(0.0).abs().max())
        assert torch.allclose(ours, theirs, 0.0, 1e-8 * size, equal_nan=True), name


def test_parts_of_steps() -> None:
    """Steps that are made in parts, of bodies that spin fast on a table, end where shorter steps end one after the other: obstacles
    are where they are then."""
    worlds, judged, alike, moved = 40, 0, 0, 0
    for motion, shapes in RIDES[:3]:
        scene = riding(MOTIONS[motion], SHAPES[shapes][:1])
        native = NativeStepper(Simulator(scene, 0.05).eager)
        time = drawn(worlds, seed=6) + 1
        state = timed(resting(*laid(scene, time, speed=20.0)), time)
        for _ in range(3):
            after, solution, _ = native.made(state, None)
            for times in (1, 2, 3):
                chosen = (solution.status == int(Status.HALVED)) & (solution.fallbacks[:, 3] == times)
                some = Worlds((worlds,), chosen.nonzero().squeeze(-1))
                end = in_parts(native, state.take(some), 2**times, lambda t: t)
                still = in_parts(native, state.take(some), 2**times, torch.zeros_like)
                gap = (end.q - after.q[some.index]).abs().amax(-1)
                judged, alike = judged + len(gap), alike + int((gap < 1e-9).sum())
                moved += int(((still.q - end.q).abs().amax(-1) > 1e-6).sum())
            state = after
    assert judged >= 10
    assert alike >= 0.9 * judged
    assert moved >= 5


def in_parts(native: NativeStepper[Any], state: Any, parts: int, clock: Any) -> Any:
    """So many shorter steps from a state, whose time is what the clock makes of it."""
    eager = native.eager
    short = NativeStepper(eager.with_scheme(eager.integrator, eager.solver, 0, eager.step_size / parts))
    state = eager.integrator.resized(eager.articulation, state, eager.step_size, short.step_size)
    for _ in range(parts):
        state, _, _ = short.made(timed(state, clock(state.time)), None)
    return eager.integrator.resized(eager.articulation, state, short.step_size, eager.step_size)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("motion", "shapes"), RIDES)
def test_records(motion: str, shapes: str, scheme: Any) -> None:
    """PyTorch's of the same states."""
    simulator = Simulator(riding(MOTIONS[motion], SHAPES[shapes]), DT, scheme, engine=Native())
    _, state = begun(simulator.scene, 9, scheme)
    found, expected = recorded(simulator, state, None, 4)
    require_same(found, expected)
    assert bool((found.contact_force.norm(dim=-1) > 0).any())


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize(("solid", "kind"), BESIDE)
def test_records_of_candidates(solid: str, kind: Any, motion: str) -> None:
    """And the energy that contacts store, with anchors."""
    moving = placed((PLANE | SOLIDS)[solid], 12, MOTIONS[motion])
    scene = anchored(touching(BALLS if kind is Contact else CURVED, (moving, GROUND), kind))
    state, _ = beside(scene, 12, time=drawn(12, seed=5) + 1)
    require_same(*recorded(Simulator(scene, DT, engine=Native()), stretched(scene, state), None, 2))


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("motion", "shapes"), [RIDES[1], RIDES[3]])
def test_no_world_knows_another(motion: str, shapes: str, dtype: torch.dtype, scheme: Any) -> None:
    """To the bit: many steps in one call or one by one, in a batch of other times, in another place of it, by itself, on
    threads; and where all times are the same."""
    worlds, steps = 21, 6
    native, state = begun(riding(MOTIONS[motion], SHAPES[shapes], dtype=dtype), worlds, scheme)
    states, solution = native.run(state, None, steps)
    one, at = torch.tensor(0), state
    for k in range(steps):
        at, solved, _ = native.made(at, None)
        whole, found = (mapped(lambda x, k=k: x[k].unsqueeze(1), x) for x in (states, solution))
        require_equal(at, whole, solved, found, one)
    for index in (torch.tensor([20, 3, 11, 5, 0]), torch.tensor([7]), torch.tensor([8])):
        some, solved = native.run(state.take(Worlds((worlds,), index)), None, steps)
        require_equal(some, states, solved, solution, index)
    threaded = NativeStepper(native.eager, threads=3).run(state, None, 40)
    single = NativeStepper(native.eager, threads=1).run(state, None, 40)
    require_equal(threaded[0], single[0], threaded[1], single[1], torch.arange(worlds))
    alike = state.take(Worlds((worlds,), torch.full((worlds,), 4)))
    some, solved = native.run(alike, None, steps)
    require_equal(some, states, solved, solution, torch.full((worlds,), 4))


@pytest.mark.parametrize("motion", MOTIONS)
def test_anchors_between_bodies(motion: str) -> None:
    """Bodies stick to what carries them: r, J, and what is remembered after a step."""
    scene = crowd(MOTIONS[motion], SHAPES["boxes"], friction=AnchoredFriction(1.0, 1e-3))
    native = NativeStepper(Simulator(scene, DT).eager)
    q, v = thrown(scene, 24)
    before = native.complete(timed(resting(q, v), drawn(24, seed=2) + 1))
    after, solution, _ = native.made(before, None)
    whole = solution.solved & (solution.status != int(Status.HALVED))
    assert int(whole.sum()) >= 15
    kept = native.eager.objective(before, None).aftermath(place(scene.articulation, after.q)).memory
    for ours, theirs in zip(after.memory, kept, strict=True):
        assert torch.equal(ours[whole][..., 6], theirs[whole][..., 6])
        held = whole[:, None] & (theirs[..., 6] >= 0)
        assert torch.allclose(ours[held], theirs[held], rtol=0, atol=1e-12)
        assert float(ours[held][:, :3].abs().max()) > 1e-4
    require_balance(scene, after, retract(scene.articulation, after.q, DT * after.v))


@pytest.mark.parametrize("name", ["conveyor", "turntable"])
def test_named_scenes(name: str) -> None:
    """They are compiled, and boxes do what these scenes are about."""
    setup = SCENES[name](worlds=2)
    simulator = Simulator(setup.scene, setup.dt, engine=Native())
    rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=round(setup.duration / setup.dt))
    assert bool(rollout.solved.all())
    found = {name: torch.as_tensor(values) for name, values in setup.report(setup, rollout).items()}
    if name == "conveyor":
        assert float(found["slip_back_error"].abs().max()) < 0.02
    else:
        assert float(found["inner_drift_m"].max()) < 0.02
        assert float(found["outer_distance_m"].min()) > 0.62


def test_what_is_not_covered_is_said() -> None:
    """What rides on the world and is touched by what moves: its record would change."""
    fixed = Link("fixed", position=(0.0, 0.0, 0.1))
    a = Articulation.from_links([fixed, Link("free", joints=(Joint("f", JointKind.FREE),), mass=1.0, inertia=diagonal(1, 1, 1))])
    colliders = [Collider(name, name, Sphere(0.1)) for name in ("fixed", "free")]
    solid = Obstacle("table", Box((1.0, 1.0, 0.1)), motion=Turntable(1.0))
    contact = Contact.between(a, colliders, solid, NormalForce(1e5), CoulombFriction(0.7))
    scene = Scene(a, (Inertia(), contact), torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64))
    words = "the core does not know what does not move against 'table', which does"
    assert uncovered(Simulator(scene, DT).eager) == words
