"""The normal force and friction against closed forms: alone, and of one body on a plane."""

from __future__ import annotations

import math

import pytest
import torch

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.contact.shapes import Capsule, Point, Sphere
from pbfd_torch.terms.coulomb_friction import CoulombFriction, slip_factor, slip_factor_slope
from pbfd_torch.terms.normal_force import NormalForce, power
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.tree.kinematics import place
from pbfd_torch.tree.rotations import quaternion_exp, quaternion_multiply
from tests.body_on_plane import contact_points, one_body, pose

# The normal force -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [1.5, 2.0, 2.5, 3.0])
def test_normal_force_carries_a_load_at_its_rest_depth(exponent: float) -> None:
    """f(d) = N at d = (N/C⊥)^{1/α} (METHOD §4); df/dd = α C⊥ d^{α−1}; f = d/dd of the energy C⊥ d^{α+1}/(α+1)."""
    law = NormalForce(3e6, exponent)
    load = torch.tensor([0.1, 9.81, 500.0], dtype=torch.float64)
    depth = (load / 3e6) ** (1 / exponent)
    push, slope = law.force(depth)
    torch.testing.assert_close(push, load, rtol=1e-13, atol=0)
    torch.testing.assert_close(slope, exponent * load / depth, rtol=1e-13, atol=0)
    d = depth.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(law.energy(d).sum(), d)
    torch.testing.assert_close(gradient, load, rtol=1e-12, atol=0)


def test_normal_force_for_weight() -> None:
    """`for_weight` makes a load W rest at the depth asked for: C⊥ = W/d^α."""
    push, _ = NormalForce.for_weight(20.0, 5e-4, 2.5).force(torch.tensor([5e-4], dtype=torch.float64))
    assert float(push) == pytest.approx(20.0, rel=1e-13)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 2.0, 2.5, 3.0, 4.0, 5.0])
def test_power(exponent: float) -> None:
    """base^e for base ≥ 0, with 0^0 = 1 and 0^e = 0, in one world as in many; its gradient is e base^{e−1}."""
    base = torch.tensor([0.0, 1e-9, 0.3, 1.0, 7.0], dtype=torch.float64)
    expected = [x**exponent for x in base.tolist()]
    torch.testing.assert_close(power(base, exponent), torch.tensor(expected, dtype=torch.float64), rtol=1e-13, atol=0)
    assert all(torch.equal(power(base[k], exponent), power(base, exponent)[k]) for k in range(5))
    x = base[1:].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(power(x, exponent).sum(), x) if exponent else (torch.zeros(4, dtype=torch.float64),)
    torch.testing.assert_close(gradient, exponent * base[1:] ** (exponent - 1), rtol=1e-12, atol=0)


# Friction of one body on a plane --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("speed", "share"), [(0.5, 1.0), (1e-3, 1.0), (5e-4, 0.75), (1e-4, 0.19), (0.0, 0.0)])
def test_coulomb_force(speed: float, share: float) -> None:
    """f∥ = −μ N s(‖u‖) u: of size μN against the slip from ε_v = 1 mm/s on, and (2 − y)y μN at y = v/ε_v below; N = C⊥ d²."""
    articulation, made = one_body(Point(), CoulombFriction(0.4, 1e-3))
    direction = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64)
    dt, depth = 0.01, 2e-3
    after = pose((0.0, 0.0, -depth))
    after[:3] += speed * dt * direction
    points, load = contact_points(articulation, made, pose((0.0, 0.0, -depth)), after, dt)
    normal = 1e6 * depth**2
    expected = torch.tensor([0.0, 0.0, normal], dtype=torch.float64) - 0.4 * normal * share * direction
    torch.testing.assert_close(points.force[0], expected, rtol=0, atol=1e-9 * normal)
    torch.testing.assert_close(-load.moment[0, :, 3], expected, rtol=0, atol=1e-9 * normal)


def test_slip_factor_is_smooth() -> None:
    """s·y rises from 0 to 1 at y = w with slope 2/w at 0 and 0 at w, and stays 1: both s and its slope are continuous at w."""
    width = torch.tensor(1e-3, dtype=torch.float64)
    eps = 1e-9
    below, above = width * (1 - eps), width * (1 + eps)
    assert float(slip_factor(below, width) * width) == pytest.approx(1.0, abs=1e-8)
    for function in (slip_factor, slip_factor_slope):
        assert float(function(below, width)) == pytest.approx(float(function(above, width)), rel=1e-8)
    y = torch.linspace(0.0, 3e-3, 301, dtype=torch.float64)
    force = slip_factor(y, width) * y
    assert bool((force.diff() >= -1e-12).all())
    assert float(force[0]) == 0
    assert float(force[1:2] / y[1:2]) == pytest.approx(2 / 1e-3, rel=1e-2)
    assert float((force[y >= 1e-3] - 1).abs().max()) <= 1e-12


