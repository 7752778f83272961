"""Chains of ten links: hung up, dropped, sliding down a slope, with a heavy end, and floating.

A link is 0.1 m long along +x, 0.1 kg, a rod of radius 0.02 m; hinges turn about +y. It touches through its axis: points spaced
along it carry a skin of the rod's radius, so a link slips and does not roll on its surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import momentum
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Capsule, Collider, Point
from pbfd_torch.looks.appearance import Visual
from pbfd_torch.looks.painting import link_color, visual_of
from pbfd_torch.models.setup import Metric, Setup, repeated, tilted
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import Motion, place

GRAVITY = 9.81
LENGTH, RADIUS, MASS = 0.1, 0.02, 0.1
SLOPE, SLOPE_FRICTION = math.radians(30), 0.3
SLIDE = GRAVITY * (math.sin(SLOPE) - SLOPE_FRICTION * math.cos(SLOPE))  # acceleration of a sliding body [m/s²]
# where the tips of the hung-up chains are after 1 s: Runge–Kutta 4 at steps of 0.1 ms, converged to 1e-8 m
FIXED_TIP = (-0.900072791, 0.0, -0.151867841)
HEAVY_TIP = (-0.991605735, 0.0, -0.125760876)
STIFFNESS = 5e7  # C⊥ [N/m²] on the slope: a drop of 0.1 m stays within half a millimetre
GROUND_STIFFNESS = 5e6  # C⊥ [N/m²] of the chain that falls on level ground: it rests 0.3 mm deep, and lands within 5 mm at any Δt


def chain_links(count: int = 10, free: bool = True, last_mass: float = MASS) -> list[Link]:
    """The chain's links; the first is free, or hinged to the world at the origin."""
    links = []
    for k in range(count):
        mass = last_mass if k == count - 1 else MASS
        across = mass * (3 * RADIUS**2 + LENGTH**2) / 12
        joint = Joint("root", JointKind.FREE) if free and k == 0 else Joint(f"hinge{k}", JointKind.HINGE, axis=(0.0, 1.0, 0.0))
        links.append(
            Link(
                name=f"link{k}",
                parent=f"link{k - 1}" if k else "",
                position=(LENGTH if k else 0.0, 0.0, 0.0),
                joints=(joint,),
                mass=mass,
                com=(LENGTH / 2, 0.0, 0.0),
                inertia=((mass * RADIUS**2 / 2, 0.0, 0.0), (0.0, across, 0.0), (0.0, 0.0, across)),
            )
        )
    return links


def chain_colliders(count: int = 10, points: int = 2) -> list[Collider]:
    """`points` per link, evenly from its near end to its far end."""
    places = [LENGTH * k / (points - 1) for k in range(points)]
    return [
        Collider(f"link{k}_{i}", f"link{k}", Point(), (x, 0.0, 0.0), margin=RADIUS)
        for k in range(count)
        for i, x in enumerate(places)
    ]


def chain_visuals(count: int = 10) -> list[Visual]:
    """Every link as the capsule that its points stand for."""
    rod, middle = Capsule(RADIUS, LENGTH / 2), (LENGTH / 2, 0.0, 0.0)
    along_x = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
    return [visual_of(f"link{k}", k, rod, middle, along_x, link_color(k)) for k in range(count)]


def _scene(
    title: str, dtype: torch.dtype, device: torch.device | str, *, free: bool, mu: float | None, slope: float = 0.0,
    gravity: float = GRAVITY, last_mass: float = MASS, stiffness: float = STIFFNESS, points: int = 2,
) -> Scene:  # fmt: skip
    articulation = Articulation.from_links(chain_links(free=free, last_mass=last_mass), dtype, device)
    terms: list[Term] = [Inertia()]
    colliders: list[Collider] = []
    obstacles: tuple[HalfSpace, ...] = ()
    if mu is not None:
        colliders, obstacles = chain_colliders(points=points), (HalfSpace(),)
        terms.append(Contact.between(articulation, colliders, obstacles[0], NormalForce(stiffness), CoulombFriction(mu)))
    down = torch.tensor([gravity * math.sin(slope), 0.0, -gravity * math.cos(slope)], dtype=dtype, device=device)
    return Scene(articulation, tuple(terms), down, colliders, obstacles, title, chain_visuals)


def _placed(scene: Scene, worlds: int, pitch: float, clearance: float) -> Tensor:
    """Straight, pitched by `pitch` (far end down), its lowest skin `clearance` [m] above the ground."""
    q = repeated(scene.articulation.rest, worlds)
    q[:, 2] = clearance + RADIUS + 10 * LENGTH * max(0.0, math.sin(pitch))
    q[:, 3:7] = tilted(pitch, q.dtype, q.device)
    return q


def _tip(rollout: Rollout) -> Tensor:
    last = rollout.link_poses[:, :, -1]
    return last[..., 3] + LENGTH * last[..., 0]


