"""Contacts that let go: the law of one step, and bodies that do not bounce however short the steps are."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pbfd_torch import ImplicitEuler, InputError, Simulator
from pbfd_torch.bench.hard_cases_scenes import ball, coulomb, down, placed
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Sphere
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.normal_force import NormalForce
from tests.finite_differences import derivative, relative_error

DT = torch.tensor([0.01], dtype=torch.float64)
STARTS = torch.tensor([-1e-3, 0.0, 4e-4, 1e-3, 3e-3], dtype=torch.float64)
RADIUS = 0.1


@pytest.mark.parametrize("exponent", [1.5, 2.0, 3.0])
def test_law_of_a_step(exponent: float) -> None:
    """All of N where the step ends as deep as it began, none where it ends v Δt less deep, half of it between; slope and energy by
    central differences."""
    law = NormalForce(1e6, exponent, release=0.05)
    step = law.during(STARTS, DT)
    torch.testing.assert_close(step.push(STARTS), law.push(STARTS), rtol=0, atol=0)
    torch.testing.assert_close(step.push(STARTS + 1e-3), law.push(STARTS + 1e-3), rtol=0, atol=0)
    middle = STARTS - 0.5 * 0.05 * DT
    torch.testing.assert_close(step.push(middle), 0.5 * law.push(middle), rtol=1e-12, atol=0)
    assert float(step.push(STARTS - 0.05 * DT).abs().max()) == 0
    torch.manual_seed(0)
    depth = STARTS + 1e-3 * (torch.rand(40, 5, dtype=torch.float64) - 0.5)

    def differentiated(function: Callable[[Tensor], Tensor]) -> Tensor:
        return derivative(lambda delta: function(depth + delta[..., 0])[..., None], 1, tuple(depth.shape), 1e-5)[..., 0, 0]

    slope, force = differentiated(step.push), differentiated(step.energy)
    assert relative_error(step.slope(depth), slope) <= 1e-6
    # the quadrature is exact for whole exponents
    assert relative_error(step.push(depth), force) <= (1e-6 if exponent == int(exponent) else 1e-3)


def test_depth_of_rest_and_what_never_lets_go() -> None:
    """At rest nothing is released; an infinite speed, and a start that is not known, leave the law as it is."""
    depth = torch.linspace(-1e-3, 3e-3, 7, dtype=torch.float64)
    for law in (NormalForce(1e6, release=math.inf).during(torch.full_like(depth, 2e-3), DT), NormalForce(1e6).during(None, DT)):
        torch.testing.assert_close(law.push(depth), NormalForce(1e6).push(depth), rtol=0, atol=0)


def dropped(dt: float, release: float, integrator: Integrator) -> float:
    """How far above the ground a ball from .2 m comes to be again [m], at C⊥ 1e6: the contact lasts some 30 ms."""
    a = ball(RADIUS)
    contact = Contact.between(
        a, [Collider("ball", "body", Sphere(RADIUS))], HalfSpace(), NormalForce(1e6, release=release), coulomb(0.5)
    )
    simulator = Simulator(Scene(a, (Inertia(), contact), down()), dt, integrator)
    rollout = simulator.rollout(simulator.initial_state(placed(RADIUS + 0.2)), steps=round(0.3 / dt))
    assert bool(rollout.solved.all())
    height = rollout.q[:, 2] - RADIUS
    return float(height[int((height < 0).nonzero()[0]) :].max())


@pytest.mark.parametrize("integrator", [ImplicitEuler(), EnergyMomentum()])
def test_short_steps_do_not_bounce(integrator: Integrator) -> None:
    """At 1 ms a contact that gives back what it takes throws the ball up again by centimetres; one that lets go at .1 m/s does not
    at any step: by no more than v²/2g, 0.5 mm."""
    assert dropped(1e-3, math.inf, integrator) > 0.03
    for dt in (1e-3, 5e-3, 0.02):
        assert dropped(dt, 0.1, integrator) < 0.1**2 / (2 * 9.81)


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_bad_speed(speed: float) -> None:
    for law in (lambda: NormalForce(1.0, release=speed), lambda: JointLimits(torch.ones(1, dtype=torch.float64), speed)):
        with pytest.raises(InputError, match=r"release is .* must be a speed > 0"):
            law()
