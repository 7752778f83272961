"""The integrators: their order, what they conserve, how they start, and what happens where their own step is no good."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.asynchronous import AsynchronousRollout
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box
from pbfd_torch.dynamics import bias_force, mass_matrix
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.integrator import State
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models.chains import chain_colliders, chain_fixed, chain_links
from pbfd_torch.rollout import Rollout
from pbfd_torch.simulator import Scene, Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.objective import FALLBACKS, Status
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.worlds import Worlds
from tests.bodies import GRAVITY, at, box_inertia, diagonal, down, free_body, on_ground, on_world, rises
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


def arm() -> Scene:
    """Two links on hinges, with rotors, springs and damping."""
    rows, y = diagonal(0.003, 0.004, 0.005), (0.0, 1.0, 0.0)
    upper = Link("upper", joints=(Joint("a", JointKind.HINGE, y),), mass=1.0, com=(0.2, 0.0, 0.05), inertia=rows)
    lower = Link("lower", "upper", (0.4, 0.0, 0.0), joints=(Joint("b", JointKind.HINGE, y),), mass=0.7, com=(0.15, 0.0, 0.0))
    articulation = Articulation.from_links([upper, dataclasses.replace(lower, inertia=rows)])
    terms = (Inertia(), Armature(doubles(0.02, 0.01)), JointSprings(doubles(2.0, 3.0), doubles(0.1, -0.2)))
    return Scene(articulation, (*terms, JointDamping(doubles(0.1, 0.05))), down())


DURATION = 0.24
START = (doubles(0.2, -0.4), doubles(0.0, 1.0))


@pytest.fixture(scope="module")
def exact() -> tuple[Tensor, Tensor]:
    """Where the arm is after `DURATION`, and how fast: RK4 on M v̇ + h = −k (q − rest) − c v, converged to 1e-7."""
    scene, n = arm(), 60
    armature, springs, damping = scene.terms[1:]
    assert isinstance(springs, JointSprings)
    assert isinstance(damping, JointDamping)

    def rate(state: Tensor) -> Tensor:
        q, v = state
        force = -bias_force(scene.articulation, q, v, scene.gravity) - springs.stiffness * (q - springs.rest) - damping.damping * v
        return torch.stack((v, torch.linalg.solve(mass_matrix(scene.articulation, q, [armature]), force)))

    state, h = torch.stack(START), DURATION / n
    for _ in range(n):
        a = rate(state)
        b = rate(state + h / 2 * a)
        c = rate(state + h / 2 * b)
        state = state + h / 6 * (a + 2 * b + 2 * c + rate(state + h * c))
    return state[0], state[1]


def arm_errors(name: str, dt: float, changed: float, end: tuple[Tensor, Tensor]) -> tuple[float, float]:
    """Of q and of v at the end of the arm's motion, the second half of which is made at the step `changed`."""
    state: Any = None
    simulator, after = (simulator_of(name, arm(), h) for h in (dt, changed))
    state = simulator.initial_state(*START)
    for _ in range(round(DURATION / 2 / dt)):
        state, _ = simulator.step(state)
    if changed != dt:
        state = simulator.integrator.resized(simulator.articulation, state, simulator.step_size, after.step_size)
    for _ in range(round(DURATION / 2 / changed)):
        state, _ = after.step(state)
    assert float(state.time) == pytest.approx(DURATION)
    return float((state.q - end[0]).abs().max()), float((velocity(after, state) - end[1]).abs().max())


@pytest.mark.parametrize(
    ("name", "ratio", "share"),
    [
        ("implicit-euler", 2.0, 1.0),
        ("bdf2", 4.0, 1.0),
        ("variational", 4.0, 1.0),
        ("energy-momentum", 4.0, 1.0),
        ("implicit-euler", 2.0, 0.5),
        ("bdf2", 4.0, 0.5),
        ("energy-momentum", 4.0, 0.5),
    ],
)
def test_order(name: str, ratio: float, share: float, exact: tuple[Tensor, Tensor]) -> None:
    """Half the step, an error in q of 1/2 (first order) or 1/4 (second order) to 20 %, also where Δt changes to a share of itself in
    mid-motion."""
    coarse, fine = (arm_errors(name, dt, share * dt, exact)[0] for dt in (0.01, 0.005))
    assert coarse / fine == pytest.approx(ratio, rel=0.2)


@pytest.mark.parametrize("name", ["bdf2", "energy-momentum"])
def test_order_of_the_velocity(name: str, exact: tuple[Tensor, Tensor]) -> None:
    """These report the velocity at t_n, to second order."""
    coarse, fine = (arm_errors(name, dt, dt, exact)[1] for dt in (0.005, 0.0025))
    assert coarse / fine == pytest.approx(4.0, rel=0.2)


