"""Hard cases of dry friction: stopping, holding and sliding on slopes, creeping, going straight, rolling."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from pbfd_torch.bench.hard_cases_case import ALL, CONSERVING, MEAN_VELOCITY, ONE_STEP, TIME_STEPS, Case, Check, Run, most
from pbfd_torch.bench.hard_cases_scenes import (
    GRAVITY,
    SLIP_SPEED,
    ball,
    box_on_slope,
    coulomb,
    degrees,
    on_plane,
    placed,
    row,
    slide,
    sunk,
)
from pbfd_torch.contact.shapes import Sphere
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.tree.kinematics import difference

MU = (0.1, 0.3, 0.5, 0.7, 1.0)
SLOPES = (3.0, 10.0, 20.0, 30.0, 40.0)  # [°]
ROLLING_RADIUS, ROLLING_STIFFNESS = 0.05, 1e6


def _thrown(*velocity: float) -> Tensor:
    return row(*velocity, *[0.0] * (6 - len(velocity)))


def stopping_distance(run: Run) -> Sequence[Check]:
    """A box thrown at v0 = 1 and 2 m/s slides v0²/(2 μ g), μ = .1 … .8: to .5 % at Δt ≤ .02 and to 1 % at Δt .05, where stopping
    takes at least four steps; then it rests, below 1e-3 m/s."""
    mu, speed = row(0.1, 0.2, 0.3, 0.5, 0.8).repeat(2), row(1.0, 2.0).repeat_interleave(5)
    scene, q = box_on_slope(coulomb(mu), torch.zeros_like(mu))
    rollout = run.roll(scene, 2.2, q, speed[:, None] * _thrown(1.0))
    error = (rollout.q[-1, :, 0] - rollout.q[0, :, 0]) / (speed**2 / (2 * mu * GRAVITY)) - 1
    slow = speed / (mu * GRAVITY) >= 4 * run.dt
    limit = 0.005 if run.dt <= 0.02 else 0.01
    return (
        Check("distance error, ≥ 4 steps", most(error[slow]), limit, run.among(ALL, 0.05)),
        Check("speed at the end [m/s]", most(rollout.v[-1]), 1e-3, run.among(ONE_STEP) or run.among(ALL, 0.05)),
        run.solved(),
    )


def ramp_grid(run: Run) -> Sequence[Check]:
    """Boxes on slopes of 3 … 40° with μ = .1 … 1, and 2° below and above atan μ: those below hold, v < 2 ε_v; those above gain
    g (sin − μ cos), to 1 %."""
    mu = row(*MU)
    edges = torch.atan(mu) + torch.deg2rad(row(-2.0, 2.0))[:, None]
    slope = torch.cat((degrees(*SLOPES).repeat_interleave(len(mu)), edges.flatten()))
    friction = mu.repeat(len(SLOPES) + 2)
    scene, q = box_on_slope(coulomb(friction), slope)
    rollout = run.roll(scene, 1.0, q)
    speed, half = rollout.v[:, :, 0], rollout.steps // 2
    crept = rollout.q[..., 0].diff(dim=0) / run.dt
    exact = slide(slope, friction)
    gained = (speed[-1] - speed[half]) / (rollout.time[-1] - rollout.time[half])
    return (
        Check("speed of those that hold [m/s]", most(crept[:, exact < 0]), 2 * SLIP_SPEED),
        Check("acceleration error of those that slide", most((gained / exact - 1)[exact > 0]), 0.01),
        run.solved(),
    )


def critical_slope(run: Run) -> Sequence[Check]:
    """tan = .5, 25 s: with μ = .49 a box slides ½ g (sin − μ cos) T², to 1 %; with μ = .5, the cone itself, no faster than ε_v
    (BDF2, which keeps the speed it starts with: reported)."""
    mu = row(0.49, 0.5)
    slope = torch.atan(row(0.5, 0.5))
    scene, q = box_on_slope(coulomb(mu), slope)
    rollout = run.roll(scene, run.seconds(25.0, 3.0), q)
    moved = rollout.q[-1, :, 0] - rollout.q[0, :, 0]
    duration = float(rollout.time[-1])
    exact = 0.5 * float(slide(slope, mu)[0]) * duration**2
    return (
        Check("slide error, μ .49", abs(float(moved[0]) / exact - 1), 0.01),
        Check("speed, μ .5 [m/s]", abs(float(moved[1])) / duration, SLIP_SPEED, run.among(ONE_STEP)),
        run.solved(),
    )


def creep(run: Run) -> Sequence[Check]:
    """Held at half the cone for 60 s a box creeps at ε_v (1 − √(1 − W/(μN))) and no faster, to 1 % (for small loads ε_v W/(2μN));
    with anchors it stands, to 1e-9 m/s."""
    mu, share = 0.5, row(0.05, 0.5)
    slope = torch.atan(share * mu)
    duration = run.seconds(60.0, 5.0)
    scene, q = box_on_slope(coulomb(mu), slope)
    crept = run.roll(scene, duration, q).q[..., 0]
    scene, q = box_on_slope(AnchoredFriction(mu), slope)
    stood = run.roll(scene, duration, q).q[..., 0]
    half, time = len(crept) // 2, 0.5 * duration
    exact = SLIP_SPEED * (1 - torch.sqrt(1 - share)) * duration
    return (
        Check("creep off its law", most((crept[-1] - crept[0]) / exact - 1), 0.01),
        Check("speed with anchors [m/s]", most(stood[-1] - stood[half]) / time, 1e-9),
        run.solved(),
    )


def straight_path(run: Run) -> Sequence[Check]:
    """Thrown with v = (4, .8, 0), μ .25: y/x = .2 to 1e-6 (a pyramid for the cone bends it), and the distance is v²/(2 μ g), to
    .5 %."""
    scene, q = box_on_slope(coulomb(0.25), row(0.0))
    rollout = run.roll(scene, 2.0, q, _thrown(4.0, 0.8))
    x, y = (rollout.q[-1, 0, :2] - rollout.q[0, 0, :2]).tolist()
    exact = (16 + 0.64) / (2 * 0.25 * GRAVITY)
    return (
        Check("y/x off .2", abs(y / x - 0.2), 1e-6),
        Check("distance error", abs(math.hypot(x, y) / exact - 1), 0.005, run.among(ALL, 0.05)),
        run.solved(),
    )


def rolling_sphere(run: Run) -> Sequence[Check]:
    """A ball rolls down 15°: v² = 2 g h/(1 + 2/5), to 1 % after .6 s at Δt ≤ .01 where the angular momentum is conserved (BDF2 and
    implicit Euler slow its spin down); it slips by what friction's creep needs, ≤ ε_v."""
    radius, slope = ROLLING_RADIUS, math.radians(15)
    scene = on_plane(ball(radius), Sphere(radius), coulomb(1.0), slope, ROLLING_STIFFNESS)
    q = placed(radius - float(sunk(GRAVITY * math.cos(slope), 1, ROLLING_STIFFNESS)))
    rollout = run.roll(scene, 0.6, q)
    # v² = 2 a x at the time that the speed is of: the mean over a step belongs to its middle
    x = rollout.q[:, 0] - rollout.q[0, 0]
    middle = 0.5 * (x[-1] + x[-2]) - 0.125 * (x[-1] - 2 * x[-2] + x[-3])
    at = middle if run.among(MEAN_VELOCITY) else x[-1]
    error = float(rollout.v[-1, 0] ** 2 / (2 * GRAVITY * math.sin(slope) / 1.4 * at)) - 1
    moved = difference(scene.articulation, rollout.q[:-1], rollout.q[1:]) / run.dt
    slip = moved[:, 0] - radius * moved[:, 4]
    return (
        Check("v² error", abs(error), 0.01, run.among(CONSERVING, 0.01)),
        Check("slip [m/s]", most(slip), SLIP_SPEED, run.among(ALL, 0.01)),
        run.solved(),
    )


CASES = (
    Case(stopping_distance, TIME_STEPS[2:], (1 / 20,)),
    Case(ramp_grid, TIME_STEPS[2:], (1 / 20,)),
    Case(critical_slope, TIME_STEPS[3:], (1 / 20,)),
    Case(creep, (1 / 10,), (1 / 10,)),
    Case(straight_path, TIME_STEPS[2:], (1 / 20,)),
    Case(rolling_sphere, TIME_STEPS[1:], (1 / 100,)),
)
