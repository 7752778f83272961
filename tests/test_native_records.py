"""Records that the compiled core writes: of the same states they hold what PyTorch's record holds, in every array."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import pbfd_torch.models.robots
from pbfd_torch import Articulation, Joint, JointKind, Link, Rollout, Scene, Simulator
from pbfd_torch.bench.starts import scattered
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Collider, Cylinder, Point, Shape, Sphere
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator, State
from pbfd_torch.models import SCENES, Setup
from pbfd_torch.models.robots import file_setup
from pbfd_torch.native.engine import Native
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.records.recording import Recorder
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.curved_body_contact import CurvedBodyContact
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointSprings
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.kinematics import retract
from tests.bodies import diagonal
from tests.native_parity import DT, resting
from tests.record_arrays import ARRAYS, OVER_TIME
from tests.test_native_contact import BALLS, CONVEX, CURVED, GROUND, SOLIDS, WALL, beside, touching

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

ROBOTS = Path(pbfd_torch.models.robots.__file__).parent
NAMED = [name for name in SCENES if Simulator(SCENES[name]().scene, DT).engine == "native"]
FELT = {"contact_force": 1e-9}  # of the largest, by depths and slips that are rounded themselves; all else: ROUNDING
ROUNDING = 1e-12


def compiled(simulator: Simulator[Any]) -> NativeStepper[Any]:
    """What makes its steps."""
    stepper = simulator.stepper
    assert isinstance(stepper, NativeStepper)
    return stepper


def recorded(simulator: Simulator[Any], state: State, controls: Tensor | None, steps: int) -> tuple[Rollout, Rollout]:
    """What the core records of its steps, and what PyTorch's record has of the same states."""
    stepper = compiled(simulator)
    stretch = stepper.stretch(state, controls, steps)
    record = stepper.record(state, steps)
    record.add(stretch)
    pair = record.finish(), defined(simulator, state, controls, stretch.states, stretch.solution)
    between = any(isinstance(term, BodyContact) for term in simulator.scene.terms)
    return (in_order(simulator.scene, pair[0]), in_order(simulator.scene, pair[1])) if between else pair


def defined(simulator: Simulator[Any], state: State, controls: Tensor | None, states: State, solution: Solution) -> Rollout:
    """PyTorch's record of steps that were made from a state."""
    record = Recorder(simulator.scene, simulator.integrator, simulator.dt, simulator.step_size, state)
    for k in range(len(solution.status)):
        after, solved = (mapped(lambda x, k=k: x[k], whole) for whole in (states, solution))
        record.record(after, solved, simulator.objective(state, None if controls is None else controls[k]))
        state = after
    return record.finish()


KEYS = (0.541, 0.273, 0.119, 0.913, 0.377, 0.229, 0.067)  # of a point, a normal and a depth


def in_order(scene: Scene, rollout: Rollout) -> Rollout:
    """With contacts between bodies in an order that rounding does not change: their slots are filled nearest first, and several
    may be as near."""
    sizes = [len(x.link) if isinstance(x, Contact) else x.finder.slots for x in scene.terms if isinstance(x, Contact | BodyContact)]
    between = [isinstance(x, BodyContact) for x in scene.terms if isinstance(x, Contact | BodyContact)]
    each = torch.cat((rollout.contact_point, rollout.contact_normal, rollout.contact_depth[..., None]), -1)
    keys = (each @ each.new_tensor(KEYS)).split(sizes, -1)
    order, first = [], 0
    for key, size, sorted_ in zip(keys, sizes, between, strict=True):
        order.append(first + (key.argsort(dim=-1) if sorted_ else torch.arange(size).expand_as(key)))
        first += size
    places = torch.cat(order, -1)
    arrays = {name: getattr(rollout, name) for name in ARRAYS if name.startswith("contact_")}
    put = {name: x.take_along_dim(places.reshape(*places.shape, *(1,) * (x.ndim - 3)), 2) for name, x in arrays.items()}
    return replace(rollout, **put)


