"""Hard cases of single bodies without contact: falling, tumbling, swinging."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from scipy.special import ellipj, ellipk

from pbfd_torch.balance.dynamics import center_of_mass
from pbfd_torch.bench.hard_cases_case import (
    ALL,
    BEST,
    CONSERVING,
    FIRST_ORDER,
    HIGH_ORDER,
    SECOND_ORDER,
    TIME_STEPS,
    Case,
    Check,
    Run,
    drift,
    most,
    rise,
)
from pbfd_torch.bench.hard_cases_scenes import GRAVITY, body, down, placed, row, weightless
from pbfd_torch.models.spinning import dzhanibekov as dzhanibekov_setup
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import place

TUMBLING = (0.1, 0.2, 0.3)  # half extents [m]
ARM, MASS, MOMENT = 0.4, 1.5, 0.02  # pendulum: arm [m], mass [kg], moment about the centre of mass [kg m²]


def free_fall(run: Run) -> Sequence[Check]:
    """p = p0 + v t + ½ g t² for 1 s, dropped and thrown spinning: ≤ ½ g Δt t for the first order, ≤ 1e-9 m for the second."""
    v = torch.stack((row(0, 0, 0, 0, 0, 0), row(1, -2, 3, 0.5, -0.3, 0.8)))
    rollout = run.roll(Scene(body(TUMBLING), (Inertia(),), down()), 1.0, placed(0.4), v)
    t = rollout.time[:, None, None]
    exact = placed(0.4)[:3] + t * v[:, :3] + 0.5 * t * t * down()
    limit = 0.5 * GRAVITY * run.dt * float(rollout.time[-1]) if run.integrator in FIRST_ORDER else 1e-9
    return Check("position error [m]", most(rollout.center_of_mass - exact), limit), run.solved()


def rotation_oracle(run: Run) -> Sequence[Check]:
    """One implicit-Euler step of a free body without potential ends at R = polar((2R_n − R_{n−1}) J), J = ∫ρ x xᵀ about the
    centre of mass, which goes straight on: to 1e-12."""
    rows = ((0.05, 0.004, -0.002), (0.004, 0.06, 0.003), (-0.002, 0.003, 0.04))
    link = Link("body", joints=(Joint("free", JointKind.FREE),), mass=1.7, com=(0.2, -0.1, 0.3), inertia=rows)
    articulation = Articulation.from_links([link])
    scene = Scene(articulation, (Inertia(),), weightless())
    simulator = run.simulator(scene, solver=Fallbacks.within(1e-13))
    state = simulator.initial_state(placed(0.5, (0.3, 0.2, -0.7)), row(1, -1, 0.5, 0.3 / run.dt, -0.2 / run.dt, 0.5 / run.dt))
    after, solution = simulator.step(state)
    before, now, then = (place(articulation, q) for q in (state.q_previous, state.q, after.q))
    inertia = torch.tensor(rows, dtype=torch.float64)
    second = 0.5 * torch.trace(inertia) * torch.eye(3, dtype=torch.float64) - inertia
    u, _, vh = torch.linalg.svd((2 * now.poses[0, :3, :3] - before.poses[0, :3, :3]) @ second)
    polar = u @ torch.diag(row(1, 1, float(torch.sign(torch.linalg.det(u @ vh))))) @ vh
    straight = 2 * center_of_mass(now) - center_of_mass(before)
    return (
        Check("rotation error", most(then.poses[0, :3, :3] - polar), 1e-12),
        Check("centre error [m]", most(center_of_mass(then) - straight), 1e-12),
        Check("unsolved steps", float(not bool(solution.solved)), 0.0),
    )


def tumbling_box(run: Run) -> Sequence[Check]:
    """ω = (1, 2, 3) rad/s, 5 s: E never rises; at Δt ≤ .01, for the second order, E_end > .7 E0 and ΔL/L < .05 (implicit Euler
    loses 55 %); ΔL/L < 1e-8 where the angular momentum is conserved."""
    scene, q, v = Scene(body(TUMBLING), (Inertia(),), weightless()), placed(0.0), row(0, 0, 0, 1, 2, 3)
    rollout = run.roll(scene, run.seconds(5.0, 1.0), q, v)
    start = float(scene.energy(q, v))
    turned = drift(rollout.angular_momentum)
    return (
        Check("energy rise / E0", rise(rollout) / start, 1e-9, run.among(ALL, 0.01)),
        Check("energy above E0 / E0", run.gained(rollout, start) / start, 1e-9, run.among((*FIRST_ORDER, *BEST))),
        Check("energy lost / E0", 1 - float(rollout.kinetic_energy[-1]) / start, 0.3, run.among(SECOND_ORDER, 0.01)),
        Check("ΔL/L", turned, 0.05, run.among(SECOND_ORDER, 0.01)),
        Check("ΔL/L of a conserving scheme", turned, 1e-8, run.among(CONSERVING)),
        run.solved(),
    )


def middle_axis(run: Run) -> Sequence[Check]:
    """ω = (.05, 5, .05) rad/s about the unstable axis, 100 s: E < 1.01 E0 at every step."""
    scene, q, v = Scene(body(TUMBLING), (Inertia(),), weightless()), placed(0.0), row(0, 0, 0, 0.05, 5, 0.05)
    rollout = run.roll(scene, run.seconds(100.0, 2.0), q, v)
    start = float(scene.energy(q, v))
    return Check(
        "energy above E0 / E0", run.gained(rollout, start) / start, 0.01, run.among((*FIRST_ORDER, *BEST)) or run.dt <= 0.02
    ), run.solved()


def dzhanibekov(run: Run) -> Sequence[Check]:
    """A T turns at 20 rad/s about its middle axis, 10 s: it flips at least once within 5 s at Δt ≤ 1/250 where the order is second
    (implicit Euler: reported), its centre of mass drifts less than 1e-3 m; energy and angular momentum drift < .5 % at Δt ≤ .01
    with energy–momentum (MuJoCo's RK4 at Δt .1: .13 %, .43 %)."""
    setup = dzhanibekov_setup()
    rollout = run.roll_setup(setup, run.seconds(10.0, 1.5))
    start = float(setup.scene.energy(setup.q, setup.v))
    return (
        Check("first flip [s]", _first_flip(rollout), 5.0, run.among(SECOND_ORDER, 1 / 250)),
        Check("centre drift [m]", most(rollout.center_of_mass - rollout.center_of_mass[:1]), 1e-3),
        Check("ΔL/L", drift(rollout.angular_momentum), 5e-3, run.among(BEST, 0.01)),
        Check("|ΔE|/E", most(rollout.kinetic_energy[1:] / start - 1), 5e-3, run.among(BEST, 0.01)),
        run.solved(),
    )


def _first_flip(rollout: Rollout) -> float:
    """When the body's middle axis first turns away from the angular momentum [s]; NaN: never."""
    along = (rollout.link_poses[:, 0, 0, :, 1] * rollout.angular_momentum[0, 0]).sum(-1)
    flipped = torch.nonzero(along < 0)
    return float(rollout.time[int(flipped[0])]) if len(flipped) else math.nan


def pendulum() -> Scene:
    """An arm on a hinge about y, its centre of mass below."""
    rows = ((MOMENT, 0.0, 0.0), (0.0, MOMENT, 0.0), (0.0, 0.0, MOMENT))
    joint = Joint("hinge", JointKind.HINGE, (0.0, 1.0, 0.0))
    link = Link("arm", joints=(joint,), mass=MASS, com=(0.0, 0.0, -ARM), inertia=rows)
    return Scene(Articulation.from_links([link]), (Inertia(),), down())


def pendulum_energy(run: Run) -> Sequence[Check]:
    """Released at 1 rad, 2 s: energy drifts by less than .5 % of m g l (1 − cos 1) at Δt .001 where the order is second (implicit
    Euler: reported)."""
    scene = pendulum()
    rollout = run.roll(scene, run.seconds(2.0, 0.2), row(1.0))
    start = float(scene.energy(row(1.0), row(0.0)))
    swing = MASS * GRAVITY * ARM * (1 - math.cos(1.0))
    drifted = most(run.energy(rollout) - start) / swing
    return Check("|ΔE|/swing", drifted, 5e-3, run.among(SECOND_ORDER, 1e-3)), run.solved()


def pendulum_order(run: Run) -> Sequence[Check]:
    """Small swing, Δt halved three times: the error of the angle after 1 s falls by 2 ± .4 (first order) or 4 ± .8 (second), by 24
    at least with explicit steps (fifth); exact: sin(θ/2) = k sn(K − ω t)."""
    start = 0.5
    k = math.sin(0.5 * start)
    rate = math.sqrt(MASS * GRAVITY * ARM / (MOMENT + MASS * ARM**2))
    errors = []
    for parts in (1, 2, 4, 8):
        rollout = run.roll(pendulum(), 1.0, row(start), parts=parts)
        sine = ellipj(ellipk(k * k) - rate * float(rollout.time[-1]), k * k)[0]
        errors.append(float(rollout.q[-1, 0]) - 2 * math.asin(k * float(sine)))
    ratios = [a / b for a, b in itertools.pairwise(errors)]
    expected, room = (2.0, 0.4) if run.integrator in FIRST_ORDER else (4.0, 0.8)
    order = Check(f"error ratio off {expected:g}", max(abs(ratio - expected) for ratio in ratios), room)
    if run.integrator in HIGH_ORDER:
        order = Check("24 / error ratio", max(24 / abs(ratio) for ratio in ratios), 1.0)
    return (
        order,
        Check("error at the largest Δt [rad]", abs(errors[0]), 0.1),
        run.solved(),
    )


CASES = (
    Case(free_fall, TIME_STEPS[1:], (1 / 50, 1 / 10)),
    Case(rotation_oracle, TIME_STEPS, TIME_STEPS, FIRST_ORDER),
    Case(pendulum_energy, (TIME_STEPS[0], *TIME_STEPS[2:]), (1 / 1000,)),
    Case(pendulum_order, (1 / 50, 1 / 20), (1 / 20,)),
    Case(tumbling_box, TIME_STEPS[2:], (1 / 100,)),
    Case(middle_axis, (1 / 50, 1 / 10), (1 / 50,)),
    Case(dzhanibekov, TIME_STEPS[1:], (1 / 100,)),
)
