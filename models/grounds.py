"""Bodies on grounds that move, slope or undulate: turntable, conveyor, a grid of ramps, and a terrain."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.mesh_distance import Mesh
from pbfd_torch.contact.motion import Conveyor, Turntable
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Collider, Cylinder, Sphere
from pbfd_torch.models.setup import Metric, Setup, repeated
from pbfd_torch.models.stacks import GRAVITY, solid_box
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation

HALF = (0.1, 0.1, 0.05)  # half extents of every box [m]
STIFFNESS = 1e8
RATE, RADII = 1.0, (0.3, 0.6)  # turntable [rad/s]; where its boxes stand [m]: ω² r = .3 and .6 m/s²
TABLE_FRICTION = 0.045  # μ g = .44 m/s² holds the first and not the second
BELT, BELT_FRICTION = 1.0, 0.3  # [m/s]
RAMPS = (3.0, 10.0, 20.0, 30.0, 40.0)  # slopes of the grid [°]
RAMP_FRICTION = (0.1, 0.3, 0.5, 0.7, 1.0)


def _scene(
    title: str, articulation: Articulation, colliders: list[Collider], obstacles: list[HalfSpace | Obstacle], gravity: Tensor
) -> Scene:
    terms = contact_terms(articulation, colliders, obstacles, ContactRules(NormalForce(STIFFNESS), slots=16 * len(colliders)))
    return Scene(articulation, (Inertia(), *terms), gravity, colliders, obstacles, title)


def _down(dtype: torch.dtype, device: torch.device | str) -> Tensor:
    return torch.tensor([0.0, 0.0, -GRAVITY], dtype=dtype, device=device)


def turntable(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Two boxes on a disc that turns at 1 rad/s, .3 and .6 m from its axis, μ g = .44 m/s²: the inner one goes round with it, the
    outer one slides off."""
    articulation = Articulation.from_links([solid_box(name, HALF, 1.0) for name in ("inner", "outer")], dtype, device)
    colliders = [Collider(name, name, Box(HALF), friction=TABLE_FRICTION) for name in ("inner", "outer")]
    disc = Obstacle("disc", Cylinder(3.0, 0.1), (0.0, 0.0, -0.1), motion=Turntable(RATE), friction=TABLE_FRICTION)
    scene = _scene("turntable", articulation, colliders, [disc], _down(dtype, device))
    q = repeated(articulation.rest, worlds)
    v = q.new_zeros(worlds, articulation.nv)
    for k, radius in enumerate((RADII[0], -RADII[1])):
        q[:, 7 * k], q[:, 7 * k + 2] = radius, HALF[2] - math.sqrt(GRAVITY / 4 / STIFFNESS)
        v[:, 6 * k + 1], v[:, 6 * k + 5] = RATE * radius, RATE

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        radius = torch.linalg.vector_norm(rollout.link_poses[..., :2, 3], dim=-1)
        return {
            "inner_drift_m": (radius[-1, :, 0] - RADII[0]).abs().tolist(),
            "outer_distance_m": radius[-1, :, 1].tolist(),
        }

    return Setup(scene, q, v, 3.0, 0.02, report)


