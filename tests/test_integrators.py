"""The integrators: their order, what they conserve, how they start, and what happens where their own step is no good."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import bias_force, mass_matrix
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box
from pbfd_torch.integrators.implicit_euler import Positions
from pbfd_torch.integrators.integrator import State
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models.chains import chain_colliders, chain_fixed, chain_links
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.schedules.asynchronous import AsynchronousRollout
from pbfd_torch.schedules.lock_step import rolled_out
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.objective import FALLBACKS, Status
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from tests.bodies import GRAVITY, at, box_inertia, diagonal, down, free_body, on_ground, rises
from tests.random_trees import FREE, generator, random_inertia, random_links, random_q

all_integrators = pytest.mark.parametrize("name", INTEGRATORS)
WEIGHTLESS = torch.zeros(3, dtype=torch.float64)
HALF = (0.1, 0.1, 0.05)  # half extents of the test box [m]
STIFFNESS = 1e8
RESTING = HALF[2] - math.sqrt(GRAVITY / 4 / STIFFNESS)  # height of the centre at which four corners carry the box of 1 kg


def doubles(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def simulator_of(name: str, scene: Scene, dt: float) -> Simulator[Any]:
    return Simulator(scene, dt, INTEGRATORS[name]())


def velocity(simulator: Simulator[Any], state: State) -> Tensor:
    return simulator.integrator.velocity(simulator.articulation, state, simulator.step_size)


def rolled(simulator: Simulator[Any], q: Tensor, v: Tensor, steps: int) -> Rollout:
    return simulator.rollout(simulator.initial_state(q, v), steps=steps)


# Smooth motion --------------------------------------------------------------------------------------------------------


def arm(loaded: bool) -> Scene:
    """Two links on hinges; loaded: with rotors, springs and damping."""
    rows, y = diagonal(0.003, 0.004, 0.005), (0.0, 1.0, 0.0)
    upper = Link("upper", joints=(Joint("a", JointKind.HINGE, y),), mass=1.0, com=(0.2, 0.0, 0.05), inertia=rows)
    lower = Link("lower", "upper", (0.4, 0.0, 0.0), joints=(Joint("b", JointKind.HINGE, y),), mass=0.7, com=(0.15, 0.0, 0.0))
    articulation = Articulation.from_links([upper, dataclasses.replace(lower, inertia=rows)])
    loads = (Armature(ROTORS), JointSprings(SPRINGS, torch.zeros_like(SPRINGS)), JointDamping(DAMPING))
    return Scene(articulation, (Inertia(), *loads) if loaded else (Inertia(),), down())


ROTORS, SPRINGS, DAMPING = doubles(0.02, 0.01), doubles(2.0, 3.0), doubles(0.1, 0.05)
START, DURATION = (doubles(0.2, -0.4), doubles(0.0, 1.0)), 0.24


@functools.cache
def exact(loaded: bool) -> Tensor:
    """q and v of the arm after `DURATION`: RK4 on M v̇ + h = −k q − c v, converged to 1e-6."""
    scene, h = arm(loaded), DURATION / 60

    def rate(state: Tensor) -> Tensor:
        q, v = state
        force = -bias_force(scene.articulation, q, v, scene.gravity)
        if loaded:
            force = force - SPRINGS * q - DAMPING * v
        return torch.stack((v, torch.linalg.solve(mass_matrix(scene.articulation, q, scene.terms), force)))

    state = torch.stack(START)
    for _ in range(60):
        a = rate(state)
        b = rate(state + h / 2 * a)
        c = rate(state + h / 2 * b)
        state = state + h / 6 * (a + 2 * b + 2 * c + rate(state + h * c))
    return state


def arm_errors(name: str, loaded: bool, dt: float, changed: float) -> Tensor:
    """Of q and of v at the end of the arm's motion, the second half of which is made at the step `changed`."""
    simulator, after = (simulator_of(name, arm(loaded), h) for h in (dt, changed))
    state = simulator.initial_state(*START)
    for _ in range(round(DURATION / 2 / dt)):
        state, _ = simulator.step(state)
    if changed != dt:
        state = simulator.integrator.resized(simulator.articulation, state, simulator.step_size, after.step_size)
    for _ in range(round(DURATION / 2 / changed)):
        state, _ = after.step(state)
    assert float(state.time) == pytest.approx(DURATION)
    return (torch.stack((state.q, velocity(after, state))) - exact(loaded)).abs().amax(-1)


