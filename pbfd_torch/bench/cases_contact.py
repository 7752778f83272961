"""Hard cases of bodies that rest on the ground, fall onto it, or are thrown at it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch

from pbfd_torch.bench.hard_cases_case import ALL, BEST, FIRST_ORDER, ONE_STEP, TIME_STEPS, Case, Check, Run, most, rise
from pbfd_torch.bench.hard_cases_scenes import GRAVITY, body, coulomb, down, on_plane, placed, row, sunk
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Point, Shape, Sphere
from pbfd_torch.models.chains import chain_ground as chain_ground_setup
from pbfd_torch.models.chains import chain_slope, chain_slope_drop
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link

HALF = (0.1, 0.1, 0.05)  # half extents [m]
DROP = 0.5  # [m]
ROD = 0.5  # half length of the rod [m]
TILTS = ((0.0, 0.0, 0.0), (0.3, 0.2, 0.0), (0.7, 0.5, 0.1))
LYING = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
# shape, height of its centre over what it touches [m], how many points carry it, its turn
RESTING: tuple[tuple[Shape, float, int, tuple[float, float, float, float]], ...] = (
    (Box(HALF), 0.05, 4, UPRIGHT),
    (Sphere(0.06), 0.06, 1, UPRIGHT),
    (Capsule(0.05, 0.1), 0.05, 2, LYING),
)


def rest_depth(run: Run) -> Sequence[Check]:
    """A box, a ball and a capsule dropped by 1 mm come to rest √(N/C⊥) deep under each of their points: to 1e-6 after 2 s
    (BDF2, which may still swing: reported)."""
    errors = []
    for shape, height, points, turn in RESTING:
        scene = on_plane(body(HALF), shape, coulomb(0.5), stiffness=1e6, turn=turn)
        depth = run.roll(scene, 2.0, placed(height + 1e-3)).contact_depth[-1]
        deepest = depth.topk(points).values
        errors.append(most(deepest / sunk(GRAVITY, points, 1e6) - 1))
    return Check("depth error", max(errors), 1e-6, run.among(ONE_STEP)), run.solved()


def rest_without_drift(run: Run) -> Sequence[Check]:
    """A box, a ball and a capsule at rest stay for 60 s: nothing moves or turns by 1e-9."""
    moved = []
    for shape, height, points, turn in RESTING:
        scene = on_plane(body(HALF), shape, coulomb(0.5), turn=turn)
        q = run.roll(scene, run.seconds(60.0, 2.0), placed(height - float(sunk(GRAVITY, points)))).q
        moved.append(most(q - q[:1]))
    return Check("motion [m, 1]", max(moved), 1e-9), run.solved()


def inelastic_drop(run: Run) -> Sequence[Check]:
    """Boxes, flat and tilted, from .5 m: the centre never rises again by more than 1 % of that, the energy is never above its
    start, and they end flat."""
    scene = on_plane(body(HALF), Box(HALF), coulomb(0.5))
    q = torch.stack([placed(DROP + height, tilt) for height, tilt in zip((0.05, 0.1, 0.15), TILTS, strict=True)])
    rollout = run.roll(scene, 1.4, q)
    height = rollout.center_of_mass[..., 2]
    fallen = GRAVITY * DROP
    start = scene.energy(q, q.new_zeros(len(q), 6))
    flat = torch.full_like(height[-1], HALF[2]) - sunk(GRAVITY)
    return (
        Check("rebound / drop", float((height - height.cummin(0).values).max()) / DROP, 0.01),
        Check("energy rise / m g h", rise(rollout) / fallen, 1e-9, run.among(FIRST_ORDER)),
        Check("energy above E0 / m g h", run.gained(rollout, start) / fallen, 1e-9),
        Check("height error at the end [m]", most(height[-1] - flat), 1e-4),
        run.solved(),
    )


def fast_impact(run: Run) -> Sequence[Check]:
    """Chains thrown at the ground at 20 m/s, one straight and three turning: solved, in shorter steps if need be; the energy is
    never above its start; penetration < 1 cm."""
    setup = chain_ground_setup(4)
    random = torch.Generator().manual_seed(3)
    v = 0.5 * torch.randn(4, setup.scene.articulation.nv, dtype=torch.float64, generator=random)
    v[0], v[:, 2] = 0.0, -20.0
    thrown = dataclasses.replace(setup, v=v)
    rollout = run.roll_setup(thrown, run.seconds(0.4, 0.1))
    start = setup.scene.energy(setup.q, v)
    return (
        Check("energy above E0 / E0", run.gained(rollout, start) / float(start.min()), 1e-6),
        Check("penetration [mm]", 1e3 * most(rollout.penetration), 10.0),
        run.solved(),
    )


def painleve_rod(run: Run) -> Sequence[Check]:
    """A slender rod at 45, 55 and 65°, μ 1.5, pushed along and down: forces are finite, every step is solved, and the energy is
    never above its start at Δt ≤ .05 (implicit Euler: at any; BDF2: reported)."""
    rows = ((ROD**2 / 300, 0.0, 0.0), (0.0, ROD**2 / 3, 0.0), (0.0, 0.0, ROD**2 / 3))
    articulation = Articulation.from_links([Link("body", joints=(Joint("free", JointKind.FREE),), mass=1.0, inertia=rows)])
    colliders = [Collider(f"end{x}", "body", Point(), (x, 0.0, 0.0), margin=0.005) for x in (-ROD, ROD)]
    contact = Contact.between(articulation, colliders, HalfSpace(), NormalForce(1e7), coulomb(1.5))
    angles = [math.radians(a) for a in (45, 55, 65)]
    q = torch.stack([placed(ROD * math.sin(a) + 0.0049, (0.0, a, 0.0)) for a in angles])
    v = row(3, 0, -1, 0, 0, 0).expand(3, 6)
    scene = Scene(articulation, (Inertia(), contact), down())
    rollout = run.roll(scene, run.seconds(0.5, 0.25), q, v)
    start = scene.energy(q, v)
    return (
        Check("not finite", float((~torch.isfinite(rollout.contact_force)).sum()), 0.0),
        Check(
            "energy above E0 / E0",
            run.gained(rollout, start) / float(start.min()),
            1e-6,
            run.among(FIRST_ORDER) or run.among(ONE_STEP, 0.05),
        ),
        run.solved(),
    )


def far_away(run: Run) -> Sequence[Check]:
    """A chain on a slope that starts 1 km from the origin in float32 is, after 1 s, where it is in float64, to 1e-4 of where that
    is (BDF2: reported); how far it has gone is off by more, up to a tenth of the weight being left to rounding, and reported."""
    starts, ends = [], []
    for dtype in (torch.float64, torch.float32):
        setup = chain_slope(dtype=dtype)
        q = setup.q.clone()
        q[:, 0] += 1000.0
        center = run.roll(setup.scene, 1.0, q, setup.v).center_of_mass.double()
        starts.append(center[0])
        ends.append(center[-1])
    error = torch.linalg.vector_norm(ends[1] - ends[0])
    return (
        Check("position error", float(error / torch.linalg.vector_norm(ends[0])), 1e-4, run.among(ONE_STEP)),
        Check("displacement error", float(error / torch.linalg.vector_norm(ends[0] - starts[0])), 1e-4, must=False),
        run.solved(),
    )


def chain_ground(run: Run) -> Sequence[Check]:
    """A chain pitched by 30° dropped from .5 m, μ .5, 2 s: penetration < 5 mm, energy never .1 % above its start."""
    setup = chain_ground_setup()
    rollout = run.roll_setup(setup, run.seconds(2.0, 0.4))
    start = setup.scene.energy(setup.q, setup.v)
    return (
        Check("penetration [mm]", 1e3 * most(rollout.penetration), 5.0),
        Check("energy above E0 / E0", run.gained(rollout, start) / float(start), 1e-3),
        run.solved(),
    )


def chain_on_slope(run: Run) -> Sequence[Check]:
    """A chain pitched by 20° dropped from .1 m onto 30°, μ .3: no more friction than Coulomb's law allows, x ≥ x0 + ½ g (sin − μ
    cos) T² − μ (z − z0) to 5 mm, penetration < 1 mm, energy never .1 % above its start."""
    setup = chain_slope_drop()
    rollout = run.roll_setup(setup, run.seconds(5.0, 1.0))
    margin = float(torch.as_tensor(setup.metrics(rollout)["coulomb_margin_m"]).min())
    start = setup.scene.energy(setup.q, setup.v)
    above = run.gained(rollout, start) / float(start.abs())
    calm = run.among(ALL, 0.05)
    return (
        Check("friction too much [mm]", 1e3 * max(0.0, -margin), 5.0, run.among((*FIRST_ORDER, *BEST), 0.05)),
        Check("|margin| [mm]", 1e3 * abs(margin), 5.0, must=False),
        Check("penetration [mm]", 1e3 * most(rollout.penetration), 1.0, calm),
        Check("energy above E0 / E0", above, 1e-3, calm),
        run.solved(),
    )


CASES = (
    Case(rest_depth, TIME_STEPS[2:], (1 / 10,)),
    Case(rest_without_drift, (1 / 10,), (1 / 10,)),
    Case(inelastic_drop, TIME_STEPS, (1 / 20,)),
    Case(fast_impact, (1 / 50, 1 / 20, 1 / 10), (1 / 50,)),
    Case(painleve_rod, TIME_STEPS[1:], (1 / 50,)),
    Case(far_away, TIME_STEPS[2:], (1 / 20,)),
    Case(chain_ground, TIME_STEPS[2:], (1 / 10,)),
    Case(chain_on_slope, TIME_STEPS[3:], (1 / 20,)),
)
