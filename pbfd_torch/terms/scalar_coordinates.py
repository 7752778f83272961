"""Coordinates of hinge and slide joints, each at the place of its degree of freedom."""

from __future__ import annotations

from torch import Tensor

from pbfd_torch.tree.kinematics import Placement


def scalar_coordinates(placement: Placement) -> Tensor:
    """Of every hinge and slide [rad or m], 0 for the degrees of freedom of other joints, `[*batch, nv]`."""
    t, q = placement.articulation.topology, placement.q
    x = q.new_zeros((*q.shape[:-1], t.nv))
    x[..., t.scalar_v] = q[..., t.scalar_q]
    return x
