"""Boxes and wedges that hold each other up: stacks, a heavy box on a light one, and an arch."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Collider, ConvexHull, Shape
from pbfd_torch.models.setup import Metric, Setup, repeated
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link

GRAVITY = 9.81
HALF = (0.1, 0.1, 0.05)  # half extents of a box of the stack [m]
STIFFNESS = 1e8  # C⊥ [N/m²]
FRICTION = 0.5
STONES = 11  # of the arch
INNER, OUTER, DEPTH = 0.8, 1.0, 0.3  # radii of the arch and its depth [m]
ARCH_FRICTION = 0.7


def solid_box(name: str, half: tuple[float, float, float], mass: float) -> Link:
    """A free homogeneous box with its centre at its link's origin."""
    x, y, z = (h * h for h in half)
    rows = ((mass * (y + z) / 3, 0.0, 0.0), (0.0, mass * (x + z) / 3, 0.0), (0.0, 0.0, mass * (x + y) / 3))
    return Link(name, joints=(Joint(f"{name}_free", JointKind.FREE),), mass=mass, inertia=rows)


def _moved(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
    moved = rollout.link_poses[..., 3] - rollout.link_poses[:1, ..., 3]
    distance = torch.linalg.vector_norm(moved, dim=-1)
    return {"top_move_m": distance[:, :, -1].amax(0).tolist(), "largest_move_m": distance.amax((0, -1)).tolist()}


def _resting(
    title: str, links: Sequence[Link], shapes: Sequence[Shape], q: Sequence[float], worlds: int, mu: float, rules: ContactRules,
    dtype: torch.dtype, device: torch.device | str,
) -> Setup:  # fmt: skip
    """Free bodies with one shape each on level ground, at rest in `q`."""
    articulation = Articulation.from_links(links, dtype, device)
    colliders = [Collider(link.name, link.name, shape, friction=mu) for link, shape in zip(links, shapes, strict=True)]
    ground = HalfSpace(friction=mu)
    terms = contact_terms(articulation, colliders, (ground,), dataclasses.replace(rules, slots=16 * len(links)))
    gravity = torch.tensor([0.0, 0.0, -GRAVITY], dtype=dtype, device=device)
    scene = Scene(articulation, (Inertia(), *terms), gravity, colliders, (ground,), title)
    start = repeated(torch.tensor(q, dtype=dtype, device=device), worlds)
    return Setup(scene, start, start.new_zeros(worlds, articulation.nv), 10.0, 0.02, _moved)


def _stack(count: int, worlds: int, dtype: torch.dtype, device: torch.device | str) -> Setup:
    q: list[float] = []
    height = 0.0
    for k in range(count):  # each contact of four points carries all boxes above it
        height += HALF[2] - math.sqrt(GRAVITY * (count - k) / 4 / STIFFNESS)
        q += [0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]
        height += HALF[2]
    links = [solid_box(f"box{k}", HALF, 1.0) for k in range(count)]
    title = "stack" if count == 5 else f"stack-{count}"
    return _resting(title, links, [Box(HALF)] * count, q, worlds, FRICTION, ContactRules(NormalForce(STIFFNESS)), dtype, device)


def stack(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Five boxes of 1 kg on top of each other, μ = .5, at rest."""
    return _stack(5, worlds, dtype, device)


def stack_10(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Ten boxes of 1 kg on top of each other, μ = .5, at rest."""
    return _stack(10, worlds, dtype, device)


def heavy_on_light(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """A cube of 1000 kg and 1 m on a cube of 1 kg and 0.1 m, both as dense as water: at rest."""
    light, heavy = (0.05, 0.05, 0.05), (0.5, 0.5, 0.5)
    stiffness = 1e10
    low, up = (math.sqrt(GRAVITY * m / 4 / stiffness) for m in (1001, 1000))
    q = [0.0, 0.0, 0.05 - low, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.6 - low - up, 1.0, 0.0, 0.0, 0.0]
    links = [solid_box("light", light, 1.0), solid_box("heavy", heavy, 1000.0)]
    rules = ContactRules(NormalForce(stiffness))
    return _resting("heavy-on-light", links, [Box(light), Box(heavy)], q, worlds, FRICTION, rules, dtype, device)


def _wedge(angle: float) -> tuple[ConvexHull, float, tuple[float, float, float]]:
    """A stone of the arch about its centre of mass, which lies on the arch's radius along +z at the height returned; and its
    moments of inertia per kilogram, by its own vertices: a frustum with isosceles trapezoids as sides."""
    import trimesh

    corners = [
        (radius * math.sin(side * angle / 2), y, radius * math.cos(side * angle / 2))
        for radius in (INNER, OUTER)
        for side in (-1, 1)
        for y in (-DEPTH / 2, DEPTH / 2)
    ]
    solid = trimesh.Trimesh(corners).convex_hull
    height = float(solid.center_mass[2])
    x, y, z = (float(m) / float(solid.volume) for m in np.diag(solid.moment_inertia))
    return ConvexHull(np.array(corners) - np.array([0.0, 0.0, height])), height, (x, y, z)


def arch(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """A half circle of eleven loose stones, 10 kg each, that stands by itself, μ = .7 with anchors: each rests on its neighbours
    only, and would creep by half a millimetre a second without."""
    angle = math.pi / STONES
    shape, height, (x, y, z) = _wedge(angle)
    rows = ((10 * x, 0.0, 0.0), (0.0, 10 * y, 0.0), (0.0, 0.0, 10 * z))
    names = [f"stone{k}" for k in range(STONES)]
    links = [Link(n, joints=(Joint(f"{n}_free", JointKind.FREE),), mass=10.0, inertia=rows) for n in names]
    q: list[float] = []
    for k in range(STONES):
        turn = (k + 0.5) * angle - math.pi / 2  # from the left foot over the top to the right one
        q += [height * math.sin(turn), 0.0, height * math.cos(turn), math.cos(turn / 2), 0.0, math.sin(turn / 2), 0.0]
    rules = ContactRules(NormalForce(1e9), AnchoredFriction(1.0))
    return _resting("arch", links, [shape] * STONES, q, worlds, ARCH_FRICTION, rules, dtype, device)