@pytest.mark.parametrize(
    ("name", "loaded", "share", "ratio"),
    [
        ("implicit-euler", True, 1.0, 2.0),
        ("implicit-euler", True, 0.5, 2.0),
        ("bdf2", False, 1.0, 4.0),
        ("bdf2", False, 0.5, 4.0),
        ("variational", False, 1.0, 4.0),
        ("energy-momentum", False, 1.0, 4.0),
        ("energy-momentum", True, 1.0, 4.0),
        ("energy-momentum", True, 0.5, 4.0),
    ],
)
def test_order(name: str, loaded: bool, share: float, ratio: float) -> None:
    """Half the step, an error in q of 1/2 (first order) or 1/4 (second order) to 20 %, also where Δt changes to a share of itself
    in mid-motion. Energy–momentum is of second order with loads, and in its velocity too."""
    coarse, fine = (arm_errors(name, loaded, dt, share * dt) for dt in (0.01, 0.005))
    assert float(coarse[0] / fine[0]) == pytest.approx(ratio, rel=0.2)
    if name == "energy-momentum":
        assert float(coarse[1] / fine[1]) == pytest.approx(ratio, rel=0.2)


@all_integrators
def test_free_fall(name: str) -> None:
    """p_0 + v t + ½ g t² at every grid point, to 1e-9, at Δt .1."""
    rollout = rolled(simulator_of(name, falling(), 0.1), at(0.4), THROWN, 5)
    t = rollout.time[:, None]
    assert float((rollout.center_of_mass - at(0.4)[:3] - t * THROWN[:3] - 0.5 * t * t * down()).abs().max()) <= 1e-9


@pytest.mark.parametrize("name", ["bdf2", "energy-momentum"])
def test_free_fall_goes_on(name: str) -> None:
    """.3 s at Δt .1 and .2 s at half of it: still exact, to 1e-9."""
    simulator, after = (simulator_of(name, falling(), h) for h in (0.1, 0.05))
    state = simulator.initial_state(at(0.4), THROWN)
    for _ in range(3):
        state, _ = simulator.step(state)
    state = simulator.integrator.resized(simulator.articulation, state, simulator.step_size, after.step_size)
    for _ in range(4):
        state, _ = after.step(state)
    assert float((state.q[:3] - at(0.4)[:3] - 0.5 * THROWN[:3] - 0.125 * down()).abs().max()) <= 1e-9


THROWN = doubles(1.0, -2.0, 3.0, 0.5, -0.3, 0.8)


def falling() -> Scene:
    return Scene(free_body(2.0, diagonal(0.1, 0.2, 0.25)), (Inertia(),), down())


def floating(seed: int) -> Articulation:
    """A random tree of all joint kinds on a free base."""
    free, rows = Joint("free", FREE), random_inertia(generator(1), 2.0)
    links = [Link("base", joints=(free,), mass=2.0, com=(0.05, -0.02, 0.03), inertia=rows)]
    for link in random_links(seed):
        if FREE not in [joint.kind for joint in link.joints]:
            known = [x.name for x in links]
            links.append(dataclasses.replace(link, parent=link.parent if link.parent in known else "base"))
    return Articulation.from_links(links)


def tree_motion(name: str, seed: int, dt: float, terms: Callable[[Articulation], Sequence[Term]]) -> Rollout:
    """.2 s of a weightless random tree in random motion."""
    articulation = floating(seed)
    v = torch.randn(articulation.nv, dtype=torch.float64, generator=generator(seed + 5))
    scene = Scene(articulation, (Inertia(), *terms(articulation)), WEIGHTLESS)
    return rolled(simulator_of(name, scene, dt), random_q(articulation, seed), v, round(0.2 / dt))


def inner(articulation: Articulation) -> Sequence[Term]:
    """Springs, damping and rotors at all joints but the base's."""
    k = torch.full((articulation.nv,), 3.0, dtype=torch.float64)
    k[:6] = 0.0
    return JointSprings(k, articulation.rest), JointDamping(0.02 * k)


