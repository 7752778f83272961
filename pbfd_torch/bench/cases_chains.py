"""Hard cases of articulated bodies without contact: chains, mass ratios, a quadruped in free flight, limits."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from pbfd_torch.bench.hard_cases_case import (
    BEST,
    CONSERVING,
    EXACT,
    FIRST_ORDER,
    TIME_STEPS,
    Case,
    Check,
    Run,
    drift,
    most,
    rise,
)
from pbfd_torch.bench.hard_cases_scenes import GRAVITY, row, weightless
from pbfd_torch.models.chains import chain_fixed, chain_free
from pbfd_torch.models.chains import chain_heavy as chain_heavy_setup
from pbfd_torch.models.setup import Setup
from pbfd_torch.models.stacks import solid_box
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.objective import Status
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link

LEG = 0.2  # length of a thigh and of a shank [m]
TORQUE = 0.5  # standard deviation of the joint torques [N m]
LIMIT = 2000.0  # [N m/rad²]
LIMITED_MOMENT = 0.11  # of the limited arm about its hinge [kg m²]


def quadruped() -> Articulation:
    """A trunk of 6 kg with four legs of three hinges, all free."""
    links = [solid_box("trunk", (0.2, 0.1, 0.05), 6.0)]
    for name, x, y in (("fl", 0.2, 0.1), ("fr", 0.2, -0.1), ("hl", -0.2, 0.1), ("hr", -0.2, -0.1)):
        parts = (
            ("hip", "trunk", (x, y, 0.0), (1.0, 0.0, 0.0), 0.0, 0.5),
            ("thigh", f"{name}_hip", (0.0, math.copysign(0.05, y), 0.0), (0.0, 1.0, 0.0), -0.5 * LEG, 1.0),
            ("shank", f"{name}_thigh", (0.0, 0.0, -LEG), (0.0, 1.0, 0.0), -0.5 * LEG, 0.2),
        )
        for part, parent, position, axis, com, mass in parts:
            shape = solid_box("", (0.03, 0.03, 0.5 * LEG if com else 0.03), mass)
            joint = Joint(f"{name}_{part}", JointKind.HINGE, axis)
            links.append(
                Link(f"{name}_{part}", parent, position, joints=(joint,), mass=mass, com=(0, 0, com), inertia=shape.inertia)
            )
    return Articulation.from_links(links)


def quadruped_momentum(run: Run) -> Sequence[Check]:
    """A free quadruped without weight under random joint torques, held for .1 s each, 5 s: Σ m v and the angular momentum about the
    centre of mass stay, to 1e-8 of m v and of I ω; the angular one with energy–momentum, and with the variational scheme where no
    step was eased."""
    articulation = quadruped()
    motors = Actuators.from_list(articulation, [Actuator.motor(name, name) for name in articulation.joint_names[1:]])
    scene = Scene(articulation, (Inertia(), motors), weightless())
    random = torch.Generator().manual_seed(0)
    torques = TORQUE * torch.randn(51, motors.nu, dtype=torch.float64, generator=random)
    v = torch.cat((row(1, 0.5, -0.3, 1, 2, 0.5), torch.zeros(articulation.nv - 6, dtype=torch.float64)))

    def controls(steps: int) -> Tensor:
        return torques[(torch.arange(steps) * run.dt / 0.1 + 1e-9).long()]

    rollout = run.roll(scene, run.seconds(5.0, 0.5), v=v, controls=controls)
    eased = bool((rollout.status == int(Status.EASED)).any())
    return (
        Check("Δp/p", drift(rollout.linear_momentum), 1e-8, run.among(EXACT)),
        Check("ΔL/L", drift(rollout.angular_momentum), 1e-8, run.among(BEST) or (run.among(CONSERVING) and not eased)),
        run.solved(),
    )


def mass_ratio(run: Run) -> Sequence[Check]:
    """Nine links of .1 kg with 100 kg at the end, hanging still and swinging, 10 s: finite, solved, and the energy never rises
    above its start by more than 1e-6 of the weight × length (implicit Euler: in no step)."""
    setup = chain_heavy_setup(2)
    q = setup.q.clone()
    q[:, 0] = 0.5 * math.pi
    q[1, 0] -= 0.3
    rollout = run.roll(setup.scene, run.seconds(10.0, 0.5), q)
    size = 100.0 * GRAVITY
    start = setup.scene.energy(q, setup.v)
    return (
        Check("energy rise / m g l", rise(rollout) / size, 1e-9, run.among(FIRST_ORDER)),
        Check("energy above E0 / m g l", run.gained(rollout, start) / size, 1e-6, run.among((*FIRST_ORDER, *BEST))),
        Check("not finite", float((~torch.isfinite(rollout.q)).sum()), 0.0),
        Check("sway of the still one [rad]", most(rollout.q[:, 0] - q[0]), 1e-8),
        run.solved(),
    )


def whip(run: Run) -> Sequence[Check]:
    """Ten links hinged to the world, released from the horizontal, 1 s: every step solved; tip error against Runge–Kutta 4 at
    Δt 1e-4 reported beside MuJoCo's RK4 at Δt .01, 1.25 mm."""
    setup = chain_fixed()
    rollout = run.roll_setup(setup, 1.0)
    return Check("tip error [mm]", _tip_error(setup, rollout), 1.25, must=False), run.solved()


