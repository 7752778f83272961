"""Forces of limits, dry friction and damping against closed forms; coefficients that are refused."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from pbfd_torch.contact.shapes import Point
from pbfd_torch.errors import InputError
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import JointDamping, checked_coefficient
from pbfd_torch.tree.kinematics import place, retract
from tests.body_on_plane import one_body, pose
from tests.states import state_of
from tests.term_cases import situation


def test_joint_limit_torque() -> None:
    """Torque −k x² back into the range at a violation x; energy k x³/3; a load τ rests √(τ/k) past the limit."""
    s = situation(0)
    a = s.articulation
    k = torch.full((a.nv,), 40.0, dtype=torch.float64)
    limits = JointLimits(k, math.inf)
    residual = limits.load(limits.prepare(s.context(s.q)), place(a, s.q)).residual
    x = s.q[a.topology.scalar_q]
    lower, upper = a.lower[a.topology.scalar_v], a.upper[a.topology.scalar_v]
    expected = 40.0 * ((x - upper).clamp_min(0) ** 2 - (lower - x).clamp_min(0) ** 2)
    torch.testing.assert_close(residual[a.topology.scalar_v], expected, rtol=1e-12, atol=1e-12)
    others = torch.cat((a.topology.free_v.flatten(), a.topology.turning_v.flatten()))
    assert bool((residual[others] == 0).all())


def test_dry_friction_torque() -> None:
    """Torque of size τ against the motion once |q̇| ≥ slip_speed; (2 − y) y τ at y = |q̇|/slip_speed below."""
    s = situation(0)
    a = s.articulation
    torque = torch.zeros(a.nv, dtype=torch.float64)
    torque[a.topology.scalar_v] = 2.0
    for y, share in ((3.0, 1.0), (1.0, 1.0), (0.5, 0.75), (-0.5, -0.75), (-3.0, -1.0)):
        q = s.state.q.clone()
        q[a.topology.scalar_q] += y * 0.1 * float(s.dt)
        residual = s.balance([JointDryFriction(torque, slip_speed=0.1)], q).residual
        expected = torch.full((len(a.topology.scalar_v),), 2.0 * share, dtype=torch.float64)
        torch.testing.assert_close(residual[a.topology.scalar_v], expected, rtol=1e-9, atol=1e-9)


def test_damping_of_a_free_spin() -> None:
    """Damping of a ball or free joint: torque −c ω for the average angular velocity ω = log(R_nᵀR)/Δt about the body's axes."""
    articulation, _ = one_body(Point(), None)
    s = dataclasses.replace(situation(0), articulation=articulation)
    before = pose((0.0, 0.0, 0.0), (0.2, -0.1, 0.5))
    step = torch.tensor([0.1, 0.0, -0.2, 0.3, -0.4, 0.2], dtype=torch.float64)
    after = retract(articulation, before, step)
    moving = dataclasses.replace(s, state=state_of(before, before), q=after, control=None)
    damping = torch.tensor([2.0, 2.0, 2.0, 0.5, 0.5, 0.5], dtype=torch.float64)
    residual = moving.balance([JointDamping(damping)], after).residual
    torch.testing.assert_close(residual, damping * step / float(s.dt), rtol=1e-12, atol=1e-12)


def test_joint_coefficients_are_checked() -> None:
    """One number per degree of freedom, finite, ≥ 0, equal about the axes of one rotation; the message says which value failed."""
    a = situation(0).articulation
    good = torch.ones(a.nv, dtype=torch.float64)
    assert torch.equal(checked_coefficient(a, good, "damping"), good)
    uneven = good.clone()
    uneven[a.topology.turning_v[0, 1]] = 2.0
    for bad, words in ((good[:-1], "shape"), (-good, "≥ 0"), (good * math.nan, "finite"), (uneven, "rotation axes")):
        with pytest.raises(InputError, match=words):
            checked_coefficient(a, bad, "damping")
