"""PBD's friction, friction that is stronger at rest, and the stiffnesses that give a wanted μ or penetration."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Point
from pbfd_torch.errors import InputError
from pbfd_torch.scene import Scene
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.calibration import (
    calibrated_pbd,
    calibrated_pbfd,
    effective_mu,
    largest_pbd_mu,
    load_per_point,
    normal_force_for,
    rest_penetration,
    sliding_penetration,
)
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw, Lifting, SlipLaw, Storing
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbd_friction import PbdFriction
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.terms.static_friction import StaticFriction
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from tests.states import implicit

GRAVITY = 9.81
DT = torch.tensor(0.01, dtype=torch.float64)
STATIC = StaticFriction(0.6, 0.4, slip_speed=1e-3, stribeck_speed=2e-2)
Law = PbfdFriction | PbdFriction


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def sliding_point(law: FrictionLaw, normal_force: NormalForce, slope: float = 0.0) -> Scene:
    """1 kg on one point that moves along x and z, over a plane that falls off towards +x by `slope` [rad]."""
    joints = (Joint("along", JointKind.SLIDE, (1.0, 0.0, 0.0)), Joint("up", JointKind.SLIDE, (0.0, 0.0, 1.0)))
    inertia = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))
    articulation = Articulation.from_links([Link("point", joints=joints, mass=1.0, inertia=inertia)])
    contact = Contact.between(articulation, [Collider("point", "point", Point())], HalfSpace(), normal_force, law)
    gravity = GRAVITY * tensor(math.sin(slope), 0.0, -math.cos(slope))
    return Scene(articulation, (Inertia(), contact), gravity)


def slid(scene: Scene, dt: float, steps: int, speed: float, depth: float) -> tuple[Tensor, Tensor]:
    """Position and velocity after every step, `[steps, 2]`; every step is solved."""
    simulator = implicit(scene, dt)
    state = simulator.initial_state(tensor(0.0, -depth), tensor(speed, 0.0))
    places = [state.q_previous, state.q]
    for _ in range(steps):
        state, solution = simulator.step(state)
        assert bool(solution.solved)
        places.append(state.q)
    x = torch.stack(places)
    return x[2:], x.diff(dim=0)[1:] / dt


# PBD --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("beta", "gamma"), [(1.0, 1.0), (1.5, 1.0), (2.0, 1.5)])
def test_pbd_force_is_minus_the_gradient(beta: float, gamma: float) -> None:
    """Drag times slip and lift, by automatic differentiation of C∥ ‖u‖^{β+1} d^{γ+1}: ≤ 1e-14 relative; the drag is that of PBFD as
    derived. Its slopes are those of drag and lift."""
    law, beside = PbdFriction(3e4, beta, gamma), PbfdFriction.as_derived(3e4, beta, gamma)
    slip = torch.tensor([[0.02, -0.01, 0.0], [0.3, 0.1, 0.2]], dtype=torch.float64, requires_grad=True)
    depth = torch.tensor([0.004, 0.03], dtype=torch.float64, requires_grad=True)
    size = slip.detach().norm(dim=-1).requires_grad_()
    by_depth, by_slip = torch.autograd.grad(law.energy(depth, slip, DT).sum(), (depth, slip))
    drag, lift, none = law.drag(depth, depth, size, DT), law.lift(depth, size), torch.zeros_like(depth)
    torch.testing.assert_close(by_slip, drag[:, None] * slip, rtol=1e-14, atol=0)
    torch.testing.assert_close(by_depth, lift, rtol=1e-14, atol=0)
    torch.testing.assert_close(drag, beside.drag(none, depth, size, DT), rtol=1e-14, atol=0)
    for value, slopes in ((drag, law.drag_slopes(none, none, depth, size, DT)), (lift, law.lift_slopes(depth, size))):
        a, b = torch.autograd.grad(value.sum(), (depth, size), materialize_grads=True)
        torch.testing.assert_close(slopes[0], a, rtol=1e-13, atol=0)
        torch.testing.assert_close(slopes[1], b / size.detach(), rtol=1e-13, atol=0)


@pytest.mark.parametrize(("beta", "gamma"), [(1.0, 1.0), (2.0, 1.5)])
def test_pbd_is_finite_where_it_is_singular(beta: float, gamma: float) -> None:
    """At zero slip, at d = 0 and apart: derivatives of first and second order are finite; apart and at d = 0 all is zero."""
    law = PbdFriction(3e4, beta, gamma)
    slip = torch.zeros(3, 3, dtype=torch.float64, requires_grad=True)
    depth = tensor(0.01, 0.0, -0.01).requires_grad_()
    first = torch.autograd.grad(law.energy(depth, slip, DT).sum(), (depth, slip), create_graph=True)
    second = torch.autograd.grad([x.sum() for x in first], (depth, slip), allow_unused=True, materialize_grads=True)
    assert all(bool(torch.isfinite(x).all()) for x in (*first, *second))
    fast, depth = torch.ones(3, dtype=torch.float64), depth.detach()
    for value in (law.drag(fast, depth, fast, DT), law.lift(depth, fast), *law.lift_slopes(depth, fast)):
        assert bool((value[1:] == 0).all())
        assert float(value[0]) > 0


def test_what_the_laws_are() -> None:
    """PBD lifts and stores, and is not lagged; the static law is a slip law."""
    pbd: object = PbdFriction(1.0)
    static: object = STATIC
    assert isinstance(pbd, Lifting)
    assert isinstance(pbd, Storing)
    assert not isinstance(pbd, SlipLaw)
    assert isinstance(static, SlipLaw)
    assert not isinstance(static, Lifting | Storing)


# Static and kinetic -----------------------------------------------------------------------------------------------------


def mu_at(law: FrictionLaw, speed: Tensor) -> Tensor:
    """Friction per newton at slip speeds `[n]`."""
    one = torch.ones_like(speed)
    return law.drag(one, one, speed * DT, DT) * speed * DT


def test_static_friction_rises_peaks_and_falls() -> None:
    """From 0 to μ_s at ε_v, then by the Gaussian to μ_k; with μ_s = μ_k it is Coulomb's law; the rise is Coulomb's too."""
    speed = torch.logspace(-6, 1, 701, dtype=torch.float64)
    mu = mu_at(STATIC, speed)
    assert float(mu_at(STATIC, tensor(1e-3))[0]) == pytest.approx(0.6, rel=1e-14)
    assert float(mu.max()) <= 0.6 * (1 + 1e-14)
    assert float(mu[-1]) == pytest.approx(0.4, rel=1e-14)
    rising = speed < 1e-3
    assert bool((mu[rising].diff() > 0).all())
    assert bool((mu[~rising].diff() <= 1e-15).all())
    expected = 0.4 + 0.2 * torch.exp(-(((speed - 1e-3) / 2e-2) ** 2))
    torch.testing.assert_close(mu[~rising], expected[~rising], rtol=1e-13, atol=0)
    torch.testing.assert_close(mu[rising], mu_at(CoulombFriction(0.6), speed)[rising], rtol=1e-14, atol=0)
    torch.testing.assert_close(mu_at(StaticFriction(0.3, 0.3), speed), mu_at(CoulombFriction(0.3), speed), rtol=1e-14, atol=0)


def test_static_friction_is_the_gradient_of_its_slip_energy() -> None:
    """f∥ = −∂/∂u at every slip, from rest through ε_v to kinetic sliding; slopes likewise, and equal on both sides of ε_v."""
    speed = torch.cat((tensor(0.0, 1e-3), torch.logspace(-5, 1, 61, dtype=torch.float64)))
    slip = (speed * DT)[:, None] * tensor(0.6, -0.8, 0.0)
    slip.requires_grad_()
    normal = torch.full_like(speed, 7.0)
    (gradient,) = torch.autograd.grad(STATIC.slip_energy(normal, normal, slip, DT).sum(), slip)
    size = (speed * DT).requires_grad_()
    drag = STATIC.drag(normal, normal, size, DT)
    torch.testing.assert_close(gradient, (drag[:, None] * slip).detach(), rtol=1e-12, atol=1e-14)
    (slope,) = torch.autograd.grad(drag.sum(), size)
    by_depth, by_size = STATIC.drag_slopes(normal, torch.full_like(normal, 3.0), normal, size, DT)
    torch.testing.assert_close(by_size * size, torch.where(size > 0, slope, 0.0), rtol=1e-12, atol=0)
    torch.testing.assert_close(by_depth, drag * 3 / 7, rtol=1e-14, atol=0)
    sides = 1e-3 * DT * (1 + tensor(-1e-9, 1e-9))
    _, beside = STATIC.drag_slopes(normal[:2], normal[:2], normal[:2], sides, DT)
    assert float(beside[0]) == pytest.approx(float(beside[1]), rel=1e-6)


def test_static_friction_widened() -> None:
    """widened(f) at f times the slip is the law at the slip, in force; one is the law itself."""
    speed = torch.logspace(-5, 0, 41, dtype=torch.float64)
    torch.testing.assert_close(mu_at(STATIC.widened(8.0), 8 * speed), mu_at(STATIC, speed), rtol=1e-13, atol=0)


def test_static_friction_holds_at_rest_and_lets_slide_in_motion() -> None:
    """On a slope between atan μ_k and atan μ_s: from rest it creeps at most at ε_v; pushed, it goes on, at g (sin − μ_k cos)."""
    slope, dt, force = math.atan(0.5), 2e-3, NormalForce(1e6)
    depth = float(rest_penetration(force, GRAVITY * math.cos(slope)))
    scene = sliding_point(STATIC, force, slope)
    x, _ = slid(scene, dt, 100, 0.0, depth)
    assert 0 <= float(x[-1, 0]) <= 1e-3 * 100 * dt
    _, v = slid(scene, dt, 100, 0.5, depth)
    assert float((v[-1, 0] - v[49, 0]) / (50 * dt)) == pytest.approx(GRAVITY * (math.sin(slope) - 0.4 * math.cos(slope)), rel=1e-6)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: StaticFriction(0.25, 0.5), "static μ is 0.25: must be ≥ the kinetic μ, 0.5"),
        (lambda: StaticFriction(0.3, -0.5), "kinetic μ is -0.5: must be ≥ 0 and finite"),
        (lambda: StaticFriction(math.nan, 0.1), "static μ is nan: must be ≥ 0 and finite"),
        (lambda: StaticFriction(0.3, 0.2, 0.0), "slip_speed is 0.0 m/s: must be > 0 and finite"),
        (lambda: StaticFriction(0.3, 0.2, 1e-3, math.inf), "stribeck_speed is inf m/s: must be > 0 and finite"),
        (lambda: STATIC.widened(0.5), "0.5: must be ≥ 1 and finite"),
        (lambda: PbdFriction(-1.0), "C∥ is -1.0: must be ≥ 0 and finite"),
        (lambda: PbdFriction(1.0, 0.5), "β is 0.5: must be ≥ 1 and finite"),
        (lambda: PbdFriction(1.0, 1.0, math.nan), "γ is nan: must be ≥ 1 and finite"),
        (lambda: normal_force_for(0.0, 9.81, 4), "mass is 0.0 kg: must be > 0"),
        (lambda: normal_force_for(1.0, 9.81, 0), "points is 0: must be > 0"),
        (lambda: effective_mu(CoulombFriction(0.5), NormalForce(1e6), 0.0, 0.01), "speed is 0.0 m/s: must be > 0"),
        (lambda: effective_mu(CoulombFriction(0.5), NormalForce(1e6), 1.0, -0.5), "dt is -0.5 s: must be > 0"),
        (lambda: effective_mu(CoulombFriction(0.5), NormalForce(1e6), 1.0, 0.01, 0.0), "load is 0.0 N: must be > 0"),
        (lambda: calibrated_pbfd(PbfdFriction.as_printed(0.0), -0.5, NormalForce(1e6), 1.0, 0.01), "μ is -0.5: must be ≥ 0"),
        (lambda: calibrated_pbd(PbdFriction(0.0), 0.5, NormalForce(1e6), 1.0, 0.01, 1.0), "μ is 0.5: must be at most 0.038"),
    ],
)
def test_bad_parameters_are_refused(make: Callable[[], object], words: str) -> None:
    """The message names the parameter, its value and its range."""
    with pytest.raises(InputError, match=re.escape(words)):
        make()


# Calibration ------------------------------------------------------------------------------------------------------------

LAWS = [
    PbfdFriction.as_printed(0.0),
    PbfdFriction.as_derived(0.0),
    PbfdFriction.as_printed(0.0, 0.5, 1.5),
    PbfdFriction.as_derived(0.0, 2.0, 2.0),
    PbdFriction(0.0),
    PbdFriction(0.0, 2.0, 1.5),
]


def calibrated(law: Law, mu: Tensor, force: NormalForce, speed: float, dt: float, load: float) -> Law:
    """The law at which a point feels μ."""
    if isinstance(law, PbdFriction):
        return calibrated_pbd(law, mu, force, speed, dt, load)
    return calibrated_pbfd(law, mu, force, speed, dt, load)


@pytest.mark.parametrize("law", LAWS, ids=str)
@pytest.mark.parametrize("exponent", [2.0, 1.5])
def test_friction_calibrated_and_back(law: Law, exponent: float) -> None:
    """`effective_mu` of the calibrated law is μ: to 1e-12, one μ a world; PBD up to the largest that it can give."""
    force, speed, dt, load = NormalForce(2e5, exponent), 0.7, 0.02, 3.0
    share = tensor(0.0, 0.1, 0.5, 0.9, 0.999, 1.0)
    most = float(largest_pbd_mu(law, force, speed, dt, load)) if isinstance(law, PbdFriction) else 1.0
    made = calibrated(law, most * share, force, speed, dt, load)
    assert type(made) is type(law)
    torch.testing.assert_close(effective_mu(made, force, speed, dt, load), most * share, rtol=1e-12, atol=0)


def test_calibration_at_any_load() -> None:
    """γ + 1 = α: the C∥ of METHOD §4, and μ at every load; not so where γ + 1 ≠ α."""
    force, load = NormalForce(1e6), torch.logspace(-2, 3, 6, dtype=torch.float64)
    law = calibrated_pbfd(PbfdFriction.as_printed(0.0), 0.35, force, 0.7, 0.02)
    assert law.stiffness == pytest.approx(0.35 * 1e6 / (2 * (0.7 * 0.02) ** 2), rel=1e-12)
    torch.testing.assert_close(effective_mu(law, force, 0.7, 0.02, load), torch.full_like(load, 0.35), rtol=1e-12, atol=0)
    other = calibrated_pbfd(PbfdFriction.as_printed(0.0, 1.0, 1.5), 0.35, force, 0.7, 0.02, 1.0)
    torch.testing.assert_close(effective_mu(other, force, 0.7, 0.02, load), 0.35 * load**0.25, rtol=1e-12, atol=0)


@pytest.mark.parametrize("exponent", [2.0, 1.5])
def test_largest_mu_of_pbd(exponent: float) -> None:
    """Over all C∥ `effective_mu` is never larger than `largest_pbd_mu` and reaches it; beyond it more C∥ gives less friction.
    With α = 2: 2/(3√3) d₀/(v Δt)."""
    force, speed, dt, load = NormalForce(2e6, exponent), 1.0, 0.02, 3.0
    law = PbdFriction(torch.logspace(3, 12, 9001, dtype=torch.float64))
    mu, most = effective_mu(law, force, speed, dt, load), float(largest_pbd_mu(law, force, speed, dt, load))
    assert float(mu.max()) <= most * (1 + 1e-12)
    assert float(mu.max()) == pytest.approx(most, rel=1e-5)
    top = int(mu.argmax())
    assert bool((mu[: top + 1].diff() > 0).all())
    assert bool((mu[top:].diff() < 0).all())
    if exponent == 2:
        assert most == pytest.approx(2 / (3 * math.sqrt(3)) * math.sqrt(3.0 / 2e6) / 0.02, rel=1e-14)


@pytest.mark.parametrize("exponent", [1.5, 2.0, 3.0])
def test_penetration_calibrated_and_back(exponent: float) -> None:
    """C⊥ = m g/(n d^α) and d = (m g/(n C⊥))^{1/α}, one mass a world too; a simulated point rests there, to 1e-9."""
    mass = tensor(0.5, 1.0, 20.0)
    force = normal_force_for(mass, GRAVITY, 4, 2e-3, exponent)
    torch.testing.assert_close(rest_penetration(force, load_per_point(mass, GRAVITY, 4)), torch.full_like(mass, 2e-3))
    one = normal_force_for(1.0, GRAVITY, 1, 2e-3, exponent)
    simulator = implicit(sliding_point(CoulombFriction(0.5), one), 0.02)
    state = simulator.initial_state(tensor(0.0, -1e-3))
    for _ in range(200):
        state, _ = simulator.step(state)
    assert float(state.q[1]) == pytest.approx(-2e-3, rel=1e-9)


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_calibrated_friction_brakes_a_sliding_body(law: Law) -> None:
    """A body that slides at v and carries W = m (g + z̈) is slowed by μ(v) W/m, to 1e-6, and where v is nearest to the calibrated
    speed by μ g, to 1 %: v is not quite there, and PBD's body still sinks."""
    speed, dt, depth, mu = 1.0, 5e-3, 2e-3, 0.1
    force = normal_force_for(1.0, GRAVITY, 1, depth)
    made = calibrated(law, tensor(mu), force, speed, dt, GRAVITY)
    start = speed + 20 * dt * mu * GRAVITY
    v = slid(sliding_point(made, force), dt, 40, start, float(sliding_penetration(made, force, start, dt, GRAVITY)))[1]
    acceleration = v.diff(dim=0) / dt
    load = GRAVITY + acceleration[:, 1]
    expected = effective_mu(made, force, v[1:, 0], dt, load) * load
    torch.testing.assert_close(-acceleration[:, 0], expected, rtol=1e-6, atol=0)
    at = int((v[1:, 0] - speed).abs().argmin())
    assert float(-acceleration[at, 0]) == pytest.approx(mu * GRAVITY, rel=0.01)


def test_effective_mu_of_other_laws() -> None:
    """Coulomb's: μ; static: μ_k at speed and μ_s at ε_v; anchored: μ beyond its stretch. At any load."""
    force, load = NormalForce(1e6), tensor(0.1, 30.0)
    for law, speed, mu in (
        (CoulombFriction(0.3), 1.0, 0.3),
        (STATIC, 1.0, 0.4),
        (STATIC, 1e-3, 0.6),
        (AnchoredFriction(0.3), 1.0, 0.3),
    ):
        torch.testing.assert_close(effective_mu(law, force, speed, 0.01, load), torch.full_like(load, mu), rtol=1e-12, atol=0)
