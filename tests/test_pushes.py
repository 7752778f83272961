"""Pushes against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from pbfd_torch import Articulation, InputError, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.pushes import Pushes


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_a_pushed_body_accelerates_by_force_over_mass() -> None:
    """2 kg, 3 N at the centre of mass for 1 s: x = F t²/(2m) and no turning, at Δt .1 and .01, each exact for constant forces."""
    link = Link(
        "body", joints=(Joint("free", JointKind.FREE),), mass=2.0, com=(0.1, 0.0, 0.0), inertia=((1, 0, 0), (0, 1, 0), (0, 0, 1))
    )
    articulation = Articulation.from_links([link])
    push = Pushes.at_centers(articulation, tensor(3.0, 0.0, -1.0)[None])
    scene = Scene(articulation, (Inertia(), push), tensor(0.0, 0.0, 0.0))
    for dt in (0.1, 0.01):
        simulator = Simulator(scene, dt)
        rollout = simulator.rollout(simulator.initial_state(articulation.rest[None]), steps=round(1 / dt))
        moved = rollout.center_of_mass[-1, 0] - rollout.center_of_mass[0, 0]
        torch.testing.assert_close(moved, tensor(0.75, 0.0, -0.25), atol=1e-10, rtol=0)
        torch.testing.assert_close(rollout.angular_momentum[-1, 0], torch.zeros(3, dtype=torch.float64), atol=1e-10, rtol=0)


def test_a_push_on_a_hinge_is_a_pendulum() -> None:
    """A rod hinged at its end under a constant force at its tip: I θ̈ = F ℓ cos θ, here by Runge–Kutta to 1e-10. Error after .4 s (a
    turn of 2.6 rad) below 1e-3 rad at Δt .01, and falling nearly with the square of the step."""
    length, force, inertia = 0.5, 2.0, 0.05
    rows = ((inertia, 0, 0), (0, inertia, 0), (0, 0, inertia))
    link = Link("rod", joints=(Joint("hinge", JointKind.HINGE, (0.0, 1.0, 0.0)),), mass=1.0, inertia=rows)
    articulation = Articulation.from_links([link])
    push = Pushes(tensor(0.0, 0.0, -force)[None], tensor(length, 0.0, 0.0)[None])
    scene = Scene(articulation, (Inertia(), push), tensor(0.0, 0.0, 0.0))

    def motion(_: float, x: NDArray[np.float64]) -> list[float]:
        return [x[1], force * length * math.cos(x[0]) / inertia]

    exact = float(solve_ivp(motion, (0, 0.4), (0.0, 0.0), rtol=1e-10, atol=1e-12).y[0, -1])
    errors = []
    for dt in (0.01, 0.005, 0.0025):
        simulator = Simulator(scene, dt)
        rollout = simulator.rollout(simulator.initial_state(articulation.rest[None]), steps=round(0.4 / dt))
        errors.append(abs(float(rollout.q[-1, 0, 0]) - exact))
    assert errors[0] < 1e-3
    assert errors[0] / errors[1] > 3
    assert errors[1] / errors[2] > 3


def test_pushes_are_checked() -> None:
    """Wrong shapes and NaN are refused."""
    with pytest.raises(InputError, match="must be \\[\\*batch, links, 3\\]"):
        Pushes(torch.zeros(2, 2), torch.zeros(2, 3))
    with pytest.raises(InputError, match="NaN"):
        Pushes(torch.full((1, 3), math.nan), torch.zeros(1, 3))
