"""Balls that are frictionless among themselves hit each other through their centres: nothing but a floor turns them."""

from __future__ import annotations

import math

import pytest
import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Sphere
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact_terms import contact_terms
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from tests.bodies import diagonal, down, rolled_out

RADIUS = 0.03


def balls(count: int, *obstacles: HalfSpace) -> Scene:
    """Frictionless solid balls of .17 kg."""
    inertia = diagonal(*[0.4 * 0.17 * RADIUS**2] * 3)
    names = [f"ball{k}" for k in range(count)]
    links = [Link(name, joints=(Joint(f"{name}_free", JointKind.FREE),), mass=0.17, inertia=inertia) for name in names]
    articulation = Articulation.from_links(links)
    colliders = [Collider(name, name, Sphere(RADIUS), friction=0.0) for name in names]
    gravity = down() if obstacles else torch.zeros(3, dtype=torch.float64)
    return Scene(articulation, (Inertia(), *contact_terms(articulation, colliders, obstacles)), gravity)


def row() -> tuple[Scene, torch.Tensor, torch.Tensor]:
    """Five balls that touch each other, at rest on a floor of μ = .2, and a sixth that slides at them at 1 m/s without spin."""
    scene = balls(6, HalfSpace(friction=0.2))
    q, v = scene.articulation.rest.reshape(1, 6, 7).clone(), torch.zeros(1, 36, dtype=torch.float64)
    q[0, :, 0] = 2 * RADIUS * torch.arange(6) - 0.1 * (torch.arange(6) == 0)
    q[..., 2], v[0, 0] = RADIUS, 1.0
    return scene, q.flatten(1), v


@pytest.mark.parametrize(("surplus", "off"), [(math.inf, 1e-8), (1e-3, 1e-6)], ids=["without an account", "with one"])
@pytest.mark.parametrize("dt", [0.005, 0.01, 0.02, 0.05])
def test_a_floor_trades_momentum_for_spin(dt: float, surplus: float, off: float) -> None:
    """Energy–momentum. An impulse at the floor changes m v by as much as I ω/R the other way, one between balls changes the m v of
    both, oppositely: Σ (v + 2/5 ω R) stays 1 m/s. The few steps that the account makes easier ones brake slow spins by φ³."""
    scene, q, v = row()
    rollout = rolled_out(scene, dt, 0.3, q, v, integrator=EnergyMomentum(surplus))
    assert bool(rollout.solved.all())
    end = rollout.v[-1].reshape(6, 6)
    assert float((end[:, 0] + 0.4 * RADIUS * end[:, 4]).sum()) == pytest.approx(1.0, abs=off)
    assert float(end[-1, 0]) > 0.1


@pytest.mark.parametrize("dt", [0.005, 0.01, 0.02, 0.05])
def test_a_floor_trades_momentum_for_what_implicit_euler_keeps_of_spin(dt: float) -> None:
    """In the paper's step a body that turns by φ₀ and then by φ feels the torque I (2 sin φ − sin(φ + φ₀))/Δt² (METHOD §2), so
    Σ Δv + 2/5 R (2 sin φ − sin(φ + φ₀))/Δt = 0 in every step. Without a torque φ = φ₀ − φ₀³: that, and nothing else, takes
    momentum."""
    scene, q, v = row()
    rollout = rolled_out(scene, dt, 0.3, q, v, integrator=ImplicitEuler())
    assert bool(rollout.solved.all())
    moved, turned = rollout.v.reshape(-1, 6, 6)[1:, :, 0], dt * rollout.v.reshape(-1, 6, 6)[1:, :, 4]
    spin = (2 * turned[1:].sin() - (turned[1:] + turned[:-1]).sin()) / dt
    assert float(((moved[1:] - moved[:-1]) + 0.4 * RADIUS * spin).sum(-1).abs().max()) <= 1e-10
    assert float(moved[-1, -1]) > 0.1


@pytest.mark.parametrize(("speed", "dt"), [(2.0, 0.005), (2.0, 0.01), (2.0, 0.02), (0.8, 0.05)])
def test_frictionless_balls_keep_their_spins(speed: float, dt: float) -> None:
    """Balls that spin and hit each other off centre, in directions all around: momentum stays, and so do the spins."""
    scene = balls(2)
    angle = torch.linspace(0, 2 * math.pi, 24, dtype=torch.float64)
    beside = torch.linspace(0.0, 0.03, 24, dtype=torch.float64)
    q, v = scene.articulation.rest.repeat(24, 1), torch.zeros(24, 12, dtype=torch.float64)
    q[:, 0], q[:, 1], q[:, 2] = -0.2, beside * angle.cos(), beside * angle.sin()
    v[:, 0], v[:, 4], v[:, 9] = speed, 10.0, 8.0
    rollout = rolled_out(scene, dt, 0.4 / speed, q, v, integrator=EnergyMomentum())
    assert bool(rollout.solved.all())
    after = rollout.v[-1]
    assert float((after[:, 3:6] - v[:, 3:6]).abs().max()) <= 1e-8
    assert float((after[:, 9:] - v[:, 9:]).abs().max()) <= 1e-8
    assert float((after[:, :3] + after[:, 6:9] - v[:, :3]).abs().max()) <= 1e-8
    assert bool((after[:, 6] > 0.05 * speed).all())
