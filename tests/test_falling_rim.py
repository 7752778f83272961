"""A coin let go on its rim falls over as a pendulum about the point it stands on: exactly, until it is flat."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from scipy.integrate import solve_ivp

from pbfd_torch import Simulator
from pbfd_torch.models import file_setup
from pbfd_torch.tree.rotations import quaternion_matrix

RADIUS, HALF = 0.02, 0.002  # [m]
LEAN, WHILE = math.radians(20.0), 0.1  # [rad], [s]


def fallen(file: Path, dt: float) -> float:
    """How far from upright the coin leans at the end [rad]."""
    setup = file_setup(str(file))
    q = setup.q.clone()
    half = 0.25 * math.pi - 0.5 * LEAN
    q[..., 3:] = torch.tensor((math.cos(half), math.sin(half), 0.0, 0.0))
    simulator = Simulator(setup.scene, dt)
    rollout = simulator.rollout(simulator.initial_state(q, setup.v), steps=round(WHILE / dt))
    assert bool(rollout.solved.all())
    return math.asin(abs(float(quaternion_matrix(rollout.q[-1, 0, 3:])[2, 2])))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    height = RADIUS * math.cos(LEAN) + HALF * math.sin(LEAN)
    path = tmp_path / "coin.xml"
    path.write_text(
        f"""<mujoco><worldbody><geom type="plane" size="1 1 .1" friction="1 0 0"/><body pos="0 0 {height}"><freejoint/>
        <geom type="cylinder" size="{RADIUS} {HALF}" density="8000" friction="1 0 0"/></body></worldbody></mujoco>"""
    )
    return path


def test_a_rim_falls_over_as_a_pendulum(file: Path) -> None:
    """With the first order of a contact's force, and to .1° in the limit."""
    arm = math.hypot(RADIUS, HALF)
    inertia = RADIUS**2 / 4 + (2 * HALF) ** 2 / 12 + arm**2  # per mass
    off = math.atan(HALF / RADIUS)
    law = solve_ivp(lambda _, y: [y[1], 9.81 * arm * math.sin(y[0] - off) / inertia], (0, WHILE), (LEAN, 0.0), rtol=1e-9)
    right = float(law.y[0, -1])

    coarse, fine = (fallen(file, dt) for dt in (0.002, 0.001))
    assert abs(fine - right) < math.radians(0.6)
    assert abs(2 * fine - coarse - right) < math.radians(0.1)