def chain_heavy(run: Run) -> Sequence[Check]:
    """The same with 100 kg as its last link: energy–momentum's tip error ≤ 10 mm at Δt .02 and ≤ 1 mm at Δt .01; every step
    solved."""
    setup = chain_heavy_setup()
    rollout = run.roll_setup(setup, run.seconds(1.0, 0.5))
    limit = 1.0 if run.dt < 0.015 else 10.0
    return Check("tip error [mm]", _tip_error(setup, rollout), limit, run.among(BEST, 0.02)), run.solved()


def _tip_error(setup: Setup, rollout: Rollout) -> float:
    """In mm; NaN where the rollout does not end at 1 s, for which the reference is."""
    return 1e3 * most(torch.as_tensor(setup.metrics(rollout).get("tip_error_m", math.nan)))


def chain_flight(run: Run) -> Sequence[Check]:
    """A straight chain turns at 10 rad/s and flies at 5 m/s, 2 s: Δp/p < 1e-10 at Δt .01 and .1, elsewhere < 4e-10, which is
    what 1e-9 of the weight on every step may come to (explicit steps keep it to their order); at Δt ≤ .01 ΔL/L < 1e-8 and
    |ΔE|/E < 1e-3 with energy–momentum; E never above E0 by more than .1 % at any Δt."""
    setup = chain_free()
    rollout = run.roll_setup(setup, run.seconds(2.0, 0.5))
    start = float(setup.scene.energy(setup.q, setup.v))
    return (
        Check("Δp/p", drift(rollout.linear_momentum), 1e-10 if run.dt in (1 / 100, 1 / 10) else 4e-10, run.among(EXACT)),
        Check("ΔL/L", drift(rollout.angular_momentum), 1e-8, run.among(BEST, 0.01)),
        Check("|ΔE|/E", most(rollout.kinetic_energy[1:] / start - 1), 1e-3, run.among(BEST, 0.01)),
        Check("energy above E0 / E0", run.gained(rollout, start) / start, 1e-3, run.among((*FIRST_ORDER, *BEST))),
        run.solved(),
    )


def limited_arm() -> Scene:
    """An arm on a hinge with a range of −1 … .5 rad, without weight."""
    rows = ((0.02, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.02))
    joint = Joint("hinge", JointKind.HINGE, (0.0, 1.0, 0.0), lower=-1.0, upper=0.5)
    link = Link("arm", joints=(joint,), mass=1.0, com=(0.0, 0.0, -0.3), inertia=rows)
    return Scene(Articulation.from_links([link]), (Inertia(), JointLimits(row(LIMIT))), weightless())


def joint_limit(run: Run) -> Sequence[Check]:
    """An arm thrown at its limit at 4 rad/s: its violation x obeys k x³/3 ≤ ½ I ω², it does not come back faster than it came, and
    the energy is never above its start."""
    speed = 4.0
    rollout = run.roll(limited_arm(), 1.0, row(0.0), row(speed))
    kinetic = 0.5 * LIMITED_MOMENT * speed**2
    bound = (3 * kinetic / LIMIT) ** (1 / 3)
    return (
        Check("violation / bound", float(rollout.q[:, 0].max() - 0.5) / bound, 1.0),
        Check("speed back / speed", most(rollout.v[1:, 0].clamp_max(0)) / speed, 1.0),
        Check("energy above E0 / E0", run.gained(rollout, kinetic) / kinetic, 1e-6),
        run.solved(),
    )


def outside_limit(run: Run) -> Sequence[Check]:
    """An arm that starts 1.5 rad below or .7 rad above its range: no NaN, the violation is never larger than at the start, and
    after 3 s at most a twentieth of it."""
    q = row(-2.5, 1.2)[:, None]
    scene = limited_arm()
    rollout = run.roll(scene, 3.0, q)
    start = scene.energy(q, torch.zeros_like(q))
    x = rollout.q[..., 0]
    violation = torch.maximum(x - 0.5, -1.0 - x).clamp_min(0)
    return (
        Check("violation / start", most(violation / violation[0]), 1 + 1e-9),
        Check("violation at the end / start", most(violation[-1] / violation[0]), 0.05),
        Check("energy above E0 / E0", run.gained(rollout, start) / float(start.max()), 1e-6),
        run.solved(),
    )


CASES = (
    Case(quadruped_momentum, (1 / 100, 1 / 50), (1 / 100,)),
    Case(mass_ratio, TIME_STEPS[4:], (1 / 10,)),
    Case(whip, TIME_STEPS[1:], (1 / 100,)),
    Case(chain_heavy, TIME_STEPS[2:], (1 / 10,)),
    Case(chain_flight, TIME_STEPS[2:], (1 / 100,)),
    Case(joint_limit, TIME_STEPS[1:], (1 / 50, 1 / 10)),
    Case(outside_limit, TIME_STEPS[2:], (1 / 10,)),
)