def require_same(found: Rollout, expected: Rollout, ties: float = 0.0) -> None:
    """To rounding, NaN where there is NaN; contacts may differ in this share of the steps of all worlds: of bodies that overlap
    deep several points are as far from those that are kept."""
    alike = torch.ones_like(found.status, dtype=torch.bool)
    contacts = [name for name in ARRAYS if name.startswith("contact_")]
    for name in [*contacts, *(set(ARRAYS) - {"lanes", *contacts})]:
        ours, theirs = getattr(found, name), getattr(expected, name)
        assert (ours.shape, ours.dtype) == (theirs.shape, theirs.dtype), name
        if theirs.dtype.is_floating_point and theirs.numel():
            size = max(1.0, float(theirs.nan_to_num(0.0).abs().max()))
            same = torch.isclose(ours, theirs, 0.0, FELT.get(name, ROUNDING) * size, equal_nan=True)
        else:
            same = ours == theirs
        if ties and name in contacts:
            alike &= same.flatten(2).all(-1)
        else:
            assert bool((same | ~alike if name == "suspect" else same).all()), name
    assert int((~alike).sum()) <= ties * alike.numel()
    assert (found.dangers, found.link_names) == (expected.dangers, expected.link_names)


def started(setup: Setup, dt: float, integrator: Integrator[Any] | None, steps: int) -> tuple[Simulator[Any], Any, Tensor]:
    """Scattered worlds and random controls."""
    simulator = Simulator(setup.scene, dt, integrator, engine=Native())
    q, v = scattered(setup, 0, 0.3, 1.0)
    random = torch.Generator().manual_seed(1)
    controls = (2 * torch.rand(steps, setup.worlds, setup.scene.nu, generator=random) - 1).to(q.dtype)
    return simulator, simulator.initial_state(q, v), controls


@pytest.mark.parametrize("integrator", [EnergyMomentum(), ImplicitEuler()], ids=["energy-momentum", "implicit-euler"])
@pytest.mark.parametrize("name", [*NAMED, "hopper3d.xml", "walker3d.xml"])
def test_named_scenes(name: str, integrator: Integrator[Any]) -> None:
    """In a plane and in space; eased and halved steps among them."""
    setup = SCENES[name](worlds=11) if name in SCENES else file_setup(ROBOTS / name, worlds=11)
    simulator, state, controls = started(setup, 0.01, integrator, 25)
    # where a polytope stands for a curved body, edges and faces of it tie that the body does not have
    ties: dict[type, float] = {CurvedBodyContact: 0.06, BodyContact: 0.02}
    allowed = max((ties.get(type(term), 0.0) for term in setup.scene.terms), default=0.0)
    require_same(*recorded(simulator, state, controls, 25), ties=allowed)


def test_steps_that_are_eased_halved_or_not_solved() -> None:
    """The balance is that of the whole step, whatever it was made of; what hazards are suspected of; worlds that stand still."""
    simulator, state, controls = started(SCENES["walker"](worlds=33), 0.05, EnergyMomentum(), 20)
    controls[3:, 4] = torch.nan
    found, expected = recorded(simulator, state, controls, 20)
    require_same(found, expected)
    for status in (Status.SOLVED, Status.EASED, Status.HALVED, Status.NON_FINITE):
        assert bool((found.status == int(status)).any()), status
    assert len(found.suspect[found.suspect >= 0].unique()) > 3


def test_a_state_that_is_not_finite() -> None:
    """It and its world's record are NaN, all others as in PyTorch."""
    simulator, state, controls = started(SCENES["hopper"](worlds=9), 0.008, EnergyMomentum(), 3)
    state.q[4] = torch.nan
    found, expected = recorded(simulator, state, controls, 3)
    require_same(found, expected)
    assert bool(found.potential_energy[:, 4].isnan().all())
    assert bool(found.potential_energy[:, 3].isfinite().all())


COMPILED: list[tuple[str, Sequence[Shape], type[Contact]]] = [(solid, BALLS, Contact) for solid in SOLIDS]
COMPILED += [(solid, CURVED, CurvedContact) for solid in SOLIDS.keys() - CONVEX.keys()]


@pytest.mark.parametrize(("solid", "shapes", "kind"), sorted(COMPILED, key=str))
def test_contact_with_all_solids(solid: str, shapes: Sequence[Shape], kind: Any) -> None:
    scene = touching(shapes, (SOLIDS[solid], GROUND), kind)
    found, expected = recorded(Simulator(scene, DT, engine=Native()), beside(scene, 60)[0], None, 2)
    require_same(found, expected)
    assert float((found.contact_force.norm(dim=-1) > 0).any(-1).double().mean()) > 0.3


