"""What a robot file says about collisions, and which links overlap before anything moves."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Collider, ConvexHull, Shape, Solid
from pbfd_torch.loading.bounds import SLOW_PAIRS, pair_count
from pbfd_torch.loading.report import announced
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import place

OVERLAP = 1e-3  # [m] from which on shapes overlap: no deeper than a contact gives way under the robot's weight (`robot_scene`)


@dataclass(frozen=True)
class Collisions:
    """Colliders of links that move, solids of the world, pairs of names that do not touch, and lines on what is left out."""

    colliders: tuple[Collider, ...] = ()
    obstacles: tuple[HalfSpace | Obstacle, ...] = ()
    excluded: tuple[tuple[str, str], ...] = ()
    left_out: tuple[str, ...] = ()


def as_solid(shape: Shape) -> Solid:
    """The shape as one that an obstacle can have: an ellipsoid becomes the hull of its samples."""
    return shape if isinstance(shape, Solid) else ConvexHull(shape.candidates()[0])


def overlapping(
    articulation: Articulation, colliders: Sequence[Collider], excluded: Collection[tuple[str, str]] = ()
) -> tuple[tuple[str, str], ...]:
    """Pairs of links that could touch each other and whose colliders overlap by more than 1 mm in the rest configuration."""
    exact = articulation.to(torch.float64, "cpu")
    bodies = place(exact, exact.rest[None]).poses
    closer = bodies.new_full((1, exact.nlink), -0.5 * OVERLAP)
    found: set[tuple[int, int]] = set()
    with announced("overlaps", pair_count(colliders, ()), SLOW_PAIRS):
        terms = contact_terms(exact, colliders, (), ContactRules(friction=None, excluded=excluded))
    for term in terms:
        if isinstance(term, BodyContact):
            finder = term.finder
            slots = finder.find(bodies, bodies, closer)
            while bool(slots.dropped):
                finder = finder.grown()
                slots = finder.find(bodies, bodies, closer)
            pairs = torch.stack((slots.first, slots.second), -1)[slots.filled].sort(-1).values
            found |= {(a, b) for a, b in pairs.tolist()}
    return tuple((exact.link_names[a], exact.link_names[b]) for a, b in sorted(found))
