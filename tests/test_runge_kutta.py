"""Explicit steps: their order, what they keep, how far they say to be off, and where another scheme makes the step."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.balance.dynamics import apart
from pbfd_torch.contact.shapes import Sphere
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.runge_kutta import SHORT, STAGES, RungeKutta
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Native, Torch
from pbfd_torch.schedules.asynchronous import AsynchronousRollout
from pbfd_torch.simulator import AdaptiveSimulator
from pbfd_torch.solvers.objective import Status
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings, PreparedPull
from pbfd_torch.terms.load import JointLoad, StepContext, Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.tree.kinematics import Placement, difference, retract
from tests.bodies import at, diagonal, down, free_body, on_ground
from tests.random_trees import generator, random_q, random_tree

EXPLICIT = int(Status.EXPLICIT)
ENGINES = pytest.mark.parametrize("engine", [Torch(), Native()], ids=lambda x: x.name)


def doubles(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def on_hinge(*terms: Term, gravity: Tensor | None = None, lower: float = -math.inf) -> Scene:
    """A wheel of 1 kg m² about a vertical axis."""
    joint = Joint("hinge", JointKind.HINGE, (0.0, 0.0, 1.0), lower=lower)
    link = Link("wheel", joints=(joint,), mass=1.0, inertia=((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)))
    return Scene(Articulation.from_links([link]), (Inertia(), *terms), torch.zeros(3).double() if gravity is None else gravity)


# The formulas --------------------------------------------------------------------------------------------------------------------


def test_conditions_of_order() -> None:
    """Of the pair: Σ b = 1, Σ b c = ½ … Σ b c⁴ = 1/5, and Σ b a c = 1/6; the solution of fourth order meets all but the last."""
    a = torch.zeros(7, 7, dtype=torch.float64)
    for i, row in enumerate(STAGES, start=1):
        a[i, : len(row)] = doubles(*row)
    c, fifth = a.sum(-1), a[-1]
    fourth = fifth + doubles(*SHORT)
    for power in range(5):
        assert float((fifth * c**power).sum()) == pytest.approx(1 / (power + 1), abs=1e-14)
    for power in range(4):
        assert float((fourth * c**power).sum()) == pytest.approx(1 / (power + 1), abs=1e-14)
    assert abs(float((fourth * c**4).sum()) - 0.2) > 1e-4
    for weights in (fifth, fourth):
        assert float(weights @ a @ c) == pytest.approx(1 / 6, abs=1e-14)
        assert float(weights @ a @ c**2) == pytest.approx(1 / 12, abs=1e-14)


@ENGINES
@pytest.mark.parametrize("seed", [0, 2])
def test_order_of_a_tree_under_everything_smooth(engine: Torch | Native, seed: int) -> None:
    """Free, ball, hinge and slide joints, springs, damping, rotors, actuators, pushes: the error of .1 s falls by 2⁵ as steps
    halve."""
    a = random_tree(seed)
    t, random = a.topology, generator(seed)
    names = [a.joint_names[int(j)] for j in t.scalar_joint]
    motors = Actuators.from_list(a, [Actuator.position(f"m{k}", name, 3.0, 0.1) for k, name in enumerate(names)])
    some = 0.1 * torch.ones(a.nv, dtype=torch.float64)
    force, point = 0.5 * torch.randn(2, len(a.link_names), 3, dtype=torch.float64, generator=random)
    terms = (Inertia(), Armature(some), JointSprings(5 * some, a.rest), JointDamping(0.3 * some), motors, Pushes(force, point))
    scene = Scene(a, terms, down())
    q, v = random_q(a, seed), 0.5 * torch.randn(a.nv, dtype=torch.float64, generator=random)
    control = torch.linspace(-0.5, 0.5, motors.nu, dtype=torch.float64)
    ends = []
    for steps in (20, 40, 80, 320):
        simulator = Simulator(scene, 0.1 / steps, RungeKutta(), engine=engine)
        state = simulator.initial_state(q, v, control)
        rollout = simulator.rollout(state, control.expand(steps, -1))
        assert set(rollout.status.tolist()) == {EXPLICIT}
        ends.append(torch.cat((difference(a, q, rollout.q[-1]), 0.1 * rollout.v[-1])))
    errors = [float((end - ends[-1]).abs().max()) for end in ends[:-1]]
    assert errors[0] / errors[1] > 2**4.6
    assert errors[1] / errors[2] > 2**4.6 or errors[2] < 1e-12


def test_a_pendulum_is_where_it_should_be() -> None:
    """Against θ̈ = −(g/l) sin θ by steps of 1e-4 of the classical scheme."""
    link = Link("bob", joints=(Joint("hinge", JointKind.HINGE, (0.0, 1.0, 0.0)),), mass=1.0, com=(0.0, 0.0, -0.5))
    scene = Scene(Articulation.from_links([link]), (Inertia(), Armature(doubles(0.25))), down())
    simulator = Simulator(scene, 0.02, RungeKutta())
    rollout = simulator.rollout(simulator.initial_state(doubles(2.0), doubles(0.0)), steps=50)
    gravity, h, x, w = 9.81, 1e-4, 2.0, 0.0

    def slope(x: float) -> float:
        return -gravity * 0.5 * math.sin(x) / 0.5  # m l = .5, m l² + rotor = .5

    for _ in range(10_000):
        k1, k2 = slope(x), slope(x + 0.5 * h * w)
        k3 = slope(x + 0.5 * h * (w + 0.5 * h * k1))
        k4 = slope(x + h * (w + 0.5 * h * k2))
        x, w = x + h * w + h * h / 6 * (k1 + k2 + k3), w + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    assert float(rollout.q[-1]) == pytest.approx(x, abs=1e-6)
    assert float(rollout.v[-1]) == pytest.approx(w, abs=1e-5)


@ENGINES
def test_momenta_of_what_is_free_are_kept_to_its_order(engine: Torch | Native) -> None:
    setup = SCENES["chain-free"](worlds=2)
    drifts = []
    for dt in (0.02, 0.01):
        simulator = Simulator(setup.scene, dt, RungeKutta(), engine=engine)
        rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=round(0.4 / dt))
        energy = rollout.kinetic_energy
        drifts.append([float((x - x[0]).abs().max()) for x in (rollout.linear_momentum, rollout.angular_momentum, energy)])
    for coarse, fine in zip(*drifts, strict=True):
        assert coarse < 1e-5
        assert fine < coarse / 2**4 or fine < 1e-11


@ENGINES
def test_the_estimate_is_honest(engine: Torch | Native) -> None:
    """It is no less than what the step is off by, and no more than a thousand times that."""
    setup = SCENES["chain-fixed"](worlds=4)
    random = generator(3)
    q = retract(setup.scene.articulation, setup.q, 0.3 * torch.randn(setup.v.shape, dtype=torch.float64, generator=random))
    v = 2 * torch.randn(setup.v.shape, dtype=torch.float64, generator=random)
    for dt in (0.01, 0.005):
        simulator = Simulator(setup.scene, dt, RungeKutta(trust=1.0), engine=engine)
        start = simulator.initial_state(q, v)
        end, solution = simulator.step(start)
        assert solution.estimate is not None
        fine = Simulator(setup.scene, dt / 16, RungeKutta(trust=1.0), engine=engine)
        exact = fine.rollout(fine.initial_state(q, v), steps=16).q[-1]
        off = apart(setup.scene.articulation, end.q, exact)
        assert bool((solution.estimate >= off).all())
        assert bool((solution.estimate <= 1000 * off).all())


# Whose step it is ----------------------------------------------------------------------------------------------------------------


@ENGINES
@pytest.mark.parametrize(
    ("scene", "velocity", "spent"),
    [
        (on_hinge(JointDryFriction(doubles(0.1))), 1.0, 0),
        (on_hinge(JointDamping(doubles(150.0))), 1.0, 0),
        (on_hinge(JointSprings(doubles(2e4), doubles(0.0))), 1.0, 0),
        (on_hinge(JointLimits(doubles(1e5)), lower=-1e-4), -1.0, 7),
        (on_hinge(JointLimits(doubles(1e5)), lower=1e-4), 0.0, 0),
    ],
    ids=["dry friction", "stiff damping", "stiff spring", "limit on the way", "limit at the start"],
)
def test_where_the_other_scheme_makes_the_step(engine: Torch | Native, scene: Scene, velocity: float, spent: int) -> None:
    """To the bit, and at the price of having tried where that may have helped."""
    ours, other = (Simulator(scene, 0.01, scheme, engine=engine) for scheme in (RungeKutta(), EnergyMomentum()))
    state = other.initial_state(doubles(0.0), doubles(velocity))
    end, solution = ours.step(state)
    expected, theirs = other.step(state)
    for name, value in vars(expected).items():
        if isinstance(value, Tensor):
            assert torch.equal(getattr(end, name), value), name
    assert torch.equal(solution.status, theirs.status)
    assert int(solution.evaluations) == int(theirs.evaluations) + spent
    assert solution.estimate is not None
    assert float(solution.estimate) == 0.0


@ENGINES
def test_long_steps_are_the_other_schemes(engine: Torch | Native) -> None:
    """Where the pair would be off by more than its trust: the whip stays what it is at .1 s."""
    setup = SCENES["chain-fixed"](worlds=1)
    simulator = Simulator(setup.scene, 0.1, RungeKutta(), engine=engine)
    rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=20)
    energy = rollout.kinetic_energy + rollout.potential_energy
    assert int((rollout.status != EXPLICIT).sum()) > 5
    assert bool(rollout.solved.all())
    assert float((energy - energy[0]).max()) < 0.02 * float(rollout.kinetic_energy.max())


@ENGINES
def test_a_box_that_falls_and_lands(engine: Torch | Native) -> None:
    """Explicit steps in the air, exact there; energy–momentum ones on the ground, where it stays; each world for itself."""
    setup = SCENES["box-slide"](worlds=3)
    q, v = setup.q.clone(), torch.zeros_like(setup.v)
    q[:, 2] += doubles(0.0, 0.1, 0.5)
    simulator = Simulator(setup.scene, 0.01, RungeKutta(), engine=engine)
    rollout = simulator.rollout(simulator.initial_state(q, v), steps=60)
    flying = rollout.status == EXPLICIT
    assert not bool(flying[:, 0].any())
    for world, height in ((1, 0.1), (2, 0.5)):
        count = int(math.sqrt(2 * height / 9.81) / 0.01)
        assert bool(flying[:count, world].all())
        fallen = 0.5 * 9.81 * rollout.time[: count + 1] ** 2
        assert float((q[world, 2] - rollout.q[: count + 1, world, 2] - fallen).abs().max()) < 1e-12
    assert not bool(flying[-1].any())
    assert float(rollout.v[-1].abs().max()) < 1e-6


def test_refused_where_a_term_is_not_known() -> None:
    """A user's own term may do anything: no explicit steps with it."""

    @dataclass(frozen=True)
    class Hidden:
        """Damping that does not say what it does at an instant."""

        damping: JointDamping

        def prepare(self, step: StepContext) -> PreparedPull:
            return self.damping.prepare(step)

        def load(self, prepared: PreparedPull, placement: Placement) -> JointLoad:
            return self.damping.load(prepared, placement)

        def take(self, worlds: Worlds) -> Hidden:
            return Hidden(self.damping.take(worlds))

    scene = on_hinge(Hidden(JointDamping(doubles(0.1))))
    simulator = Simulator(scene, 0.01, RungeKutta(), engine=Torch())
    _, solution = simulator.step(simulator.initial_state(doubles(0.0), doubles(1.0)))
    assert int(solution.status) == int(Status.SOLVED)


