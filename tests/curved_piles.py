"""Piles of curved bodies, and the reference with the core's contact points of the polytopes that stand for them."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.manifold import Manifold
from pbfd_torch.contact.polytope_pairs import PolytopePairs
from pbfd_torch.contact.shapes import Box, Capsule, Cylinder, Ellipsoid, Shape, Sphere
from tests.meetings import Pairs, meet

WHEEL, ROD, EGG, DISC = Cylinder(0.1, 0.06), Cylinder(0.06, 0.12), Ellipsoid((0.1, 0.14, 0.08)), Ellipsoid((0.12, 0.12, 0.06))
BRICK, PILL = Box((0.12, 0.1, 0.08)), Capsule(0.08, 0.12)
CURVED: dict[str, tuple[Shape, ...]] = {
    "cylinders on boxes": (WHEEL, BRICK, ROD),
    "cylinders": (WHEEL, ROD, Cylinder(0.08, 0.08)),
    "ellipsoids": (EGG, DISC, Sphere(0.1), PILL),
    "ellipsoids on boxes": (EGG, BRICK, DISC),
    "all": (WHEEL, EGG, PILL, BRICK, Sphere(0.1)),
}
_FAR = 1e6  # [m]


def of_core(finder: PolytopePairs, poses: Tensor, world: Tensor, row: Tensor, moves: Tensor) -> tuple[Manifold, Tensor]:
    """As `PolytopePairs._manifolds`, by the core. Where an edge or a face of a polytope that stands for a curved body is nearest,
    several directions separate as well, and FCL chooses among them by rounding."""
    a, b = finder.first[row], finder.second[row]
    found = meet(_Pairs(finder, a, b, poses[world, a], poses[world, b], moves), poses.dtype)
    incident, none = torch.where(found.swapped, b, a), found.count == 0
    there, first = found.there & ~none[:, None], found.point[:, :1]
    point = torch.where(there[..., None], found.point, first)
    gap = torch.where(there, found.gap, _FAR)
    offset = torch.where(none, -_FAR, found.offset)
    return Manifold(point, finder.table.radius[incident], found.normal, offset, found.swapped, there), gap


class _Pairs(Pairs):
    """Of colliders of a finder."""

    def __init__(self, finder: PolytopePairs, *sides: Tensor) -> None:
        super().__init__((), *sides)
        object.__setattr__(self, "finder", finder)

    @property
    def polytopes(self) -> Sequence[object]:  # type: ignore[override]
        return self.finder.polytopes  # type: ignore[attr-defined]

    @property
    def boxes(self) -> Tensor:
        finder = self.finder  # type: ignore[attr-defined]
        box = {(int(a), int(b)): bool(x) for a, b, x in zip(finder.first, finder.second, finder.boxes, strict=True)}
        return torch.tensor([box[int(a), int(b)] for a, b in zip(self.a, self.b, strict=True)])


def share_points(patch: pytest.MonkeyPatch) -> None:
    """From here on the reference has the core's contact points of polytopes."""
    patch.setattr(PolytopePairs, "_manifolds", of_core)
