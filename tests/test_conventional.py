"""The conventional formulation: its complementarity solver, closed forms of its steps, and what it refuses."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.motion import Conveyor, Lift
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Collider, Point, Sphere
from pbfd_torch.conventional.complementarity import (
    FrictionProblem,
    natural_residual,
    projected,
    projection_slope,
    solve,
)
from pbfd_torch.conventional.constraints import contact_frame
from pbfd_torch.conventional.newton_euler import NewtonEuler
from pbfd_torch.errors import InputError
from pbfd_torch.models.boxes import HALF, RADIUS, box_slide, box_slope
from pbfd_torch.models.chains import SLIDE, chain_fixed, chain_free, chain_ground, chain_slope, chain_slope_drop
from pbfd_torch.models.robots import hopper
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
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.terms.torsional_friction import TorsionalFriction
from pbfd_torch.tree.articulation import Articulation, JointKind
from pbfd_torch.tree.rotations import skew
from tests.bodies import GRAVITY, at, box_inertia, down, free_body, on_ground, on_world, rises
from tests.finite_differences import derivative
from tests.random_trees import generator

LAW = NormalForce(1e6)


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=generator(seed))


def rolled(scene: Scene, dt: float, duration: float, q: Tensor | None = None, v: Tensor | None = None) -> Rollout:
    """A rollout in which every step is solved."""
    stepper = NewtonEuler(scene, dt)
    rollout = stepper.rollout(stepper.initial_state(q, v), steps=round(duration / dt))
    assert rollout.solved.all()
    assert rollout.residual_norm.max() <= stepper.tolerance == 1e-8
    return rollout


# ---- The complementarity solver


def random_rows(worlds: int, count: int, dofs: int) -> Tensor:
    return numbers(worlds, count, 3, dofs, seed=count)


def body_rows(worlds: int, count: int, dofs: int) -> Tensor:
    """`count` points under one rigid body: GGᵀ has rank 6 of 3 `count`."""
    points = numbers(worlds, count, 3, seed=count) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    points[..., 2] = -1.0
    rows = torch.cat((torch.eye(3, dtype=torch.float64).expand(worlds, count, 3, 3), -skew(points)), -1)
    return rows[..., [2, 0, 1], :]


def repeated_rows(worlds: int, count: int, dofs: int) -> Tensor:
    """Every constraint twice."""
    return random_rows(worlds, count // 2, dofs).repeat(1, 2, 1, 1)


@pytest.mark.parametrize("mu", [0.0, 0.3, 1.0, 2.0])
@pytest.mark.parametrize(
    ("rows", "count", "dofs"),
    [
        (random_rows, 1, 6),
        (random_rows, 8, 6),
        (random_rows, 20, 15),
        (body_rows, 8, 6),
        (body_rows, 64, 6),
        (repeated_rows, 12, 8),
    ],
)
def test_random_problems_are_solved(rows: Callable[[int, int, int], Tensor], count: int, dofs: int, mu: float) -> None:
    """Signorini's and Coulomb's laws hold constraint by constraint, and λ is De Saxcé's: λ = P_K(λ − (u + μ‖u_t‖n)/w), P_K the
    Euclidean projection on the cone."""
    worlds = 16
    matrix = rows(worlds, count, dofs)
    velocity = (matrix * numbers(worlds, 1, 1, dofs, seed=7)).sum(-1)
    share = mu * torch.rand(worlds, count, dtype=torch.float64, generator=generator(8))
    problem = FrictionProblem(matrix, velocity, share, torch.zeros_like(share), velocity.new_ones(worlds))
    found = solve(problem, torch.zeros_like(velocity), 1e-8, 200)
    assert (found.status == int(Status.SOLVED)).all()
    assert found.residual_norm.max() <= 1e-8
    torch.testing.assert_close(natural_residual(problem, found.impulse), found.residual_norm)

    impulse, u = found.impulse, problem.relative(found.impulse)
    weight = (matrix * matrix).sum(-1).amax(-1)
    push, drag = impulse[..., 0], impulse[..., 1:]
    slip = torch.linalg.vector_norm(u[..., 1:], dim=-1)
    size = 1 + torch.linalg.vector_norm(problem.kick(impulse), dim=-1)
    assert push.min() >= 0
    bound = 1e-7 * size[:, None] * weight.sqrt()
    assert (u[..., 0] >= -bound).all()
    assert (torch.minimum(push * weight, u[..., 0]) <= bound).all()
    assert (torch.linalg.vector_norm(drag, dim=-1) <= share * push * (1 + 1e-12)).all()
    opposed = share[..., None] * push[..., None] * u[..., 1:] + slip[..., None] * drag
    assert (torch.linalg.vector_norm(opposed, dim=-1) <= bound * (share * push + slip / weight + 1e-12)).all()
    dilated = torch.cat(((u[..., 0] + share * slip)[..., None], u[..., 1:]), -1)
    error = weight.sqrt()[..., None] * (impulse - onto_cone(impulse - dilated / weight[..., None], share))
    assert (torch.linalg.vector_norm(error.flatten(1), dim=-1) / size).max() <= 2e-8 * (1 + mu)


def onto_cone(z: Tensor, mu: Tensor) -> Tensor:
    """Euclidean projection on ‖z_t‖ ≤ μ z_n."""
    size = torch.linalg.vector_norm(z[..., 1:], dim=-1)
    along = ((z[..., 0] + mu * size) / (1 + mu * mu)).clamp_min(0)
    inside = size <= mu * z[..., 0]
    cut = torch.cat((along[..., None], (mu * along / size.clamp_min(1e-300))[..., None] * z[..., 1:]), -1)
    return torch.where(inside[..., None], z, cut)


def test_single_sliding_contact_in_closed_form() -> None:
    """One point on a unit mass with velocity (−1 down, slip s): λ_n = 1, and the slip loses μ, or stops."""
    rows = torch.eye(3, dtype=torch.float64).expand(3, 1, 3, 3)
    velocity = torch.tensor([[-1.0, 3.0, 4.0], [-1.0, 0.1, 0.0], [1.0, 3.0, 4.0]], dtype=torch.float64)[:, None]
    mu = torch.full((3, 1), 0.5, dtype=torch.float64)
    found = solve(FrictionProblem(rows, velocity, mu, 0 * mu, torch.ones(3, dtype=torch.float64)), 0 * velocity, 1e-10, 50)
    exact = torch.tensor([[1.0, -0.3, -0.4], [1.0, -0.1, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(found.impulse[:, 0], exact, rtol=0, atol=1e-9)


def test_projection_slope() -> None:
    z = numbers(40, 3)
    mu, hold = numbers(40, seed=1).abs(), 0.3 * numbers(40, seed=2).abs()
    slope = derivative(lambda delta: projected(z + delta, mu, hold), 3, (40,), largest=1e-4)
    torch.testing.assert_close(projection_slope(z, mu, hold), slope, rtol=0, atol=1e-7)
    assert torch.isfinite(projection_slope(torch.zeros(1, 3), torch.ones(1), torch.zeros(1))).all()


def test_solution_is_kept_and_limit_reported() -> None:
    matrix = random_rows(4, 8, 6)
    velocity = (matrix * numbers(4, 1, 1, 6, seed=7)).sum(-1)
    mu = torch.full((4, 8), 0.5, dtype=torch.float64)
    problem = FrictionProblem(matrix, velocity, mu, 0 * mu, velocity.new_ones(4))
    first = solve(problem, torch.zeros_like(velocity), 1e-8, 200)
    again = solve(problem, first.impulse, 1e-8, 200)
    assert (again.iterations == 0).all()
    torch.testing.assert_close(again.impulse, first.impulse, rtol=0, atol=1e-15)
    assert (solve(problem, torch.zeros_like(velocity), 1e-8, 1).status == int(Status.ITERATION_LIMIT)).all()


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.6, -0.48, -0.64)])
def test_contact_frame(normal: tuple[float, float, float]) -> None:
    frame = contact_frame(torch.tensor(normal, dtype=torch.float64))
    torch.testing.assert_close(frame @ frame.mT, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(frame)) == pytest.approx(1.0)
    assert frame[0].tolist() == list(normal)


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


# ---- Contact


def resting(q: Tensor) -> Tensor:
    """The box of the named scenes exactly on the ground."""
    q[..., 2] = HALF[2] + RADIUS
    return q


def test_box_stops_where_it_should() -> None:
    """Semi-implicit Euler: v falls by μ g Δt a step, so a box stops v Δt/2 short of v²/(2μg), up to the last, partial step."""
    setup = box_slide()
    exact = torch.tensor([1 / (2 * mu * GRAVITY) for mu in (0.1, 0.2, 0.3, 0.5, 0.8)], dtype=torch.float64)
    short = []
    for dt in (0.02, 0.01, 0.005):
        rollout = rolled(setup.scene, dt, 1.2, resting(setup.q.clone()), setup.v)
        lost = exact - (rollout.q[-1] - rollout.q[0])[:, 0]
        assert ((lost - 0.5 * dt).abs() <= 0.13 * 0.8 * GRAVITY * dt * dt).all()
        assert rollout.v[-1].abs().max() < 1e-7  # [rad/s] what a residual of 1e-8 leaves of a light box's turning
        assert rollout.penetration.max() < 1e-8
        short.append(lost)
    assert ((short[0] / short[1] - 2).abs() < 0.4).all()
    assert ((short[1] / short[2] - 2).abs() < 0.2).all()


def test_box_on_a_slope_holds_or_slides() -> None:
    """Below atan μ it does not creep; above, v = g (sin − μ cos) t and x = ½ a t (t + Δt)."""
    setup = box_slope()
    rollout = rolled(setup.scene, 0.02, 4.0, resting(setup.q.clone()), setup.v)
    moved = (rollout.q[-1] - rollout.q[0])[:, :3]
    assert moved[0].abs().max() < 1e-8
    a = GRAVITY * 0.02 * math.sin(math.radians(20))
    assert float(rollout.v[-1, 1, 0]) == pytest.approx(a * 4.0, rel=1e-6)
    assert float(moved[1, 0]) == pytest.approx(0.5 * a * 4.0 * 4.02, rel=1e-6)
    weight = rollout.contact_force.sum(-2)[5:]
    torch.testing.assert_close(
        weight[:, 0, 0], torch.full_like(weight[:, 0, 0], -GRAVITY * math.sin(math.radians(20))), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.0)])
@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_inelastic_drop(turn: tuple[float, float, float], dt: float) -> None:
    """From .5 m: nothing bounces, nothing gains energy, and a box that lands flat does not penetrate."""
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), LAW, CoulombFriction(0.5))
    rollout = rolled(scene, dt, 1.5, at(0.5 + HALF[2], turn))
    after = rollout.q[round(0.4 / dt) :, 2]
    assert after.diff().max() < 1e-9 if turn == (0.0, 0.0, 0.0) else after.max() < 0.2
    assert rises(rollout.energy) < 1e-8 if turn == (0.0, 0.0, 0.0) else (rollout.energy - rollout.energy[0]).max() < 1e-9
    assert rollout.penetration.max() < (5e-9 if turn == (0.0, 0.0, 0.0) else 5e-3)  # 1e-8 of 3 m/s for Δt
    assert rollout.v[-1].abs().max() < 1e-6


def test_friction_opposes_the_slip() -> None:
    """A cone is circular: a block with v = (4, .8, 0) keeps its direction, and each force is −μ N along the slip."""
    articulation = free_body(1.0, box_inertia(1.0, HALF))
    colliders = [Collider("point", "body", Point(), margin=0.0)]
    contact = Contact.between(articulation, colliders, HalfSpace(), LAW, CoulombFriction(0.25))
    scene = Scene(articulation, (Inertia(), contact), down(), colliders)
    v = torch.tensor([4.0, 0.8, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    rollout = rolled(scene, 0.01, 1.0, at(0.0), v)
    heading = rollout.v[:, 1] / rollout.v[:, 0]
    torch.testing.assert_close(heading, torch.full_like(heading, 0.2), rtol=0, atol=1e-6)
    force = rollout.contact_force[:, 0]
    along = rollout.v[1:, :2] / torch.linalg.vector_norm(rollout.v[1:, :2], dim=-1, keepdim=True)
    torch.testing.assert_close(force[:, :2], -0.25 * force[:, 2:] * along, rtol=0, atol=1e-6)
    torch.testing.assert_close(force[:, 2], torch.full_like(force[:, 2], GRAVITY), rtol=0, atol=1e-6)


def test_sphere_rolls_down_a_slope() -> None:
    """Without slip a = g sin/(1 + 2/5): v = a t."""
    inertia = box_inertia(1.0, (1.0, 1.0, 1.0))
    scaled = tuple(
        (0.4 * 0.05**2 / inertia[0][0] * x, 0.4 * 0.05**2 / inertia[0][0] * y, 0.4 * 0.05**2 / inertia[0][0] * z)
        for x, y, z in inertia
    )
    scene = on_ground(free_body(1.0, scaled), Sphere(0.05), LAW, CoulombFriction(1.0), down(math.radians(15)))
    rollout = rolled(scene, 0.01, 1.0, at(0.05))
    a = GRAVITY * math.sin(math.radians(15)) / 1.4
    assert float(rollout.v[-1, 0]) == pytest.approx(a, rel=1e-6)
    assert float(rollout.v[-1, 4]) == pytest.approx(a / 0.05, rel=1e-6)


def test_obstacles_that_move() -> None:
    """A point on a belt takes on its speed, at μ g; on a lift that starts at once it goes with it; on a sphere it stays on top."""
    articulation = free_body(1.0, box_inertia(1.0, HALF))
    colliders = [Collider("point", "body", Point())]

    def over(obstacle: HalfSpace | Obstacle, height: float = 0.0) -> Rollout:
        contact = Contact.between(articulation, colliders, obstacle, LAW, CoulombFriction(0.5))
        return rolled(Scene(articulation, (Inertia(), contact), down(), colliders), 0.01, 0.5, at(height))

    belt = over(HalfSpace(motion=Conveyor((1.0, 0.0, 0.0))))
    assert float(belt.v[10, 0]) == pytest.approx(0.5 * GRAVITY * 0.1, rel=1e-6)
    assert float(belt.v[-1, 0]) == pytest.approx(1.0, rel=1e-9)
    lift = over(HalfSpace(motion=Lift.steady((0.2, 0.0, 0.3))))
    assert lift.q[-1, :3].tolist() == pytest.approx([0.1, 0.0, 0.15], abs=0.02)
    assert lift.v[-1, :3].tolist() == pytest.approx([0.2, 0.0, 0.3], abs=1e-7)
    assert lift.penetration.max() < 1e-9
    assert over(Obstacle("ball", Sphere(0.2)), 0.25).q[-1, :3].tolist() == pytest.approx([0.0, 0.0, 0.2], abs=1e-8)


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_chain_on_a_slope(dt: float) -> None:
    """Twenty points of a straight chain, more than determine it: ½ a t (t + Δt), and each one at the edge of its cone."""
    setup = chain_slope()
    q = setup.q.clone()
    q[:, 2] = 0.02
    rollout = rolled(setup.scene, dt, 1.0, q, setup.v)
    moved = float((rollout.center_of_mass[-1] - rollout.center_of_mass[0])[0, 0])
    assert moved == pytest.approx(0.5 * SLIDE * (1 + dt), rel=1e-6)
    force = rollout.contact_force[:, 0]
    torch.testing.assert_close(force[..., 0], -0.3 * force[..., 2], rtol=0, atol=1e-6)


def test_chains_that_land_are_solved_at_every_step() -> None:
    for setup, dt in ((chain_slope_drop(), 0.005), (chain_ground(), 0.01), (hopper(), 0.004)):
        rollout = rolled(setup.scene, dt, 0.6, setup.q, setup.v)
        assert (rollout.energy - rollout.energy[0]).max() < 1e-9
        assert rollout.penetration.max() < 2e-3


def test_single_precision() -> None:
    setup = chain_ground(dtype=torch.float32)
    stepper = NewtonEuler(setup.scene, 0.005, tolerance=1e-4)
    rollout = stepper.rollout(stepper.initial_state(setup.q, setup.v), steps=120)
    assert rollout.solved.float().mean() > 0.95
    assert rollout.q.dtype == rollout.contact_force.dtype == torch.float32
    assert rollout.penetration.max() < 1e-3


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