def _tip_report(exact: tuple[float, float, float]) -> Callable[[Setup, Rollout], Mapping[str, Metric]]:
    """Where the tip is at the end, and how far from `exact`, which is known at 1 s."""

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        tip = _tip(rollout)[-1]
        numbers: dict[str, Metric] = {"tip_m": tip[0].tolist()}
        if abs(float(rollout.time[-1]) - 1.0) < 1e-9:
            numbers["tip_error_m"] = torch.linalg.vector_norm(tip - tip.new_tensor(exact), dim=-1).tolist()
        return numbers

    return report


def _no_velocity(scene: Scene, q: Tensor) -> Tensor:
    return q.new_zeros(len(q), scene.articulation.nv)


def chain_fixed(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Hinged to the world at the origin, released from the horizontal; no contact."""
    scene = _scene("chain-fixed", dtype, device, free=False, mu=None)
    q = repeated(scene.articulation.rest, worlds)
    return Setup(scene, q, _no_velocity(scene, q), 1.0, 0.01, _tip_report(FIXED_TIP))


def chain_heavy(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """The fixed chain with 100 kg as its last link: mass ratio 1000."""
    scene = _scene("chain-heavy", dtype, device, free=False, mu=None, last_mass=100.0)
    q = repeated(scene.articulation.rest, worlds)
    return Setup(scene, q, _no_velocity(scene, q), 1.0, 0.02, _tip_report(HEAVY_TIP))


def chain_free(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Weightless and straight, turning at 10 rad/s about +y through its centre, which moves at 5 m/s along +x."""
    scene = _scene("chain-free", dtype, device, free=True, mu=None, gravity=0.0)
    q = repeated(scene.articulation.rest, worlds)
    v = _no_velocity(scene, q)
    v[:, 0], v[:, 2], v[:, 4] = 5.0, 10.0 * 5 * LENGTH, 10.0

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        linear, angular = rollout.linear_momentum, rollout.angular_momentum
        return {
            "linear_momentum_drift": float((linear - linear[:1]).abs().max() / linear[0].abs().max()),
            "angular_momentum_drift": float((angular - angular[:1]).abs().max() / angular[0].abs().max()),
            "energy_drift": float(rollout.kinetic_energy[-1, 0] / rollout.kinetic_energy[0, 0] - 1),
        }

    return Setup(scene, q, v, 2.0, 0.01, report)


def chain_ground(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Pitched by 30° and dropped from 0.5 m onto level ground, μ = .5."""
    scene = _scene("chain-ground", dtype, device, free=True, mu=0.5, stiffness=GROUND_STIFFNESS)
    q = _placed(scene, worlds, math.radians(30), 0.5)
    return Setup(scene, q, _no_velocity(scene, q), 2.0, 0.02)


def _margin(setup: Setup, rollout: Rollout) -> Tensor:
    """How far each world's centre of mass went beyond what Coulomb's law allows at least: 0 while everything slides straight down,
    < 0: too much friction. For any motion with ẋ, ż at the start, x − x0 − ẋT ≥ ½ g (sin − μ cos) T² − μ (z − z0 − żT)."""
    duration = rollout.time[-1]
    placement = place(setup.scene.articulation, setup.q)
    rates = Motion(placement, setup.v).rates
    velocity = momentum(placement, rates)[0] / setup.scene.articulation.mass.sum()
    beyond = rollout.center_of_mass[-1] - rollout.center_of_mass[0] - duration * velocity
    return beyond[:, 0] - 0.5 * SLIDE * duration**2 + SLOPE_FRICTION * beyond[:, 2]


def chain_slope(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu", points: int = 2) -> Setup:
    """Laid straight on a slope of 30° (gravity is turned instead), μ = .3: slides ½ g (sin 30° − μ cos 30°) T², 117.814 m in
    10 s."""
    scene = _scene("chain-slope", dtype, device, free=True, mu=SLOPE_FRICTION, slope=SLOPE, points=points)
    q = _placed(scene, worlds, 0.0, -math.sqrt(MASS * GRAVITY * math.cos(SLOPE) / points / STIFFNESS))

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        moved = (rollout.center_of_mass[-1] - rollout.center_of_mass[0])[:, 0]
        exact = 0.5 * SLIDE * float(rollout.time[-1]) ** 2
        return {
            "slide_distance_m": moved.tolist(),
            "slide_distance_error": (moved / exact - 1).tolist(),
            "coulomb_margin_m": _margin(setup, rollout).tolist(),
        }

    return Setup(scene, q, _no_velocity(scene, q), 10.0, 0.05, report)


def chain_slope_drop(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Pitched by 20°, uphill end first, dropped from 0.1 m onto the slope of 30°, μ = .3."""
    # Downhill end first it folds up as it lands; at Δt = 0.05 its tail then hops for a step, and it arrives 0.2–0.4 m further than
    # sliding all the way would take it.
    scene = _scene("chain-slope-drop", dtype, device, free=True, mu=SLOPE_FRICTION, slope=SLOPE)
    q = _placed(scene, worlds, -math.radians(20), 0.1)
    return Setup(
        scene, q, _no_velocity(scene, q), 10.0, 0.05, lambda setup, rollout: {"coulomb_margin_m": _margin(setup, rollout).tolist()}
    )
