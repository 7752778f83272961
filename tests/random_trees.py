"""Random articulations that hold every joint kind, and random configurations of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import retract

HINGE, SLIDE, BALL, FREE = JointKind.HINGE, JointKind.SLIDE, JointKind.BALL, JointKind.FREE

# The joints of every link; each tree shuffles them and hangs them on one another. An empty tuple is a link fixed to its parent.
PATTERNS: tuple[tuple[JointKind, ...], ...] = (
    (FREE,),
    (HINGE, SLIDE),
    (BALL,),
    (),
    (HINGE,),
    (SLIDE,),
    (BALL, HINGE),
    (HINGE,),
    (),
)
SEEDS = (0, 1, 2)


def generator(seed: int) -> torch.Generator:
    """A seeded source of random numbers."""
    return torch.Generator().manual_seed(seed)


def _vector(random: torch.Generator, size: float = 1.0) -> tuple[float, float, float]:
    x, y, z = (size * torch.randn(3, dtype=torch.float64, generator=random)).tolist()
    return x, y, z


def _quaternion(random: torch.Generator) -> tuple[float, float, float, float]:
    w, x, y, z = torch.randn(4, dtype=torch.float64, generator=random).tolist()
    return w, x, y, z


def random_inertia(random: torch.Generator, mass: float, size: float = 0.1) -> tuple[tuple[float, float, float], ...]:
    """Inertia about the COM [kg m²] of some body with radii of gyration about `size` [m], along random axes."""
    points = size * torch.randn(6, 3, dtype=torch.float64, generator=random)
    points = points - points.mean(0)
    second = mass * points.T @ points / len(points)
    inertia = torch.trace(second) * torch.eye(3, dtype=torch.float64) - second
    return tuple((x, y, z) for x, y, z in (0.5 * (inertia + inertia.T)).tolist())


def random_links(seed: int) -> list[Link]:
    """Nine links with all joint kinds in random order and on random parents: non-trivial axes, anchors, refs, frames and inertias.
    One hinge always hangs on the world; the second fixed link has no mass."""
    random = generator(seed)
    order = torch.randperm(len(PATTERNS), generator=random).tolist()
    links: list[Link] = []
    for k, pattern in enumerate(order):
        kinds = PATTERNS[pattern]
        on_world = k == 0 or kinds == (FREE,) or pattern == 7
        parent = "" if on_world else links[int(torch.randint(k, (1,), generator=random))].name
        joints = tuple(
            Joint(
                f"joint{k}_{i}",
                kind,
                axis=_vector(random),
                anchor=(0.0, 0.0, 0.0) if kind is FREE else _vector(random, 0.1),
                ref=float(torch.randn((), dtype=torch.float64, generator=random)) * 0.5 if kind in (HINGE, SLIDE) else 0.0,
            )
            for i, kind in enumerate(kinds)
        )
        mass = 0.0 if pattern == 8 else math.exp(float(torch.randn((), dtype=torch.float64, generator=random)) * 0.5)
        links.append(
            Link(
                f"link{k}",
                parent,
                position=_vector(random, 0.3),
                quaternion=_quaternion(random),
                joints=joints,
                mass=mass,
                com=_vector(random, 0.1) if mass else (0.0, 0.0, 0.0),
                inertia=random_inertia(random, mass),
            )
        )
    return links


def random_tree(seed: int) -> Articulation:
    """`random_links` as an articulation."""
    return Articulation.from_links(random_links(seed))


def random_q(articulation: Articulation, seed: int, batch: tuple[int, ...] = ()) -> Tensor:
    """Configurations `[*batch, nq]` all over: any rotation, slides and positions of some decimetres."""
    random = generator(1000 + seed)
    t = articulation.topology
    q = articulation.rest.expand(*batch, -1).clone()
    q[..., t.turning_q] = torch.randn(*batch, *t.turning_q.shape, dtype=torch.float64, generator=random)
    q = t.normalized(q)
    delta = torch.randn(*batch, articulation.nv, dtype=torch.float64, generator=random)
    delta = torch.where(t.turns, 1.5 * delta, 0.3 * delta)
    delta[..., t.turning_v] = 0.0
    return retract(articulation, q, delta)


def moved_q(articulation: Articulation, q: Tensor, seed: int, size: float) -> Tensor:
    """q moved by a random tangent vector with entries of about `size` [rad or m]."""
    random = generator(2000 + seed)
    delta = size * torch.randn(*q.shape[:-1], articulation.nv, dtype=torch.float64, generator=random)
    return retract(articulation, q, delta)
