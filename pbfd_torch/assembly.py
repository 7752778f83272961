"""Link and joint loads → residual r and exact Jacobian J: the only place that knows both the loads and the tree.

For a dof i at or above dof j, with subtree sums W, A, B taken at j's joint (METHOD §3):
    r_i = s_i · W,   J_ij = s_iᵀ A s_j + s_iᵀ B s_j,   J_ji = s_jᵀ A s_i + s_iᵀ B s_j.
A is how the forces answer a motion; B is how the motion axes turn under forces that are held still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.kinematics import Placement
from pbfd_torch.rotations import unskew
from pbfd_torch.terms.load import JointLoad, LinkLoad, Load


@dataclass(frozen=True, eq=False)
class Balance:
    """Attributes:
    residual: r `[*batch, nv]` [N, N m]; zero where Newton's law holds at the end of the step.
    jacobian: J = ∂r/∂θ `[*batch, nv, nv]`, exact, in the exponential chart at q; not symmetric once there is friction.
    stiffness: the part of J without the curvature of the tree (B = 0).
    """

    residual: Tensor
    jacobian: Tensor
    stiffness: Tensor


def subtree_sums(placement: Placement, loads: Sequence[LinkLoad]) -> tuple[Tensor, Tensor]:
    """Sums of `moment` and `stiffness` over everything each joint moves: `[*batch, njoint, 3, 4]`, `[*batch, njoint, 6, 6]`."""
    moment, stiffness = loads[0].moment, loads[0].stiffness
    for load in loads[1:]:
        moment, stiffness = moment + load.moment, stiffness + load.stiffness
    mask = placement.articulation.topology.subtree.to(moment.dtype)
    mask = mask.expand(*moment.shape[:-3], *mask.shape)
    return (mask @ moment.flatten(-2)).unflatten(-1, (3, 4)), (mask @ stiffness.flatten(-2)).unflatten(-1, (6, 6))


def link_residual(placement: Placement, moment: Tensor) -> Tensor:
    """r_i = s_i · W of subtree-summed moments `[*batch, njoint, 3, 4]`: `[*batch, nv]`."""
    wrench = torch.cat((unskew(moment[..., :3]), moment[..., 3]), -1)
    return (placement.axes * wrench[..., placement.articulation.topology.dof_joint, :]).sum(-1)


def assemble(placement: Placement, loads: Sequence[Load]) -> Balance:
    """Residual and Jacobian of a sum of loads, of which at least one is on links."""
    t = placement.articulation.topology
    axes = placement.axes
    moment, stiffness = subtree_sums(placement, [x for x in loads if isinstance(x, LinkLoad)])
    residual = link_residual(placement, moment)

    column = axes[..., None]
    summed = stiffness[..., t.dof_joint, :, :]
    below = (summed @ column).squeeze(-1)  # A s_j: j moves, the rows at or above j feel it
    above = (summed.mT @ column).squeeze(-1)  # Aᵀ s_j: something above moves, row j feels it
    upper = (t.above | t.same_joint).to(axes.dtype)
    lower = t.above.T.to(axes.dtype)
    convex = upper * (axes @ below.mT) + lower * (above @ axes.mT)

    omega, v = axes[..., :3], axes[..., 3:]
    first = moment[..., :3][..., t.dof_joint, :, :]
    force = moment[..., 3][..., t.dof_joint, :]
    trace = first.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    turned = (first.mT @ omega[..., None]).squeeze(-1) - trace * omega - torch.linalg.cross(*torch.broadcast_tensors(force, v))
    curved = t.curvature_weight.to(axes.dtype) * (omega @ turned.mT)

    for load in loads:
        if isinstance(load, JointLoad):
            residual = residual + load.residual
            convex = convex + load.stiffness
    return Balance(residual, convex + curved + curved.mT, convex)