@pytest.mark.parametrize("loads", [lambda _: (), inner], ids=["free", "springs and damping"])
@pytest.mark.parametrize("name", ["variational", "energy-momentum"])
@pytest.mark.parametrize("seed", [0, 1])
def test_momentum(seed: int, name: str, loads: Callable[[Articulation], Sequence[Term]]) -> None:
    """Linear and angular momentum are the same from the first step on, to 1e-9 of what they are; without loads from the start."""
    rollout = tree_motion(name, seed, 0.02, loads)
    assert bool((rollout.status == Status.SOLVED).all())
    begin = 0 if loads is not inner else 1
    for momentum in (rollout.linear_momentum[begin:], rollout.angular_momentum[begin:]):
        assert float((momentum - momentum[0]).abs().max()) <= 1e-9 * float(momentum.abs().max())


def test_energy() -> None:
    """Energy–momentum: a free tree loses energy, as Δt³."""
    losses = []
    for dt in (0.02, 0.01):
        energy = tree_motion("energy-momentum", 0, dt, lambda _: ()).kinetic_energy
        losses.append(float(1 - energy[-1] / energy[0]))
    assert 0 < losses[1] < losses[0] < 1e-4
    assert losses[0] / losses[1] == pytest.approx(8.0, abs=2.0)


# Contact --------------------------------------------------------------------------------------------------------------


def box() -> Scene:
    return on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), NormalForce(STIFFNESS), CoulombFriction(0.5))


@all_integrators
def test_box_that_stays(name: str) -> None:
    """At rest where its weight is carried: no velocity is reported, nor any motion, from the first step on, to 1e-9."""
    rollout = rolled(simulator_of(name, box(), 0.02), at(RESTING), torch.zeros(6, dtype=torch.float64), 5)
    assert float(rollout.v.abs().max()) <= 1e-9
    assert float((rollout.q - at(RESTING)).abs().max()) <= 1e-9


@all_integrators
@pytest.mark.parametrize("dt", [0.02, 0.05])
def test_box_that_slides(name: str, dt: float) -> None:
    """x = v t − ½ μ g t² from the first step on, to 1e-5 m: the start knows the sustained contact."""
    rollout = rolled(simulator_of(name, box(), dt), at(RESTING), doubles(1.0, 0.0, 0.0, 0.0, 0.0, 0.0), round(0.1 / dt))
    t = rollout.time
    assert float((rollout.q[:, 0] - t + 0.25 * GRAVITY * t * t).abs().max()) <= 1e-5


@all_integrators
def test_impact_in_the_first_step(name: str) -> None:
    """5 m/s down, 2 cm above the ground, Δt .02: no step reports more than that, the box stays down and comes to rest."""
    v = doubles(0.0, 0.0, -5.0, 0.0, 0.0, 0.0)
    rollout = rolled(simulator_of(name, box(), 0.02), at(RESTING + 0.02), v, 10)
    assert bool(rollout.solved.all())
    assert float(rollout.v[1:].abs().max()) <= 5.0
    assert float((rollout.q[1:, 2] - RESTING).max()) <= 1e-4
    assert float(rollout.v[-1].abs().max()) <= 1e-2


@all_integrators
@pytest.mark.parametrize("dt", [0.02, 0.05])
def test_drop(name: str, dt: float) -> None:
    """A tilted box falls .5 m: no rebound beyond 1 % of that, energy never above the start's, every step solved, at rest
    at last."""
    start = at(0.5 + RESTING, (0.3, 0.2, 0.0))
    rollout = rolled(simulator_of(name, box(), dt), start, torch.zeros(6, dtype=torch.float64), round(0.8 / dt))
    height = rollout.center_of_mass[int((rollout.contact_depth.amax(-1) > 0).nonzero()[0]) + 1 :, 2]
    assert bool(rollout.solved.all())
    assert float((height - height.cummin(0).values).max()) <= 0.005
    assert float((rollout.energy - rollout.energy[0]).max()) <= 1e-9
    assert float(rollout.q[-1, 2]) == pytest.approx(RESTING, abs=1e-5)
    assert name != "bdf2" or bool((rollout.status == Status.EASED).any())  # it drops its memory at the impact


# Easier and shorter steps ---------------------------------------------------------------------------------------------