def test_bad_trust_is_refused() -> None:
    with pytest.raises(InputError, match=r"^trust is 0.0: must be > 0, a share of what the bodies move by in a step$"):
        RungeKutta(trust=0.0)


def test_no_asynchronous_schedule() -> None:
    setup = SCENES["chain-fixed"](worlds=2)
    simulator = Simulator(setup.scene, 0.01, RungeKutta(), engine=Torch())
    with pytest.raises(InputError, match="RungeKutta, whose explicit steps wait for nobody"):
        AsynchronousRollout(simulator, simulator.initial_state(setup.q, setup.v), 2)


# Their own lengths ---------------------------------------------------------------------------------------------------------------

Error = Callable[[float], float]


def tip_error(scheme: EnergyMomentum) -> Error:
    """Of the whip's tip after .6 s, for an accuracy."""
    setup = SCENES["chain-fixed"](worlds=1)
    fine = Simulator(setup.scene, 5e-4, RungeKutta())
    exact = fine.rollout(fine.initial_state(setup.q, setup.v), steps=1200).link_poses[-1]

    def error(accuracy: float) -> float:
        simulator = AdaptiveSimulator(setup.scene, 0.1, accuracy, scheme)
        rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=6)
        assert bool(rollout.solved.all())
        return float((rollout.link_poses[-1] - exact)[..., :3, 3].abs().max())

    return error


