"""Rest, impact and friction of bodies on the ground against closed forms. Every test states its equation."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Point, Shape, Sphere
from pbfd_torch.models.boxes import box_slide, box_slope
from pbfd_torch.models.chains import chain_ground
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from tests.bodies import GRAVITY, at, box_inertia, diagonal, down, free_body, on_ground, rises, rolled_out
from tests.setup_runs import metric, run

HALF = (0.1, 0.1, 0.05)  # half extents of the test box [m]
STIFF = NormalForce(1e8)


# Contact: rest and impact ---------------------------------------------------------------------------------------------

RESTING: dict[str, tuple[Shape, float, int, tuple[float, float, float, float]]] = {
    "box": (Box(HALF), 0.05, 4, (1.0, 0.0, 0.0, 0.0)),
    "sphere": (Sphere(0.06), 0.06, 1, (1.0, 0.0, 0.0, 0.0)),
    "capsule": (Capsule(0.05, 0.1), 0.05, 2, (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)),
}


@pytest.mark.parametrize("exponent", [2.0, 2.5])
@pytest.mark.parametrize("name", RESTING)
def test_rest_depth(name: str, exponent: float) -> None:
    """Dropped by 1 mm, a body comes to rest at depth d = (N/C⊥)^{1/α} under each of its points: to 1e-6 relative."""
    shape, height, points, turn = RESTING[name]
    scene = on_ground(
        free_body(1.0, diagonal(0.003, 0.003, 0.002)), shape, NormalForce(1e6, exponent), CoulombFriction(0.5), quaternion=turn
    )
    rollout = rolled_out(scene, 0.02, 1.5, at(height + 1e-3))
    depth = rollout.contact_depth[-1]
    touching = depth[depth > 0]
    expected = (GRAVITY / points / 1e6) ** (1 / exponent)
    assert len(touching) == points
    assert float((touching / expected - 1).abs().max()) <= 1e-6
    assert float(rollout.contact_force[-1, :, 2].sum()) == pytest.approx(GRAVITY, rel=1e-6)


def test_rest_without_drift() -> None:
    """A box at rest stays for 60 s at Δt .1: moves and turns less than 1e-9."""
    depth = math.sqrt(GRAVITY / 4 / 1e8)
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, CoulombFriction(0.5))
    rollout = rolled_out(scene, 0.1, 60.0, at(0.05 - depth))
    assert bool(rollout.solved.all())
    assert float((rollout.q - rollout.q[:1]).abs().max()) <= 1e-9


@pytest.mark.parametrize("dt", [0.01, 0.02, 0.05, 0.1])
def test_inelastic_drop(dt: float) -> None:
    """Boxes, flat and tilted, from .5 m: the centre never rises again by more than 1 % of the drop height, energy never rises, and
    they end flat and at rest; every step solved."""
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, CoulombFriction(0.5))
    q = torch.stack([at(0.65), at(0.65, (0.3, 0.2, 0.0)), at(0.65, (0.7, 0.5, 0.1))])
    rollout = rolled_out(scene, dt, 1.2, q)
    height = rollout.center_of_mass[..., 2]
    assert bool(rollout.solved.all())
    assert float((height - height.cummin(0).values).max()) <= 0.01 * 0.5
    assert rises(rollout.energy) <= 1e-9 * float(rollout.energy[0].max())
    assert float(rollout.v[-1].abs().max()) <= 1e-3
    torch.testing.assert_close(height[-1], torch.full((3,), 0.05 - math.sqrt(GRAVITY / 4 / 1e8)).double(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("dt", [0.02, 0.1])
def test_fast_impact(dt: float) -> None:
    """Chains thrown at the ground at 20 m/s, one straight and five bent and turning: every step solved, directly or by a fallback,
    energy never rises, penetration < 1 cm."""
    setup = chain_ground(6)
    random = torch.Generator().manual_seed(3)
    v = setup.v + 0.5 * torch.randn(6, setup.scene.articulation.nv, dtype=torch.float64, generator=random)
    v[0], v[:, 2] = 0.0, -20.0
    rollout = run(dataclasses.replace(setup, v=v), dt, 0.4)
    assert bool(rollout.solved.all())
    assert rises(rollout.energy) <= 1e-9 * float(rollout.energy[0].min())
    assert 0 < float(rollout.penetration.max()) < 0.01


def test_rod_pushed_into_the_ground() -> None:
    """Painlevé's rod: pitched by 45, 55 and 65°, μ 1.5, pushed along and down: finite forces, every step solved at Δt .01, and the
    energy never exceeds its start."""
    half = 0.5
    articulation = free_body(1.0, diagonal(half**2 / 300, half**2 / 3, half**2 / 3))
    colliders = [Collider(f"end{x}", "body", Point(), (x, 0.0, 0.0), margin=0.005) for x in (-half, half)]
    contact = Contact.between(articulation, colliders, HalfSpace(), NormalForce(1e7), CoulombFriction(1.5))
    angles = [math.radians(a) for a in (45, 55, 65)]
    q = torch.stack([at(half * math.sin(a) + 0.0049, (0.0, a, 0.0)) for a in angles])
    v = torch.tensor([3.0, 0.0, -1.0, 0.0, 0.0, 0.0], dtype=torch.float64).expand(3, 6)
    rollout = rolled_out(Scene(articulation, (Inertia(), contact), down()), 0.01, 0.5, q, v)
    assert bool(rollout.solved.all())
    assert bool(torch.isfinite(rollout.contact_force).all())
    assert float((rollout.energy - rollout.energy[:1]).max()) <= 1e-9 * float(rollout.energy[0].max())


# Contact: friction ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dt", "tolerance"), [(0.02, 5e-3), (0.05, 1e-2)])
def test_stopping_distance(dt: float, tolerance: float) -> None:
    """A box slides v_0²/(2μg): to .5 % at Δt .02 for every μ, to 1 % at Δt .05 where stopping takes at least four steps; then it
    rests at less than 1e-3 m/s."""
    setup = box_slide()
    rollout = run(setup, dt, 1.5)
    assert bool(rollout.solved.all())
    errors = metric(setup, rollout, "stop_distance_error")
    checked = 0
    for mu, error in zip(metric(setup, rollout, "mu"), errors, strict=True):
        if dt < 0.05 or 1.0 / (mu * GRAVITY) >= 4 * dt:
            checked += 1
            assert abs(error) <= tolerance, (mu, error)
    assert checked >= 4
    assert max(metric(setup, rollout, "final_speed_m_s")) < 1e-3
    assert rises(rollout.energy) <= 1e-9


@pytest.mark.parametrize("dt", [0.02, 0.05])
def test_slope_at_the_edge_of_the_cone(dt: float) -> None:
    """μ = .98 tan: slides ½ g (sin − μ cos) T² to 1 %. μ = 1.02 tan: creeps at v* = ε_v (1 − √(1 − W/(μN))), the root of
    (2 − y) y = W/(μN) at y = v*/ε_v, and no further than 2 % more."""
    setup = box_slope()
    rollout = run(setup, dt, 5.0)
    assert bool(rollout.solved.all())
    creep = metric(setup, rollout, "creep_m")[0]
    assert 0 < creep <= 1e-3 * (1 - math.sqrt(1 - 1 / 1.02)) * 5.0 * 1.02
    moved, exact = (metric(setup, rollout, f"slide_distance{part}_m")[1] for part in ("", "_exact"))
    assert abs(moved / exact - 1) < 0.01


def test_creep_under_a_part_of_the_cone() -> None:
    """Held at a share of the cone a box creeps at v* = ε_v (1 − √(1 − share)), for small loads ε_v W/(2μN): 10 s at Δt .05."""
    mu = 0.5
    share = torch.tensor([0.05, 0.25, 0.5, 0.9], dtype=torch.float64)
    slope = torch.atan(share * mu)
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, CoulombFriction(mu), down(slope))
    q = at(0.05).repeat(4, 1)
    q[:, 2] -= torch.sqrt(GRAVITY * torch.cos(slope) / 4 / 1e8)
    rollout = rolled_out(scene, 0.05, 10.0, q)
    moved = rollout.q[-1, :, 0] - rollout.q[0, :, 0]
    exact = 1e-3 * (1 - torch.sqrt(1 - share)) * 10.0
    torch.testing.assert_close(moved, exact, rtol=0.01, atol=0)
    assert float(moved[0]) <= 1e-3 * 0.05 / 2 * 10.0 * 1.02


@pytest.mark.parametrize("dt", [0.02, 0.05])
def test_ramp_grid(dt: float) -> None:
    """μ ∈ {.1, .3, .5, .7, 1}: 2° below atan μ a box holds, v < 2 ε_v; 2° above it slides at g (sin − μ cos), to 1 %."""
    mu = torch.tensor([0.1, 0.3, 0.5, 0.7, 1.0], dtype=torch.float64).repeat_interleave(2)
    slope = torch.atan(mu) + math.radians(2) * torch.tensor([-1.0, 1.0], dtype=torch.float64).repeat(5)
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, CoulombFriction(mu[:, None]), down(slope))
    q = at(0.05).repeat(10, 1)
    q[:, 2] -= torch.sqrt(GRAVITY * torch.cos(slope) / 4 / 1e8)
    rollout = rolled_out(scene, dt, 1.0, q)
    assert bool(rollout.solved.all())
    speed, half = rollout.v[:, :, 0], rollout.steps // 2
    assert float(speed[-1, ::2].abs().max()) < 2e-3
    acceleration = (speed[-1] - speed[half]) / float(rollout.time[-1] - rollout.time[half])
    exact = GRAVITY * (torch.sin(slope) - mu * torch.cos(slope))
    torch.testing.assert_close(acceleration[1::2], exact[1::2], rtol=0.01, atol=0)


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_straight_path(dt: float) -> None:
    """A block with v = (4, .8, 0), μ .25 goes straight: y/x = .2 to 1e-6 (a pyramid for the cone would bend it); it ends after
    ‖v‖²/(2μg), to .5 %."""
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, CoulombFriction(0.25))
    q = at(0.05 - math.sqrt(GRAVITY / 4 / 1e8))
    rollout = rolled_out(scene, dt, 2.0, q, torch.tensor([4.0, 0.8, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    x, y = (rollout.q[-1, :2] - rollout.q[0, :2]).tolist()
    assert y / x == pytest.approx(0.2, abs=1e-6)
    assert math.hypot(x, y) == pytest.approx((16 + 0.64) / (2 * 0.25 * GRAVITY), rel=5e-3)


def test_rolling_sphere() -> None:
    """A sphere rolling down 15° obeys the scheme's own law of rolling, x = Rφ, to 1e-3: with Δ the turn per step,
    m R² (Δ' − Δ)/Δt² + I (2 sin Δ' − sin(Δ' + Δ))/Δt² = m g R sin 15°; slip is what friction's creep needs, no more."""
    radius, slope, dt = 0.05, math.radians(15), 0.01
    inertia = 0.4 * radius**2
    scene = on_ground(
        free_body(1.0, diagonal(inertia, inertia, inertia)), Sphere(radius), NormalForce(1e6), CoulombFriction(1.0), down(slope)
    )
    q = at(radius - math.sqrt(GRAVITY * math.cos(slope) / 1e6))
    rollout = rolled_out(scene, dt, 0.6, q)
    assert bool(rollout.solved.all())
    turned = rollout.v[1:, 4] * dt
    pull = GRAVITY * radius * math.sin(slope) * dt**2
    balance = radius**2 * turned.diff() + inertia * (2 * torch.sin(turned[1:]) - torch.sin(turned[1:] + turned[:-1])) - pull
    assert float(balance.abs().max()) <= 1e-3 * pull
    slip = rollout.v[1:, 0] - radius * rollout.v[1:, 4]
    assert float(slip.abs().max()) <= 2e-4


@pytest.mark.parametrize("law", ["as printed", "as derived"])
def test_distance_falls_with_the_papers_friction(law: str) -> None:
    """Fig. 5: with PBFD friction the sliding distance falls monotonically with C∥ over four decades."""
    stiffness = (
        torch.logspace(8, 12, 9, dtype=torch.float64) if law == "as printed" else torch.logspace(6, 10, 9, dtype=torch.float64)
    )
    make = PbfdFriction.as_printed if law == "as printed" else PbfdFriction.as_derived
    scene = on_ground(free_body(1.0, box_inertia(1.0, HALF)), Box(HALF), STIFF, make(stiffness[:, None]))
    q = at(0.05 - math.sqrt(GRAVITY / 4 / 1e8)).repeat(9, 1)
    v = torch.zeros(9, 6, dtype=torch.float64)
    v[:, 0] = 1.0
    rollout = rolled_out(scene, 0.02, 0.6, q, v)
    assert bool(rollout.solved.all())
    distance = rollout.q[-1, :, 0] - rollout.q[0, :, 0]
    assert bool((distance.diff() < 0).all())
    assert float(distance[0]) > 2 * float(distance[-1])