def fast_world(dtype: torch.dtype = torch.float64) -> tuple[Scene, Tensor, Tensor]:
    """Three chains of four links: one hits the ground in the first step, one turns by 4.5 rad in a step of .05 s high above it, and
    one falls quietly."""
    articulation = Articulation.from_links(chain_links(4), dtype)
    contact = Contact.between(articulation, chain_colliders(4), HalfSpace(), NormalForce(1e6), CoulombFriction(0.5))
    scene = Scene(articulation, (Inertia(), contact), down().to(dtype))
    q, v = articulation.rest.repeat(3, 1), torch.zeros(3, articulation.nv, dtype=dtype)
    q[:, 2] = torch.tensor([0.4 * math.sin(0.3) + 0.1, 2.0, 5.0])
    q[0, 3], q[0, 5] = math.cos(0.15), math.sin(0.15)
    v[0, 2], v[1, 5] = -3.0, 90.0
    v[0, 6:], v[2] = 2.0, 0.5
    return scene, q, v


EASIER, HALVING = FALLBACKS.index("easier step"), FALLBACKS.index("halving")


@pytest.mark.parametrize(
    ("name", "statuses"),
    [
        ("implicit-euler", (Status.SOLVED, Status.SOLVED)),
        ("bdf2", (Status.EASED, Status.SOLVED)),
        ("variational", (Status.EASED, Status.SOLVED)),
        ("energy-momentum", (Status.EASED, Status.HALVED)),
    ],
)
def test_steps_that_are_no_good(name: str, statuses: tuple[Status, Status]) -> None:
    """The impact needs an easier step, the turn a shorter one, the quiet world neither; both are counted, and no energy comes from
    the impact. Each world does bitwise what it does alone, and in its own time what it does in lock step."""
    scene, q, v = fast_world()
    simulator = simulator_of(name, scene, 0.05)
    rollout = rolled(simulator, q, v, 3)
    assert bool(rollout.solved.all())
    for world, (column, status) in enumerate(zip((EASIER, HALVING), statuses, strict=True)):
        assert status in rollout.status[:, world]
        assert bool(rollout.fallbacks[:, world, column].any()) == (status != Status.SOLVED)
    assert not bool(rollout.fallbacks[:, 2].any())
    assert rises(rollout.energy[:, 0]) <= 1e-9
    arrays = [f.name for f in dataclasses.fields(Rollout) if f.type == "Tensor" and f.name not in ("lanes", "time")]
    for k in range(3):
        alone = rolled(simulator, q[k : k + 1], v[k : k + 1], 3)
        for x in arrays:
            assert torch.equal(getattr(alone, x)[:, 0], getattr(rollout, x)[:, k]), x
    own_pace = AsynchronousRollout(simulator, simulator.initial_state(q, v), 3).finish()
    in_lock_step = rolled_out(simulator.eager, simulator.initial_state(q, v), steps=3)
    for x in arrays:
        assert torch.equal(getattr(own_pace, x), getattr(in_lock_step, x)), x


@all_integrators
def test_poisoned_world(name: str) -> None:
    """NaN in one world's state: NON_FINITE, and the others do bitwise what they did without it."""
    scene, q, v = fast_world()
    simulator = simulator_of(name, scene, 0.05)
    state = simulator.initial_state(q, v)
    poisoned = dataclasses.replace(state, q=state.q.clone())
    poisoned.q[2, 0] = math.nan
    sound, sick = simulator.rollout(state, steps=1), simulator.rollout(poisoned, steps=1)
    assert bool((sick.status[:, 2] == Status.NON_FINITE).all())
    assert torch.equal(sick.q[:, :2], sound.q[:, :2])
    assert torch.equal(sick.v[:, :2], sound.v[:, :2])
    assert torch.equal(sick.status[:, :2], sound.status[:, :2])


@all_integrators
def test_single_precision(name: str) -> None:
    """float32 solves the same steps; its quiet world's centre of mass is within 1e-4 m of float64's after .2 s: every step may be
    off by 8 ε of the 5 m from the origin, and that adds up twice."""
    (scene, q, v), double = fast_world(torch.float32), fast_world()
    rollout = rolled(simulator_of(name, scene, 0.05), q, v, 4)
    same = rolled(simulator_of(name, double[0], 0.05), double[1][2:], double[2][2:], 4)
    assert rollout.q.dtype == torch.float32
    assert bool(rollout.solved.all())
    assert float((rollout.center_of_mass[:, 2] - same.center_of_mass[:, 0]).abs().max()) <= 1e-4