@all_integrators
def test_free_fall(name: str) -> None:
    """p_0 + v t + ½ g t² at every grid point, to 1e-9, at Δt .1; those of second order go on exactly with steps half as long."""
    v = doubles(1.0, -2.0, 3.0, 0.5, -0.3, 0.8)
    scene = Scene(free_body(2.0, diagonal(0.1, 0.2, 0.25)), (Inertia(),), down())
    simulator, after = (simulator_of(name, scene, h) for h in (0.1, 0.05))
    rollout = rolled(simulator, at(0.4), v, 5)
    t = rollout.time[:, None]
    assert float((rollout.center_of_mass - at(0.4)[:3] - t * v[:3] - 0.5 * t * t * down()).abs().max()) <= 1e-9
    state = simulator.initial_state(at(0.4), v)
    for _ in range(3):
        state, _ = simulator.step(state)
    state = simulator.integrator.resized(simulator.articulation, state, simulator.step_size, after.step_size)
    for _ in range(4):
        state, _ = after.step(state)
    off = state.q[:3] - at(0.4)[:3] - 0.5 * v[:3] - 0.5 * 0.25 * down()
    assert float(off.abs().max()) <= (1e-9 if name in ("bdf2", "energy-momentum") else 0.5 * GRAVITY * 0.05 * 0.2)


def floating(seed: int) -> Articulation:
    """A random tree of all joint kinds on a free base."""
    links = [
        Link("base", joints=(Joint("free", FREE),), mass=2.0, com=(0.05, -0.02, 0.03), inertia=random_inertia(generator(1), 2.0))
    ]
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
    """Energy–momentum: a free tree loses energy, as Δt³, and a chain keeps its momenta beside."""
    losses = []
    for dt in (0.02, 0.01):
        energy = tree_motion("energy-momentum", 0, dt, lambda _: ()).kinetic_energy
        losses.append(float(1 - energy[-1] / energy[0]))
    assert 0 < losses[1] < losses[0] < 1e-4
    assert losses[0] / losses[1] == pytest.approx(8.0, abs=2.0)


# Springs, damping and servos ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("z", [1e-6, 0.05, 0.5, 5.0])
@pytest.mark.parametrize(("kind", "inertia"), [(JointKind.HINGE, 0.02), (JointKind.SLIDE, 1.0)])
def test_damped_joint(kind: JointKind, inertia: float, z: float) -> None:
    """The velocity that a step starts with falls by e^{−z}, z = Δt c/m, in every step: to 1e-9 of the start."""
    scene = on_world(kind, 1.0, [JointDamping(doubles(z * inertia / 0.1))])
    simulator = Simulator(scene, 0.1, EnergyMomentum(), solver=Descent(tolerance=1e-14))
    state = simulator.initial_state(doubles(0.3), doubles(1e-3))
    for _ in range(4):
        after, _ = simulator.step(state)
        assert float((after.v - math.exp(-z) * state.v).abs()) <= 1e-9 * 1e-3
        state = after


def sprung(servo: bool, stiffness: float) -> Scene:
    """A hinge with an inertia of .02 kg m², held at 0 by a spring or by a position servo."""
    articulation = on_world(JointKind.HINGE, 1.0).articulation
    spring = JointSprings(doubles(stiffness), articulation.rest)
    position = Actuators.from_list(articulation, [Actuator.position("servo", "joint", kp=stiffness)])
    return on_world(JointKind.HINGE, 1.0, [position if servo else spring])


both_springs = pytest.mark.parametrize("servo", [False, True], ids=["spring", "servo"])


@both_springs
def test_stiff_spring_does_not_ring(servo: bool) -> None:
    """k = 1e6 N m/rad, Δt .05, z = 1.25e5: a step takes away all but 1/z of the stretch, and no later one gives any back."""
    rollout = rolled(Simulator(sprung(servo, 1e6), 0.05), doubles(0.3), doubles(0.0), 6)
    q = rollout.q[:, 0].abs()
    assert float(q[1]) <= 2 / 1.25e5 * 0.3
    assert bool((q[3:] <= q[1:-2].clamp_min(1e-12)).all())
    assert bool(rollout.solved.all())


