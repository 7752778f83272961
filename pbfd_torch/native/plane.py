"""The plane in which a scene moves, if it does: the compiled core spares such a scene the third dimension."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.tree.articulation import Articulation


@dataclass(frozen=True, eq=False)
class Plane:
    """basis: `[3, 2]` of the plane in the world; bases: `[njoint, 3, 2]` of it on each node; turned: `[njoint, 2, 2]` how a node's
    lies in the world's where the joints stand at their references; sense: `[njoint]` ±1, of each node's z."""

    basis: Tensor
    bases: Tensor
    turned: Tensor
    sense: Tensor

    def nodes(self, a: Articulation, numbers: Sequence[Tensor]) -> Sequence[Tensor]:
        """Frames, origins, references, senses, masses, centres, second moments and what is carried, in the plane."""
        _, origin, reference, _, mass, center, second, carried = numbers
        eye, up = torch.eye(2, dtype=a.dtype), torch.tensor(a.topology.joint_parent)
        bases, turned = torch.cat((self.basis[None], self.bases))[up], torch.cat((eye[None], self.turned))[up]
        plain = (turned == self.turned).all(-1).all(-1)
        frame = torch.where(plain[:, None, None], eye, turned.mT @ self.turned)
        second = self.bases.mT @ second @ self.bases
        return frame, _inside(bases, origin), reference, self.sense, mass, _inside(self.bases, center), second, carried

    def on_nodes(self, nodes: Sequence[int], positions: Tensor) -> Tensor:
        """Positions on nodes, in the plane."""
        return _inside(self.bases[list(nodes)], positions)


def _inside(bases: Tensor, x: Tensor) -> Tensor:
    return (bases.mT @ x[..., None]).squeeze(-1)


def plane_of(a: Articulation, vectors: Sequence[Tensor]) -> Plane | None:
    """The plane in which all nodes move, if there is one in which these vectors `[3]` lie too. a: as `aligned` gives it."""
    t = a.topology
    hinges = torch.tensor(t.joint_is_hinge)
    if not bool(hinges.any()) or any(size != (1, 1) for size in t.joint_sizes):
        return None
    eye = torch.eye(3, dtype=a.dtype)
    placed = [eye]
    for frame, parent in zip(a.joint_frame, t.joint_parent, strict=True):
        placed.append(placed[parent] @ frame[:3, :3])
    turned = torch.stack(placed[1:])
    basis, normal = turned[hinges][0].split((2, 1), dim=-1)
    axes = turned[:, :, 2]
    along = (axes @ normal).squeeze(-1)
    tiny = 16.0 * torch.finfo(a.dtype).eps
    tilted = [along.abs() - hinges.to(a.dtype), *((x @ normal) / x.norm().clamp(min=1.0) for x in vectors)]
    if any(bool((x.abs() > tiny).any()) for x in tilted):
        return None
    inside = [torch.eye(2, dtype=a.dtype)]  # of the world, and of each node
    for hinge, parent, axis in zip(t.joint_is_hinge, t.joint_parent, axes @ basis, strict=True):
        slide = torch.stack((axis[1], -axis[0], axis[0], axis[1])).reshape(2, 2).mT  # its last axis
        inside.append(inside[parent] if hinge else slide)
    within = torch.stack(inside[1:])
    return Plane(basis, turned.mT @ basis @ within, within, torch.where(hinges, along.sign(), 1.0))