@pytest.mark.parametrize("solid", CONVEX)
def test_fast_balls_beside_planes_that_stand_for_solids(solid: str) -> None:
    """Depth and force are the plane's, what is stored is the solid's."""
    scene = touching(BALLS, (CONVEX[solid], WALL))
    require_same(*recorded(Simulator(scene, DT, engine=Native()), beside(scene, 120, speed=10.0)[0], None, 2))


def post_and_bodies() -> Scene:
    """A post in the ground, and beside it a ball joint with a spring that carries a hinge with limits and a slide, all with
    contacts against two solids: terms between which the dangers of limits are counted."""
    inertia = diagonal(0.01, 0.02, 0.015)
    ball, hinge = Joint("ball", JointKind.BALL), Joint("hinge", JointKind.HINGE, (0.6, 0.0, 0.8), lower=-0.1, upper=0.1)
    slide = Joint("slide", JointKind.SLIDE, (0.0, 1.0, 0.0), lower=-0.05, upper=0.05)
    post = Link("post", position=(0.5, 0.1, 0.0), mass=3.0, com=(0.0, 0.1, 0.2), inertia=inertia)
    arm = Link("arm", "post", (0.0, 0.1, 0.15), joints=(ball,), mass=1.0, com=(0.1, 0.0, 0.0), inertia=inertia)
    fore = Link("fore", "arm", (0.2, 0.0, 0.0), joints=(hinge,), mass=0.5, inertia=inertia)
    a = Articulation.from_links([post, arm, fore, Link("end", "fore", (0.1, 0.0, 0.0), joints=(slide,), mass=0.2, inertia=inertia)])
    colliders = [
        Collider("foot", "post", Box((0.05, 0.05, 0.0501))),
        Collider("hand", "end", Sphere(0.06)),
        Collider("elbow", "fore", Point(), (0.0, 0.0, -0.02)),
    ]
    low, high = Obstacle("block", Box((1.0, 1.0, 0.05)), (0.5, 0.1, -0.1)), HalfSpace(offset=-0.0045)
    law, friction = NormalForce(1e5), CoulombFriction(0.7)
    spring = a.rest.new_tensor([3.0, 3.0, 3.0, 5.0, 2.0])
    rest = retract(a, a.rest, a.rest.new_tensor([0.3, -0.2, 0.1, 0.05, 0.02]))
    rolls = CurvedContact.between(a, [Collider("drum", "post", Cylinder(0.1, 0.01), (0.0, 0.0, 0.005))], high, law, friction)
    terms = (
        *(Inertia(), JointSprings(spring, rest), Contact.between(a, colliders, low, law, friction), rolls),
        *(JointLimits.for_articulation(a), Contact.between(a, colliders[1:], high, law, friction), Armature(0.01 * spring)),
    )
    return Scene(a, terms, torch.tensor([0.3, 0.0, -9.81], dtype=torch.float64))


@pytest.mark.parametrize("sunk", [0.0, 0.03])
def test_what_rides_on_the_world(sunk: float) -> None:
    """Its mass, its contacts, the energy that they store; and as what is deepest, where it is sunk in [m]."""
    scene = post_and_bodies()
    foot = next(term for term in scene.terms if isinstance(term, Contact))
    assert foot.deep is not None
    foot.position[:8, 2] -= sunk  # the box' corners
    random = torch.Generator().manual_seed(2)
    a = scene.articulation
    moved, v = torch.randn(2, 40, a.nv, dtype=torch.float64, generator=random)
    simulator = Simulator(scene, DT, engine=Native())
    state = resting(retract(a, a.rest.expand(40, -1), 0.3 * moved), v)
    found, expected = recorded(simulator, state, None, 10)
    require_same(found, expected)
    suspects = {found.dangers[k] for k in found.suspect.unique().tolist() if k >= 0}
    assert ("foot – block" in suspects) == (sunk > 0)
    assert sunk > 0 or {"limit of hinge", "hand – ground"} <= suspects
    for first, last in ((0, 8), (10, 28)):  # the foot, the drum
        assert bool((found.contact_force[..., first:last, 2] > 0).any(-1).all())


