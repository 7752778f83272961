"""Random trees whose links are sets of point masses: integrals over bodies become sums, an oracle apart from pseudo-inertias."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import place
from tests.random_trees import generator, random_links


@dataclass(frozen=True, eq=False)
class PointBodies:
    """A tree and its points: `masses` `[nlink, npoint]` [kg], `positions` `[nlink, npoint, 3]` [m] in the links' frames."""

    articulation: Articulation
    masses: Tensor
    positions: Tensor

    def points(self, q: Tensor) -> Tensor:
        """World positions at q: `[*batch, nlink, npoint, 3]`."""
        poses = place(self.articulation, q).poses
        return self.positions @ poses[..., :3, :3].mT + poses[..., None, :3, 3]


def point_bodies(seed: int, count: int = 6) -> PointBodies:
    """A random tree made of `count` points a link; mass, COM and inertia are the sums over the points."""
    random = generator(4000 + seed)
    links, masses, positions = [], [], []
    for link in random_links(seed):
        share = torch.rand(count, dtype=torch.float64, generator=random) * (1.0 if link.mass > 0 else 0.0)
        place_of = 0.15 * torch.randn(count, 3, dtype=torch.float64, generator=random)
        mass = float(share.sum())
        com = share @ place_of / mass if mass else torch.zeros(3, dtype=torch.float64)
        arm = place_of - com
        second = (share[:, None] * arm).T @ arm
        inertia = torch.trace(second) * torch.eye(3, dtype=torch.float64) - second
        x, y, z = com.tolist()
        rows = tuple((a, b, c) for a, b, c in (0.5 * (inertia + inertia.T)).tolist())
        links.append(dataclasses.replace(link, mass=mass, com=(x, y, z), inertia=rows))
        masses.append(share)
        positions.append(place_of)
    return PointBodies(Articulation.from_links(links), torch.stack(masses), torch.stack(positions))
