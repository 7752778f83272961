"""The conventional formulation: closed forms of free motion and of joints, batches, records, and what it refuses."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.shapes import Sphere
from pbfd_torch.conventional.newton_euler import NewtonEuler
from pbfd_torch.errors import InputError
from pbfd_torch.models.boxes import HALF, box_slide
from pbfd_torch.models.chains import chain_fixed, chain_free, chain_ground
from pbfd_torch.models.stacks import stack
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.objective import Status
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import JointDamping, JointSprings
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.terms.torsional_friction import TorsionalFriction
from pbfd_torch.tree.articulation import Articulation, JointKind
from tests.bodies import GRAVITY, at, box_inertia, down, free_body, on_ground, on_world
from tests.conventional_rollouts import LAW, rolled
from tests.random_numbers import normal as numbers

# ---- Motion without contact


def test_free_fall_and_momentum() -> None:
    """Semi-implicit Euler: v = g t exactly, x = ½ g t (t + Δt) exactly; a body that spins about its axis keeps that."""
    scene = Scene(free_body(2.0, box_inertia(2.0, (0.1, 0.2, 0.3))), (Inertia(),), down())
    v = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, 3.0], dtype=torch.float64)
    rollout = rolled(scene, 0.01, 1.0, at(0.0), v)
    assert rollout.q[-1, :3].tolist() == pytest.approx([1.0, 0.0, -0.5 * GRAVITY * 1.01], abs=1e-12)
    assert rollout.linear_momentum[-1].tolist() == pytest.approx([2.0, 0.0, -2.0 * GRAVITY], abs=1e-12)
    torch.testing.assert_close(rollout.angular_momentum, rollout.angular_momentum[:1].expand(101, 3), rtol=0, atol=1e-12)
    torch.testing.assert_close(rollout.v[0], v)


def test_momentum_of_a_free_chain_drifts_at_first_order() -> None:
    setup = chain_free()
    drifts = []
    for dt in (1e-3, 5e-4):
        rollout = rolled(setup.scene, dt, 0.1, setup.q, setup.v)
        drifts.append(float((rollout.linear_momentum[-1] - rollout.linear_momentum[0]).norm()))
    assert 1e-6 < drifts[1] < 0.05
    assert drifts[0] / drifts[1] == pytest.approx(2.0, abs=0.4)


def test_explicit_bias_force_diverges_and_says_so() -> None:
    """A hanging chain released from the horizontal: stable at 2 ms, not finite any more at 20 ms."""
    setup = chain_fixed()
    stepper = NewtonEuler(setup.scene, 0.02)
    rollout = stepper.rollout(stepper.initial_state(setup.q, setup.v), steps=50)
    assert int(rollout.status[0]) == int(Status.SOLVED)
    assert int(rollout.status[-1]) == int(Status.NON_FINITE)
    rolled(setup.scene, 0.002, 1.0, setup.q, setup.v)


def test_pendulum_is_of_first_order() -> None:
    """Against Runge–Kutta 4 of θ̈ = −k sin θ, k = m g l/(I + m l²)."""
    scene = on_world(JointKind.HINGE, 1.0, gravity=down(), arm=0.5)
    k = GRAVITY * 0.5 / (0.02 + 0.25)
    exact = _pendulum(k, 1.0, 1.0)
    errors = [
        abs(float(rolled(scene, dt, 1.0, torch.ones(1, dtype=torch.float64)).q[-1, 0]) - exact) for dt in (0.01, 0.005, 0.0025)
    ]
    assert [a / b for a, b in itertools.pairwise(errors)] == pytest.approx([2.0, 2.0], abs=0.4)


def _pendulum(k: float, angle: float, duration: float, steps: int = 2000) -> float:
    h, speed = duration / steps, 0.0
    for _ in range(steps):
        a1, v1 = -k * math.sin(angle), speed
        a2, v2 = -k * math.sin(angle + 0.5 * h * v1), speed + 0.5 * h * a1
        a3, v3 = -k * math.sin(angle + 0.5 * h * v2), speed + 0.5 * h * a2
        a4, v4 = -k * math.sin(angle + h * v3), speed + h * a3
        angle, speed = angle + h * (v1 + 2 * v2 + 2 * v3 + v4) / 6, speed + h * (a1 + 2 * a2 + 2 * a3 + a4) / 6
    return angle


# ---- A hinge with inertia .02 kg m² and what acts on it


def hinge(terms: Callable[[Articulation], list[Term]], limits: tuple[float, float] = (-math.inf, math.inf)) -> Scene:
    scene = on_world(JointKind.HINGE, 1.0)
    bound = [torch.tensor([x], dtype=torch.float64) for x in limits]
    articulation = dataclasses.replace(scene.articulation, lower=bound[0], upper=bound[1])
    return Scene(articulation, (Inertia(), *terms(articulation)), scene.gravity)


def driven(scene: Scene, dt: float, steps: int, control: float, v: float = 0.0) -> Rollout:
    stepper = NewtonEuler(scene, dt)
    state = stepper.initial_state(None, torch.tensor([v], dtype=torch.float64))
    rollout = stepper.rollout(state, torch.full((steps, 1), control, dtype=torch.float64))
    assert rollout.solved.all()
    return rollout


def motor(articulation: Articulation) -> Term:
    return Actuators.from_list(articulation, [Actuator.motor("motor", "joint")])


def one(value: float) -> Tensor:
    return torch.tensor([value], dtype=torch.float64)


def test_motor_damping_and_dry_friction() -> None:
    """ω = τt/I; ω = ω₀/(1 + cΔt/I)ⁿ; dry friction takes its torque from the motor's, or all of it."""
    free = driven(hinge(lambda a: [motor(a)]), 0.01, 50, 0.1)
    assert float(free.v[-1]) == pytest.approx(0.1 * 0.5 / 0.02, rel=1e-12)
    damped = driven(hinge(lambda a: [motor(a), JointDamping(one(0.3))]), 0.01, 50, 0.0, v=2.0)
    assert float(damped.v[-1]) == pytest.approx(2.0 / (1 + 0.3 * 0.01 / 0.02) ** 50, rel=1e-9)
    rubbed = hinge(lambda a: [motor(a), JointDryFriction(one(0.04))])
    assert float(driven(rubbed, 0.01, 50, 0.1).v[-1]) == pytest.approx(0.06 * 0.5 / 0.02, rel=1e-7)
    assert float(driven(rubbed, 0.01, 50, 0.03).v.abs().max()) < 1e-9
    stopping = driven(rubbed, 0.01, 50, 0.0, v=0.5)
    assert float(stopping.v[20]) == pytest.approx(0.5 - 0.04 * 0.2 / 0.02, rel=1e-6)
    assert float(stopping.v[30:].abs().max()) < 1e-9