@pytest.mark.parametrize("scheme", [EnergyMomentum(), RungeKutta()], ids=lambda x: type(x).__name__)
def test_accuracy_is_worth_what_it_costs(scheme: EnergyMomentum) -> None:
    """Each tightening by a hundred reduces the error; by thirty at least where all steps are of one kind."""
    error = tip_error(scheme)
    errors = [error(accuracy) for accuracy in (1e-4, 1e-6, 1e-8)]
    assert errors[0] < 2e-2
    assert errors[1] < errors[0] / (30 if type(scheme) is EnergyMomentum else 3)
    assert errors[2] < errors[1] / 30


# Strikes -------------------------------------------------------------------------------------------------------------------------


def dropped(height: float) -> tuple[Scene, Tensor, Tensor]:
    """A full ball of 1 kg over the ground, at 1 m/s sideways."""
    inertia = 0.4 * 0.05**2
    scene = on_ground(free_body(1.0, diagonal(inertia, inertia, inertia)), Sphere(0.05), NormalForce(1e8), CoulombFriction(0.3))
    return scene, at(0.05 + height), doubles(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("share", [0.03, 0.4, 0.97])
def test_the_instant_of_a_strike(share: float) -> None:
    """A ball that falls .5 m strikes after √(2 h/g): known to a billionth of the step, and not late."""
    scene, q, v = dropped(0.5)
    fall, dt = math.sqrt(2 * 0.5 / 9.81), 0.05
    simulator = Simulator(scene, dt, RungeKutta(), engine=Torch())
    begin = fall - share * dt
    q[2] -= 0.5 * 9.81 * begin**2
    v[2] = -9.81 * begin
    _, solution = simulator.step(simulator.initial_state(q, v))
    assert int(solution.status) != EXPLICIT
    assert solution.strike is not None
    assert share - 1e-8 <= float(solution.strike) <= share + 1e-12


def test_nothing_strikes_what_passes() -> None:
    scene, q, v = dropped(0.5)
    simulator = Simulator(scene, 0.01, RungeKutta(), engine=Torch())
    _, solution = simulator.step(simulator.initial_state(q, v))
    assert solution.strike is not None
    assert float(solution.strike) == 1.0


def test_a_limit_strikes() -> None:
    """A wheel at 2 rad/s, .03 rad away from its limit."""
    scene = on_hinge(JointLimits(doubles(1e5)), lower=-0.03)
    simulator = Simulator(scene, 0.02, RungeKutta(), engine=Torch())
    _, solution = simulator.step(simulator.initial_state(doubles(0.0), doubles(-2.0)))
    assert solution.strike is not None
    assert float(solution.strike) == pytest.approx(0.75, abs=1e-8)


@ENGINES
def test_steps_of_a_frame_end_where_something_strikes(engine: Torch | Native) -> None:
    """The ball flies to the ground in one explicit step and lies there after a few others; sideways it goes on as it rolls, as
    friction stops the sliding of its lowest point within the impact."""
    scene, q, v = dropped(0.2)
    fall = math.sqrt(2 * 0.2 / 9.81)
    simulator = AdaptiveSimulator(scene, 0.25, 1e-3, RungeKutta(), engine=engine)
    rollout = simulator.rollout(simulator.initial_state(q, v), steps=4)
    assert bool(rollout.solved.all())
    assert int(rollout.substeps[0]) <= 8
    assert float(rollout.q[-1, 2]) == pytest.approx(0.05, abs=1e-3)
    rolling = 5 / 7  # of its speed
    went = fall + rolling * (1.0 - fall)
    assert float(rollout.q[-1, 0]) == pytest.approx(went, abs=5e-3)


@ENGINES
def test_a_body_that_bounces_and_rocks_goes_on(engine: Torch | Native) -> None:
    """A box dropped on its edge strikes again and again, at last within too little time: plain steps then; it comes to lie."""
    setup = SCENES["box-slide"](worlds=2)
    q = setup.q.clone()
    q[:, 2] += 0.15
    q[:, 3:] = torch.nn.functional.normalize(doubles(1.0, 0.1, 0.25, 0.0), dim=0)
    simulator = AdaptiveSimulator(setup.scene, 0.1, 1e-3, RungeKutta(), engine=engine)
    rollout = simulator.rollout(simulator.initial_state(q, torch.zeros_like(setup.v)), steps=20)
    assert bool(rollout.solved.all())
    assert float(rollout.v[-1].abs().max()) < 1e-3
    assert int(rollout.substeps.sum(0).max()) < 3000
