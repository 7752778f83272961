"""Contact in the conventional formulation: closed forms of its steps."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.motion import Conveyor, Lift
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Collider, Point, Sphere
from pbfd_torch.conventional.constraints import contact_frame
from pbfd_torch.conventional.newton_euler import NewtonEuler
from pbfd_torch.models.boxes import HALF, RADIUS, box_slide, box_slope
from pbfd_torch.models.chains import SLIDE, chain_ground, chain_slope, chain_slope_drop
from pbfd_torch.models.robots import hopper
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from tests.bodies import GRAVITY, at, box_inertia, down, free_body, on_ground, rises
from tests.conventional_rollouts import LAW, rolled


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.6, -0.48, -0.64)])
def test_contact_frame(normal: tuple[float, float, float]) -> None:
    frame = contact_frame(torch.tensor(normal, dtype=torch.float64))
    torch.testing.assert_close(frame @ frame.mT, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(frame)) == pytest.approx(1.0)
    assert frame[0].tolist() == list(normal)


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