def test_servos_are_stable_beyond_explicit_gains() -> None:
    """A stiff position servo with damping, and a saturated velocity servo, at steps where explicit ones would diverge."""

    def position(a: Articulation) -> list[Term]:
        return [Actuators.from_list(a, [Actuator.position("servo", "joint", kp=500.0, kv=20.0)])]

    def velocity(a: Articulation) -> list[Term]:
        return [Actuators.from_list(a, [Actuator.velocity("servo", "joint", kv=50.0, effort=0.2)])]

    assert float(driven(hinge(position), 0.02, 200, 0.7).q[-1]) == pytest.approx(0.7, abs=1e-9)
    rollout = driven(hinge(velocity), 0.02, 60, 3.0)
    assert float(rollout.v[5]) == pytest.approx(0.2 * 0.1 / 0.02, rel=1e-9)
    assert float(rollout.v[-1]) == pytest.approx(3.0, abs=1e-9)


def test_spring_is_linearly_implicit() -> None:
    """(I + Δt² k) v⁺ = I v − Δt k q."""
    scene = hinge(lambda a: [motor(a), JointSprings(one(8.0), one(0.5))])
    rollout = driven(scene, 0.02, 1, 0.0, v=1.0)
    assert float(rollout.v[1]) == pytest.approx((0.02 * 1.0 + 0.02 * 8.0 * 0.5) / (0.02 + 0.02**2 * 8.0), rel=1e-12)
    torch.testing.assert_close(rollout.potential_energy[:1], one(0.5 * 8.0 * 0.25))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_limit_is_unilateral_and_inelastic(side: float) -> None:
    """Driven into a limit the hinge stops there; driven back it leaves at once; from outside it returns by β a step."""
    scene = hinge(lambda a: [motor(a), JointLimits(one(1.0))], (-0.3, 0.3))
    pressed = driven(scene, 0.01, 100, 0.1 * side)
    assert float(side * pressed.q.max() if side > 0 else -pressed.q.min()) == pytest.approx(0.3, abs=1e-9)
    assert float(pressed.v[-1].abs()) < 1e-8
    stepper = NewtonEuler(scene, 0.01)
    state, _ = stepper.step(stepper.initial_state(pressed.q[-1]), one(-0.1 * side))
    assert float(state.v) == pytest.approx(-0.1 * side * 0.01 / 0.02, rel=1e-9)
    outside, _ = stepper.step(stepper.initial_state(one(0.4 * side)))
    assert float(outside.q) == pytest.approx(side * (0.4 - 0.2 * 0.1), abs=1e-8)


# ---- Batches, records, bad input


