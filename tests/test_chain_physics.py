"""Chains on slopes and on the ground against closed forms and Newton's law. Every test states its equation."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from pbfd_torch.models.chains import chain_ground, chain_slope, chain_slope_drop
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.rotations import quaternion_matrix, rotation_log
from tests.bodies import GRAVITY, rises
from tests.setup_runs import metric, run


def test_chain_slides_down_a_slope() -> None:
    """Laid straight on 30°, μ .3: slides ½ g (sin − μ cos) T² in T = 10 s at Δt .05, to 1e-6 relative, at Coulomb's bound."""
    setup = chain_slope()
    rollout = run(setup, 0.05, 10.0)
    exact = 0.5 * GRAVITY * (math.sin(math.radians(30)) - 0.3 * math.cos(math.radians(30))) * 100.0
    assert bool(rollout.solved.all())
    assert metric(setup, rollout, "slide_distance_m")[0] == pytest.approx(exact, rel=1e-6)
    assert abs(metric(setup, rollout, "coulomb_margin_m")[0]) <= 1e-6 * exact


@pytest.mark.parametrize(("dt", "duration"), [(0.05, 10.0), (0.02, 5.0), (0.01, 2.0)])
def test_chain_dropped_onto_a_slope(dt: float, duration: float) -> None:
    """Every step solved; penetration < 1 mm; |Coulomb margin| ≤ 5 mm, the bound x(T) ≥ x_0 + ½ g (sin − μ cos) T² − μ (z(T) − z_0);
    energy never above its start by more than .1 %."""
    setup = chain_slope_drop()
    rollout = run(setup, dt, duration)
    assert bool(rollout.solved.all())
    assert 0 < float(rollout.penetration.max()) < 1e-3
    assert abs(metric(setup, rollout, "coulomb_margin_m")[0]) <= 5e-3
    start = float(rollout.energy[0].abs())
    assert float((rollout.energy - rollout.energy[:1]).max()) <= 1e-3 * start


def test_chain_dropped_onto_a_slope_in_large_steps() -> None:
    """Δt .1, 10 s: every step solved."""
    assert bool(run(chain_slope_drop(), 0.1, 10.0).solved.all())


@pytest.mark.parametrize(("stiffness", "deepest"), [(1e6, 7e-3), (5e7, 1e-3)])
def test_chain_dropped_onto_the_ground(stiffness: float, deepest: float) -> None:
    """From .5 m, pitched by 30°, Δt .02 and 2 s: every step solved, energy never rises, and it ends at rest. Penetration < 1 mm at
    C⊥ = 5e7, and √50 times that at the scene's own 1e6 (d ∝ 1/√C⊥)."""
    setup = chain_ground()
    stiff = tuple(
        dataclasses.replace(term, normal_force=NormalForce(stiffness)) if isinstance(term, Contact) else term
        for term in setup.scene.terms
    )
    rollout = run(dataclasses.replace(setup, scene=dataclasses.replace(setup.scene, terms=stiff)), 0.02, 2.0)
    assert bool(rollout.solved.all())
    assert 0 < float(rollout.penetration.max()) < deepest
    assert rises(rollout.energy) <= 1e-9 * float(rollout.energy[0])
    assert float(rollout.kinetic_energy[-1]) <= 1e-6 * float(rollout.energy[0])


def test_contact_forces_carry_the_weight() -> None:
    """Newton's law for the whole chain: Σ contact forces + m g = m a_com at every step of the fall, to 1e-6 of the weight."""
    setup = chain_slope_drop()
    rollout = run(setup, 0.02, 0.8)
    mass = float(setup.scene.articulation.mass.sum())
    momentum = rollout.linear_momentum.diff(dim=0) / 0.02
    force = rollout.contact_force.sum(-2) + mass * setup.scene.gravity
    assert float((momentum - force).abs().max()) <= 1e-6 * mass * GRAVITY
    assert float(rollout.contact_force.sum(-2)[..., 2].max()) > 0.8 * mass * GRAVITY


def test_friction_cone_and_complementarity() -> None:
    """Every recorded contact force has f·n = N ≤ C⊥ d² for d > 0, equal where the candidate sinks, and 0 for d ≤ 0, and
    ‖f∥‖ ≤ μ N; it never pulls."""
    rollout = run(chain_slope_drop(), 0.02, 0.8)
    force, depth = rollout.contact_force, rollout.contact_depth
    normal, most = force[..., 2], 5e7 * depth.clamp_min(0) ** 2
    assert bool((normal <= most * (1 + 1e-9) + 1e-9).all())
    assert float(normal.amin()) >= 0
    sinks = depth[1:] >= depth[:-1]
    assert int((sinks & (depth[1:] > 0)).sum()) > 100
    torch.testing.assert_close(normal[1:][sinks], most[1:][sinks], rtol=1e-9, atol=1e-9)
    tangential = torch.linalg.vector_norm(force[..., :2], dim=-1)
    assert bool((tangential <= 0.3 * normal * (1 + 1e-12)).all())
    sliding = torch.isclose(tangential, 0.3 * normal, rtol=1e-9, atol=0) & (depth > 0)
    assert int(sliding.sum()) > 100


def test_velocity_is_the_rate_of_the_poses() -> None:
    """v_{n+1} = (θ_{n+1} ⊖ θ_n)/Δt (Eq. 3): hinge rates are differences of angles, spins are logarithms of the links' rotations."""
    rollout = run(chain_slope_drop(), 0.02, 0.4)
    angles = rollout.q[:, 0, 7:]
    torch.testing.assert_close(rollout.v[1:, 0, 6:], angles.diff(dim=0) / 0.02, rtol=0, atol=1e-10)
    turns = rollout.link_poses[:, 0, 0, :, :3]
    spin = rotation_log(turns[:-1].mT @ turns[1:]) / 0.02
    torch.testing.assert_close(rollout.v[1:, 0, 3:6], spin, rtol=0, atol=1e-9)
    torch.testing.assert_close(turns, quaternion_matrix(rollout.q[:, 0, 3:7]), rtol=0, atol=1e-12)


def test_far_from_the_origin() -> None:
    """Physics does not depend on where the world's origin is: a chain dropped 1 km away does the same, to 1e-6 m."""
    setup = chain_slope_drop()
    far = setup.q.clone()
    far[:, 0] += 1000.0
    here, there = run(setup, 0.02, 0.5), run(dataclasses.replace(setup, q=far), 0.02, 0.5)
    moved = there.q.clone()
    moved[..., 0] -= 1000.0
    assert bool(there.solved.all())
    torch.testing.assert_close(moved, here.q, rtol=0, atol=1e-6)


def test_sign_of_quaternions_does_not_matter() -> None:
    """q and −q of a quaternion are one rotation: the same rollout, to 1e-9."""
    setup = chain_slope_drop()
    flipped = setup.q.clone()
    flipped[:, 3:7] *= -1
    one, other = run(setup, 0.05, 0.5), run(dataclasses.replace(setup, q=flipped), 0.05, 0.5)
    torch.testing.assert_close(one.link_poses, other.link_poses, rtol=0, atol=1e-9)