def test_friction_of_each_world() -> None:
    """Also where the worlds of a batch have two dimensions."""
    scene, worlds = touching(BALLS, (GROUND, WALL)), 12
    mu = torch.linspace(0.1, 1.5, worlds, dtype=torch.float64)[:, None]
    start = beside(scene, worlds)[0]
    found = []
    for shape in ((worlds,), (3, 4)):
        first = scene.terms[1]
        assert isinstance(first, Contact)
        terms = (scene.terms[0], replace(first, friction=CoulombFriction(mu.reshape(*shape, 1))), scene.terms[2])
        simulator = Simulator(replace(scene, terms=terms), DT, engine=Native())
        state = mapped(lambda x, shape=shape: x.reshape(*shape, *x.shape[1:]), replace(start, memory=()))
        found.append(recorded(simulator, state, None, 4))
        require_same(*found[-1])
    assert torch.equal(found[0][0].contact_force.flatten(), found[1][0].contact_force.flatten())


@pytest.mark.parametrize("name", ["hopper", "quadruped", "chain-slope-drop"])
def test_single_precision(name: str) -> None:
    """As near to the record of the same states in double precision as PyTorch's is."""
    simulator, state, controls = started(SCENES[name](worlds=11, dtype=torch.float32), 0.01, None, 20)
    found, usual = recorded(simulator, state, controls, 20)
    exact = Simulator(SCENES[name](worlds=11).scene, 0.01)
    states, solution = compiled(simulator).run(state, controls, 20)
    truth = defined(exact, mapped(doubled, state), controls.double(), mapped(doubled, states), solution)
    for array in ARRAYS:
        ours, theirs, right = (getattr(x, array) for x in (found, usual, truth))
        if right.dtype == torch.float64 and right.numel():
            assert (ours.dtype, ours.shape) == (torch.float32, right.shape), array
            error, other = (float((x.double() - right).abs().max()) for x in (ours, theirs))
            assert error <= 2 * other + 1e-6 * float(right.abs().max()), array
    assert torch.equal(found.suspect, usual.suspect)


def doubled(values: Tensor) -> Tensor:
    return values.double() if values.dtype == torch.float32 else values


def test_a_record_does_not_depend_on_batch_lane_or_thread() -> None:
    """A world's record is the same to the bit by itself, in a batch, in parts, and by several threads."""
    simulator, state, controls = started(SCENES["hopper"](worlds=70), 0.008, None, 40)
    one = simulator.rollout(state, controls)
    parts = NativeStepper(simulator.eager, threads=1).record(state, 40)
    at = state
    for first, last in ((0, 1), (1, 13), (13, 40)):
        stretch = compiled(simulator).stretch(at, controls[first:last], last - first)
        parts.add(stretch)
        at = stretch.end
    threads = Simulator(simulator.scene, 0.008, engine=Native(threads=3)).rollout(state, controls)
    some = torch.tensor([69, 3])
    alone = simulator.rollout(state.take(Worlds((70,), some)), controls[:, some])
    for name in OVER_TIME:
        if name != "time":
            values = getattr(one, name)
            assert torch.equal(getattr(parts.finish(), name), values), name
            assert torch.equal(getattr(threads, name), values), name
            assert torch.equal(getattr(alone, name), values[:, some]), name


def test_interrupted_rollouts_keep_the_steps_that_were_told_of() -> None:
    """The same record as of that many steps; none at all is an interruption."""
    simulator, state, controls = started(SCENES["hopper"](worlds=3), 0.008, None, 20)

    def interrupted(done: int) -> None:
        if done == 7:
            raise KeyboardInterrupt

    kept, expected = simulator.rollout(state, controls, progress=interrupted), simulator.rollout(state, controls[:7])
    for name in OVER_TIME:
        assert torch.equal(getattr(kept, name), getattr(expected, name)), name
    kept.require_consistent()


def test_a_rollout_of_no_worlds() -> None:
    """Arrays without worlds."""
    simulator, state, controls = started(SCENES["hopper"](worlds=3), 0.008, None, 4)
    nobody = torch.arange(0)
    record = simulator.rollout(state.take(Worlds((3,), nobody)), controls[:, nobody])
    assert record.link_poses.shape == (5, 0, 4, 3, 4)
    assert record.contact_force.shape == (4, 0, 8, 3)
