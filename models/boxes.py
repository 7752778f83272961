"""Boxes on the ground: sliding to rest, and held and slipping on a slope."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping

import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Collider, Sphere
from pbfd_torch.looks.appearance import Visual
from pbfd_torch.looks.painting import link_color, visual_of
from pbfd_torch.models.setup import Metric, Setup, repeated
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link

GRAVITY = 9.81
HALF = (0.1, 0.1, 0.05)  # half extents of the box [m]
RADIUS = 0.01  # of the sphere at each corner [m]
STIFFNESS = 1e8  # C⊥ [N/m²]
SLIDING_FRICTION = (0.1, 0.2, 0.3, 0.5, 0.8)


def _box_link(name: str) -> Link:
    """1 kg, 0.2 × 0.2 × 0.1 m, free to move."""
    x, y, z = (2 * h for h in HALF)
    rows = (((y * y + z * z) / 12, 0.0, 0.0), (0.0, (x * x + z * z) / 12, 0.0), (0.0, 0.0, (x * x + y * y) / 12))
    return Link(name, joints=(Joint(f"{name}_free", JointKind.FREE),), mass=1.0, inertia=rows)


def box_visuals(count: int = 1) -> list[Visual]:
    """Every box with the skin that its corners' spheres give it."""
    skinned = Box((HALF[0] + RADIUS, HALF[1] + RADIUS, HALF[2] + RADIUS))
    return [visual_of(f"box{k}", k, skinned, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), link_color(k)) for k in range(count)]


def _corners(name: str) -> list[Collider]:
    places = [(x, y, z) for x in (-HALF[0], HALF[0]) for y in (-HALF[1], HALF[1]) for z in (-HALF[2], HALF[2])]
    return [Collider(f"{name}_{k}", name, Sphere(RADIUS), place) for k, place in enumerate(places)]


def _scene(names: list[str], mu: Tensor, slope: float, title: str, dtype: torch.dtype, device: torch.device) -> Scene:
    articulation = Articulation.from_links([_box_link(name) for name in names], dtype, device)
    colliders = [corner for name in names for corner in _corners(name)]
    ground = HalfSpace()
    contact = Contact.between(
        articulation, colliders, ground, NormalForce(STIFFNESS), CoulombFriction(mu.to(device, dtype)[:, None])
    )
    gravity = torch.tensor([GRAVITY * math.sin(slope), 0.0, -GRAVITY * math.cos(slope)], dtype=dtype, device=device)
    return Scene(
        articulation, (Inertia(), contact), gravity, colliders, (ground,), title, functools.partial(box_visuals, len(names))
    )


def _resting_height(slope: float) -> float:
    """Height of the centre at which four corners carry the box."""
    return HALF[2] + RADIUS - math.sqrt(GRAVITY * math.cos(slope) / 4 / STIFFNESS)


def box_slide(worlds: int = 5, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """A box slides to rest from 1 m/s; the worlds take μ = .1, .2, .3, .5, .8 in turn. Exact distance: v0²/(2 μ g)."""
    mu = torch.tensor([SLIDING_FRICTION[k % len(SLIDING_FRICTION)] for k in range(worlds)], dtype=torch.float64)
    scene = _scene(["box"], mu, 0.0, "box-slide", dtype, torch.device(device))
    q = repeated(scene.articulation.rest, worlds)
    q[:, 2] = _resting_height(0.0)
    v = q.new_zeros(worlds, 6)
    v[:, 0] = 1.0
    exact = (1.0 / (2 * mu * GRAVITY)).tolist()

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        distance = (rollout.q[-1, :, 0] - rollout.q[0, :, 0]).tolist()
        speed = torch.linalg.vector_norm(rollout.v[-1, :, :3], dim=-1).tolist()
        return {
            "mu": mu.tolist(),
            "stop_distance_m": distance,
            "stop_distance_exact_m": exact,
            "stop_distance_error": [d / e - 1 for d, e in zip(distance, exact, strict=True)],
            "final_speed_m_s": speed,
        }

    return Setup(scene, q, v, 1.5, 0.02, report)


def box_slope(worlds: int = 2, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """A box at rest on a slope of 20°: even worlds with μ = 1.02 tan 20° hold, odd ones with μ = .98 tan 20° slide."""
    slope = math.radians(20)
    mu = torch.tensor([(1.02, 0.98)[k % 2] * math.tan(slope) for k in range(worlds)], dtype=torch.float64)
    scene = _scene(["box"], mu, slope, "box-slope", dtype, torch.device(device))
    q = repeated(scene.articulation.rest, worlds)
    q[:, 2] = _resting_height(slope)

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        moved = (rollout.q[-1, :, 0] - rollout.q[0, :, 0]).tolist()
        duration = float(rollout.time[-1])
        acceleration = [max(0.0, GRAVITY * (math.sin(slope) - m * math.cos(slope))) for m in mu.tolist()]
        exact = [0.5 * a * duration**2 for a in acceleration]
        return {
            "mu": mu.tolist(),
            "creep_m": [d for d, a in zip(moved, acceleration, strict=True) if a == 0],
            "slide_distance_m": moved,
            "slide_distance_exact_m": exact,
            "slide_distance_error_m": [d - e for d, e in zip(moved, exact, strict=True)],
        }

    return Setup(scene, q, q.new_zeros(worlds, 6), 5.0, 0.02, report)