@pytest.mark.parametrize(("turn", "status"), [(1.5, Status.SOLVED), (3.5, Status.HALVED), (5.0, Status.HALVED)])
def test_body_that_turns_too_far(turn: float, status: Status) -> None:
    """The chord of more than 2 rad is refused and the step halved: momentum stays to 1e-10, energy within 2 % and never above."""
    scene = Scene(free_body(1.0, diagonal(0.1, 0.2, 0.25)), (Inertia(),), WEIGHTLESS)
    spin = turn / 0.05
    rollout = rolled(Simulator(scene, 0.05), at(0.0), doubles(1.0, 0.0, 0.0, 0.0, 0.3 * spin, spin), 5)
    halved = 5 if status == Status.HALVED else 0
    assert rollout.status.tolist() == [status] * 5
    assert rollout.fallbacks.sum(0).tolist() == [0, 0, 0, halved]
    for momentum in (rollout.linear_momentum, rollout.angular_momentum):
        assert float((momentum - momentum[0]).abs().max()) <= 1e-10 * float(momentum.abs().max())
    assert 0.98 <= float(rollout.kinetic_energy[-1] / rollout.kinetic_energy[0]) <= 1


@all_integrators
@pytest.mark.parametrize("halvings", [0, 2])
def test_nothing_helps(name: str, halvings: int) -> None:
    """Two evaluations solve no step of the chain: all easier steps are tried, halvings as often as they may; the world is reported
    unsolved and goes on finite."""
    setup = chain_fixed()
    simulator = Simulator(setup.scene, 0.05, INTEGRATORS[name](), Descent(max_evaluations=2), halvings)
    state = simulator.initial_state(setup.q, setup.v)
    after, solution = simulator.step(state)
    tried = halvings + (1 if name in ("energy-momentum", "runge-kutta") and halvings else 0)  # where nothing pushes it halves first
    assert solution.status.tolist() == [Status.ITERATION_LIMIT]
    assert solution.fallbacks.tolist() == [[0, 0, len(simulator.integrator.easier), tried]]
    assert float(solution.residual_norm) > 1e-4
    for field in dataclasses.fields(after):
        mapped(lambda x: torch.testing.assert_close(x, torch.nan_to_num(x)), getattr(after, field.name))


# States ---------------------------------------------------------------------------------------------------------------


@all_integrators
def test_states(name: str) -> None:
    """`take` gives rows. `resized` keeps place, time and the velocity at that time (that of positions is an average, half a step
    earlier), and there and back again it gives what was: to 1e-10. BDF2 gets another past; in it rotations about different axes do
    not add up, which costs Δt² of the velocity."""
    scene, q, v = fast_world()
    simulator = simulator_of(name, scene, 0.05)
    articulation, dt, integrator = simulator.articulation, simulator.step_size, simulator.integrator
    state, _ = simulator.step(simulator.initial_state(q, v))
    part = state.take(Worlds((3,), torch.tensor([2, 0])))
    mapped(lambda x, y: torch.testing.assert_close(x, y[[2, 0]], rtol=0, atol=0), part, state)
    short = integrator.resized(articulation, state, dt, 0.25 * dt)
    again = integrator.resized(articulation, short, 0.25 * dt, dt)
    off = float(dt * dt) if name == "bdf2" else 1e-10
    for other, h in ((short, 0.25 * dt), (again, dt)):
        assert torch.equal(other.q, state.q)
        assert torch.equal(other.time, state.time)
        gone, was = integrator.velocity(articulation, other, h), velocity(simulator, state)
        if isinstance(state, Positions) and state.acceleration is not None:
            gone, was = gone + 0.5 * h * state.acceleration, was + 0.5 * dt * state.acceleration
        torch.testing.assert_close(gone, was, rtol=0, atol=off)
    if name != "bdf2":
        mapped(lambda x, y: torch.testing.assert_close(x, y, rtol=0, atol=1e-10), again, state)