@pytest.mark.parametrize("beta", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("printed", [True, False], ids=["as printed", "as derived"])
def test_pbfd_friction_is_coulombs_with_a_calibrated_mu(beta: float, printed: bool) -> None:
    """With α = 2, γ = 1: f∥ = −μ_eff N u/‖u‖, μ_eff = (β + 1)(C∥/C⊥)(v Δt)^{β+1} as printed, ^β as derived, at any depth."""
    tangential, normal_stiffness, dt, speed = 4e5, 1e6, 0.02, 0.7
    law = (PbfdFriction.as_printed if printed else PbfdFriction.as_derived)(tangential, beta, 1.0)
    articulation, made = one_body(Point(), law, normal_stiffness)
    mu = (beta + 1) * tangential / normal_stiffness * (speed * dt) ** (beta + 1 if printed else beta)
    for depth in (1e-4, 1e-3, 1e-2):
        points, _ = contact_points(articulation, made, pose((0.0, 0.0, 0.0)), pose((speed * dt, 0.0, -depth)), dt)
        normal = normal_stiffness * depth**2
        assert float(points.force[0, 2]) == pytest.approx(normal, rel=1e-12)
        assert float(points.force[0, 0]) == pytest.approx(-mu * normal, rel=1e-12)


@pytest.mark.parametrize("beta", [1.0, 2.0])
@pytest.mark.parametrize("printed", [True, False], ids=["as printed", "as derived"])
def test_calibrated_friction_brakes_with_mu(beta: float, printed: bool) -> None:
    """`calibrated(μ, C⊥, v, Δt)`: at slip v Δt the law brakes with μN exactly, at any depth."""
    law = (PbfdFriction.as_printed if printed else PbfdFriction.as_derived)(1.0, beta, 1.0).calibrated(0.35, 1e6, 0.7, 0.02)
    articulation, made = one_body(Point(), law, 1e6)
    for depth in (1e-4, 1e-2):
        points, _ = contact_points(articulation, made, pose((0.0, 0.0, 0.0)), pose((0.0, 0.7 * 0.02, -depth)), 0.02)
        assert float(points.force[0, 1]) == pytest.approx(-0.35 * 1e6 * depth**2, rel=1e-12)


@pytest.mark.parametrize("angle", [1e-6, 0.01, 0.5, 2.0, 3.1])
@pytest.mark.parametrize("direction", [0.0, 0.8])
def test_pure_rolling_does_not_slip(angle: float, direction: float) -> None:
    """A sphere that turns by φ while its centre moves by φ × ρ n has u = 0 at every angle φ < π, where the chord has Rφ³/6;
    and so does every sphere of a capsule that rolls across its axis."""
    radius, depth = 0.05, 1e-3
    axis = (-math.sin(direction), math.cos(direction), 0.0)
    turn = (angle * axis[0], angle * axis[1], 0.0)
    for start in ((0.0, 0.0, 0.0), (0.3, 1.0, -0.2)):
        articulation, made = one_body(Sphere(radius), CoulombFriction(0.5))
        before = pose((1.0, 2.0, radius - depth), start)
        after = before.clone()
        after[0] += radius * angle * math.cos(direction)
        after[1] += radius * angle * math.sin(direction)
        after[3:] = quaternion_multiply(quaternion_exp(torch.tensor(turn, dtype=torch.float64)), before[3:])
        points, _ = contact_points(articulation, made, before, after, 0.01)
        assert float(points.depth) == pytest.approx(depth, rel=1e-9)
        assert float(points.slip.abs().max()) <= 1e-14
        assert float(points.force[0, :2].abs().max()) <= 1e-9
    articulation, made = one_body(Capsule(radius, 0.2), CoulombFriction(0.5))
    lying = quaternion_exp(0.5 * math.pi * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))  # its axis along −y
    before = torch.cat((torch.tensor([0.0, 0.0, radius - depth], dtype=torch.float64), lying))
    after = before.clone()
    after[0] += radius * angle
    after[3:] = quaternion_multiply(quaternion_exp(torch.tensor([0.0, angle, 0.0], dtype=torch.float64)), lying)
    points, _ = contact_points(articulation, made, before, after, 0.01)
    assert points.slip.shape == (2, 3)
    assert float(points.slip.abs().max()) <= 1e-14


def test_spinning_in_place_slips() -> None:
    """A sphere that turns by φ about y without moving slips by u = −ρ φ × n = −ρφ x: the surface point runs backwards."""
    articulation, made = one_body(Sphere(0.05), CoulombFriction(0.5))
    points, _ = contact_points(articulation, made, pose((0, 0, 0.049)), pose((0, 0, 0.049), (0.0, 0.3, 0.0)), 0.01)
    torch.testing.assert_close(points.slip[0], torch.tensor([-0.015, 0.0, 0.0], dtype=torch.float64), rtol=0, atol=1e-15)


def test_force_acts_at_the_surface() -> None:
    """Friction of a sphere acts at c − ρn: its moment about the centre is (−ρ n) × f; a point with a margin feels it itself."""
    for shape, margin, lever in ((Sphere(0.05), 0.0, 0.05), (Point(), 0.05, 0.0)):
        articulation, made = one_body(shape, CoulombFriction(0.5), margin=margin)
        before = pose((0.4, -0.3, 0.049))
        after = before.clone()
        after[0] += 0.01
        points, load = contact_points(articulation, made, before, after, 0.01)
        residual = Balance(place(articulation, after), [load]).residual
        force = points.force[0]
        arm = torch.tensor([0.0, 0.0, -lever], dtype=torch.float64)
        torch.testing.assert_close(residual[:3], -force, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(residual[3:], -torch.linalg.cross(arm, force), rtol=1e-12, atol=1e-12)
        assert float(force[0]) == pytest.approx(-0.5 * float(force[2]), rel=1e-12)