def test_worlds_do_not_see_each_other() -> None:
    """Each world of a batch is bitwise what it is alone, though another one holds NaN."""
    setup = chain_ground(5)
    q = setup.q.clone()
    q[:, 2] -= torch.tensor([0.5, 0.49, 0.4, 0.45, 0.3], dtype=torch.float64)
    v = setup.v + 0.5 * numbers(*setup.v.shape)
    stepper = NewtonEuler(setup.scene, 0.01)
    state = stepper.initial_state(q, v)
    state = dataclasses.replace(state, v=torch.cat((state.v[:4], torch.full_like(state.v[4:], torch.nan))))
    together = stepper.rollout(state, steps=12)
    assert (together.status[:, 4] == int(Status.NON_FINITE)).all()
    assert together.solved[:, :4].all()
    assert together.iterations[:, :4].double().std() > 0
    for k in range(4):
        alone = stepper.rollout(stepper.initial_state(q[k : k + 1], v[k : k + 1]), steps=12)
        assert torch.equal(alone.q[:, 0], together.q[:, k])
        assert torch.equal(alone.contact_force[:, 0], together.contact_force[:, k])
        assert torch.equal(alone.iterations[:, 0], together.iterations[:, k])


def test_rollout_is_a_record_like_any_other(tmp_path: Path) -> None:
    setup = box_slide(2)
    stepper = NewtonEuler(setup.scene, 0.02)
    done: list[int] = []
    rollout = stepper.rollout(stepper.initial_state(setup.q, setup.v), steps=4, progress=done.append)
    assert done == [1, 2, 3, 4]
    assert rollout.contact_force.shape == rollout.contact_point.shape == (4, 2, 8, 3)
    rollout.save(tmp_path / "rollout.npz")
    again = Rollout.load(tmp_path / "rollout.npz")
    assert all(
        torch.equal(getattr(again, f.name), x)
        for f in dataclasses.fields(rollout)
        if isinstance(x := getattr(rollout, f.name), Tensor)
    )

    def stop(step: int) -> None:
        if step == 2:
            raise KeyboardInterrupt

    assert stepper.rollout(stepper.initial_state(setup.q, setup.v), steps=4, progress=stop).steps == 2


def with_contact(**changes: object) -> Scene:
    """The box on the ground with another contact."""
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Sphere(0.1), LAW, CoulombFriction(0.5))
    contact = scene.terms[1]
    assert isinstance(contact, Contact)
    return dataclasses.replace(scene, terms=(Inertia(), dataclasses.replace(contact, **changes)))  # type: ignore[arg-type]


def with_torsion() -> Scene:
    scene = with_contact()
    contact = scene.terms[1]
    assert isinstance(contact, Contact)
    return dataclasses.replace(scene, terms=(*scene.terms, TorsionalFriction(contact, 0.5, 0.01)))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: NewtonEuler(with_contact(), 0.0), "dt is 0.0 s: must be > 0"),
        (lambda: NewtonEuler(with_contact(), math.nan), "dt is nan s"),
        (lambda: NewtonEuler(with_contact(), 0.01, stabilisation=1.5), "stabilisation is 1.5: must be within"),
        (lambda: NewtonEuler(with_contact(), 0.01, tolerance=0.0), "tolerance is 0.0: must be > 0"),
        (lambda: NewtonEuler(with_contact(), 0.01, limit=0), "limit is 0: must be ≥ 1"),
        (
            lambda: NewtonEuler(with_contact(friction=PbfdFriction.as_derived(1.0)), 0.01),
            "friction law PbfdFriction: must be Coulomb",
        ),
        (lambda: NewtonEuler(with_contact(restitution=Restitution(0.5)), 0.01), "restitution: must be None"),
        (lambda: NewtonEuler(stack().scene, 0.01), "terms hold a BodyContact: must be Inertia"),
        (lambda: NewtonEuler(with_torsion(), 0.01), "terms hold a TorsionalFriction: must be Inertia"),
        (lambda: NewtonEuler(with_contact(), 0.01).initial_state(torch.zeros(3, dtype=torch.float64)), "q has shape"),
        (lambda: NewtonEuler(with_contact(), 0.01).initial_state(v=torch.zeros(6)), "v is torch.float32 on cpu: must be"),
        (lambda: NewtonEuler(with_contact(), 0.01).initial_state(at(math.nan)), "q holds NaN"),
        (lambda: _rollout(None, None), "steps is None: must be ≥ 1"),
        (lambda: _rollout(torch.zeros(3, 2), None), "controls have shape"),
        (lambda: _rollout(torch.zeros(3, 0), 2), "steps is 2 but there are 3 controls"),
    ],
)
def test_bad_input_is_refused(build: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        build()


def _rollout(controls: Tensor | None, steps: int | None) -> Rollout:
    stepper = NewtonEuler(with_contact(), 0.01)
    return stepper.rollout(stepper.initial_state(), controls, steps)