@both_springs
def test_soft_spring_swings(servo: bool) -> None:
    """q = q_0 cos(ωt), ω = 10 rad/s, over two periods: to second order in Δt, the energy within 1 %."""
    errors = []
    for dt in (0.01, 0.005):
        rollout = rolled(Simulator(sprung(servo, 2.0), dt), doubles(0.3), doubles(0.0), round(1.26 / dt))
        q, v = rollout.q[:, 0], rollout.v[:, 0]
        errors.append(float((q - 0.3 * torch.cos(10 * rollout.time)).abs().max()))
        energy = 0.5 * 0.02 * v * v + 0.5 * 2.0 * q * q
        assert float((energy / energy[0] - 1).abs().max()) <= 0.01
    assert errors[0] <= 0.01 * 0.3
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.4)


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
    """A tilted box falls .5 m: no rebound beyond 1 % of that, energy never above the start's, every step solved; at rest at last."""
    rollout = rolled(
        simulator_of(name, box(), dt), at(0.5 + RESTING, (0.3, 0.2, 0.0)), torch.zeros(6, dtype=torch.float64), round(0.8 / dt)
    )
    height = rollout.center_of_mass[int((rollout.contact_depth.amax(-1) > 0).nonzero()[0]) + 1 :, 2]
    assert bool(rollout.solved.all())
    assert float((height - height.cummin(0).values).max()) <= 0.005
    assert float((rollout.energy - rollout.energy[0]).max()) <= 1e-9
    assert float(rollout.q[-1, 2]) == pytest.approx(RESTING, abs=1e-5)
    assert (name == "bdf2") == bool((rollout.status == Status.EASED).any())  # drops its memory at the impact


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
    rollout = rolled(simulator, q, v, 4)
    assert bool(rollout.solved.all())
    for world, (column, status) in enumerate(zip((EASIER, HALVING), statuses, strict=True)):
        helped = (rollout.status[:, world] == status).any() and status != Status.SOLVED
        assert bool(helped) == bool(rollout.fallbacks[:, world, column].any())
        assert status in rollout.status[:, world]
    assert not bool(rollout.fallbacks[:, 2].any())
    assert rises(rollout.energy[:, 0]) <= 1e-9
    arrays = [f.name for f in dataclasses.fields(Rollout) if f.type == "Tensor" and f.name not in ("lanes", "time")]
    for k in range(3):
        alone = rolled(simulator, q[k : k + 1], v[k : k + 1], 4)
        for x in arrays:
            assert torch.equal(getattr(alone, x)[:, 0], getattr(rollout, x)[:, k]), x
    own_pace = AsynchronousRollout(simulator, simulator.initial_state(q, v), 4).finish()
    for x in arrays:
        assert torch.equal(getattr(own_pace, x), getattr(rollout, x)), x


@all_integrators
def test_poisoned_world(name: str) -> None:
    """NaN in one world's state: NON_FINITE, and the others do bitwise what they did without it."""
    scene, q, v = fast_world()
    simulator = simulator_of(name, scene, 0.05)
    state = simulator.initial_state(q, v)
    poisoned = dataclasses.replace(state, q=state.q.clone())
    poisoned.q[2, 0] = math.nan
    sound, sick = simulator.rollout(state, steps=2), simulator.rollout(poisoned, steps=2)
    assert bool((sick.status[:, 2] == Status.NON_FINITE).all())
    assert torch.equal(sick.q[:, :2], sound.q[:, :2])
    assert torch.equal(sick.v[:, :2], sound.v[:, :2])
    assert torch.equal(sick.status[:, :2], sound.status[:, :2])


@all_integrators
def test_single_precision(name: str) -> None:
    """float32 solves the same steps, its quiet world within 1e-4 of float64's after .2 s, and at its own pace it does the same."""
    (scene, q, v), double = fast_world(torch.float32), fast_world()
    simulator = simulator_of(name, scene, 0.05)
    rollout = rolled(simulator, q, v, 4)
    exact = rolled(simulator_of(name, double[0], 0.05), double[1][2:], double[2][2:], 4)
    assert rollout.q.dtype == torch.float32
    assert bool(rollout.solved.all())
    assert float((rollout.q[:, 2] - exact.q[:, 0]).abs().max()) <= 1e-4
    own_pace = AsynchronousRollout(simulator, simulator.initial_state(q, v), 4).finish()
    assert torch.equal(own_pace.q, rollout.q)


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
    tried = halvings + (1 if name == "energy-momentum" and halvings else 0)  # where nothing pushes it halves first
    assert solution.status.tolist() == [Status.ITERATION_LIMIT]
    assert solution.fallbacks.tolist() == [[0, 0, len(simulator.integrator.easier), tried]]
    assert float(solution.residual_norm) > 1e-4
    for field in dataclasses.fields(after):
        mapped(lambda x: torch.testing.assert_close(x, torch.nan_to_num(x)), getattr(after, field.name))


# States ---------------------------------------------------------------------------------------------------------------


@all_integrators
def test_states(name: str) -> None:
    """`take` gives rows. `resized` keeps place, time and velocity to 1e-12; there and back again it is what it was, once the past is
    that of constant acceleration."""
    scene, q, v = fast_world()
    simulator = simulator_of(name, scene, 0.05)
    articulation, dt, integrator = simulator.articulation, simulator.step_size, simulator.integrator
    state, _ = simulator.step(simulator.initial_state(q, v))
    part = state.take(Worlds((3,), torch.tensor([2, 0])))
    mapped(lambda x, y: torch.testing.assert_close(x, y[[2, 0]], rtol=0, atol=0), part, state)
    past = integrator.resized(articulation, state, dt, dt)
    short = integrator.resized(articulation, past, dt, 0.25 * dt)
    again = integrator.resized(articulation, short, 0.25 * dt, dt)
    for other, h in ((past, dt), (short, 0.25 * dt), (again, dt)):
        assert torch.equal(other.q, state.q)
        assert torch.equal(other.time, state.time)
        before, now = integrator.velocity(articulation, state, dt), integrator.velocity(articulation, other, h)
        torch.testing.assert_close(now, before, rtol=0, atol=1e-10)
    mapped(lambda x, y: torch.testing.assert_close(x, y, rtol=0, atol=1e-10, equal_nan=True), again, past)