def conveyor(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """A box put on a belt that runs at 1 m/s, μ = .3: it slips back v²/(2 μ g) on the belt, and then goes with it."""
    articulation = Articulation.from_links([solid_box("box", HALF, 1.0)], dtype, device)
    colliders = [Collider("box", "box", Box(HALF), friction=BELT_FRICTION)]
    belt = Obstacle("belt", Box((10.0, 0.5, 0.1)), (0.0, 0.0, -0.1), motion=Conveyor((BELT, 0.0, 0.0)), friction=BELT_FRICTION)
    scene = _scene("conveyor", articulation, colliders, [belt], _down(dtype, device))
    q = repeated(articulation.rest, worlds)
    q[:, 2] = HALF[2] - math.sqrt(GRAVITY / 4 / STIFFNESS)

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        slipped = BELT * float(rollout.time[-1]) - (rollout.q[-1, :, 0] - rollout.q[0, :, 0])
        exact = BELT**2 / (2 * BELT_FRICTION * GRAVITY)
        return {
            "slip_back_m": slipped.tolist(),
            "slip_back_error": (slipped / exact - 1).tolist(),
            "final_speed_m_s": rollout.v[-1, :, 0].tolist(),
        }

    return Setup(scene, q, q.new_zeros(worlds, 6), 2.0, 0.02, report)


def ramp_grid(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Boxes on 25 ramps: slopes of 3, 10, 20, 30 and 40° by μ = .1, .3, .5, .7 and 1; each holds where μ > tan of its slope."""
    cells = [(slope, mu) for slope in RAMPS for mu in RAMP_FRICTION]
    names = [f"box_{slope:g}deg_mu{mu:g}" for slope, mu in cells]
    articulation = Articulation.from_links([solid_box(name, HALF, 1.0) for name in names], dtype, device)
    q = articulation.rest.clone()
    colliders, obstacles = [], []
    for k, ((slope, mu), name) in enumerate(zip(cells, names, strict=True)):
        angle = math.radians(slope)
        turn = (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0)  # about +y: the ramp falls towards +x
        x, y = 40.0 * (k // 5), 3.0 * (k % 5)
        colliders.append(Collider(name, name, Box(HALF), friction=mu))
        obstacles.append(Obstacle(f"ramp_{name[4:]}", Box((15.0, 1.0, 0.1)), (x, y, 0.0), turn, friction=mu))
        height = 0.1 + HALF[2] - math.sqrt(GRAVITY * math.cos(angle) / 4 / STIFFNESS)
        at = q.new_tensor([x + height * math.sin(angle), y, height * math.cos(angle), *turn])
        q[7 * k : 7 * k + 7] = at
    scene = _scene("ramp-grid", articulation, colliders, list(obstacles), _down(dtype, device))
    start = repeated(q, worlds)

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        moved = torch.linalg.vector_norm(rollout.link_poses[-1, 0, :, :, 3] - rollout.link_poses[0, 0, :, :, 3], dim=-1)
        time = float(rollout.time[-1])
        free = [max(0.0, math.sin(math.radians(s)) - mu * math.cos(math.radians(s))) for s, mu in cells]
        exact = [0.5 * GRAVITY * a * time**2 for a in free]
        holds = [m for m, e in zip(moved.tolist(), exact, strict=True) if e == 0]
        slides = [m / e - 1 for m, e in zip(moved.tolist(), exact, strict=True) if e > 0]
        return {"largest_creep_m": max(holds), "slide_errors": slides}

    return Setup(scene, start, start.new_zeros(worlds, articulation.nv), 1.0, 0.02, report)


def _terrain() -> Mesh:
    """A closed slab of 4 × 4 m with a floor 0.5 m deep and hills of 0.15 m on top."""
    count = 41
    along = np.linspace(-2.0, 2.0, count)
    x, y = np.meshgrid(along, along, indexing="ij")
    z = 0.15 * np.sin(2.0 * x) * np.cos(1.5 * y)
    top = np.stack((x, y, z), -1).reshape(-1, 3)
    floor = np.stack((x, y, np.full_like(x, -0.5)), -1).reshape(-1, 3)
    index = np.arange(count * count).reshape(count, count)
    a, b, c, d = (part.reshape(-1) for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    upper = np.concatenate((np.stack((a, b, c), -1), np.stack((a, c, d), -1)))
    ring = np.concatenate((index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]))  # round the border, counterclockwise
    here, there = ring, np.roll(ring, -1)
    below = len(top)
    sides = np.concatenate((np.stack((here, here + below, there), -1), np.stack((there, here + below, there + below), -1)))
    return Mesh(np.concatenate((top, floor)), np.concatenate((upper, upper[:, ::-1] + below, sides)), cell=0.05)


def mesh_terrain(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Eight balls and four boxes dropped onto a hilly mesh, μ = .6; its signed distance is computed once and kept on disk."""
    balls, boxes = [f"ball{k}" for k in range(8)], [f"box{k}" for k in range(4)]
    small = (0.08, 0.06, 0.05)
    links = [solid_box(name, (0.05, 0.05, 0.05), 0.5) for name in balls] + [solid_box(name, small, 1.0) for name in boxes]
    articulation = Articulation.from_links(links, dtype, device)
    colliders = [Collider(name, name, Sphere(0.06), friction=0.6) for name in balls]
    colliders += [Collider(name, name, Box(small), friction=0.6) for name in boxes]
    terrain = Obstacle("terrain", _terrain(), friction=0.6)
    scene = _scene("mesh-terrain", articulation, colliders, [terrain], _down(dtype, device))
    q = repeated(articulation.rest, worlds)
    for k in range(len(links)):
        q[:, 7 * k], q[:, 7 * k + 1], q[:, 7 * k + 2] = 0.45 * (k % 4) - 0.7, 0.5 * (k // 4) - 0.5, 0.45 + 0.02 * k

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        height = rollout.link_poses[-1, :, :, 2, 3]
        return {"lowest_body_m": height.amin(-1).tolist(), "final_kinetic_energy_J": rollout.kinetic_energy[-1].tolist()}

    return Setup(scene, q, q.new_zeros(worlds, articulation.nv), 3.0, 0.01, report)
