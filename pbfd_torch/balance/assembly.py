"""Link and joint loads → residual r and exact Jacobian J: the only place that knows both the loads and the tree.

For a dof i at or above dof j, with subtree sums W, A, B taken at j's joint (METHOD §3):
    r_i = s_i · W,   J_ij = s_iᵀ A s_j + s_iᵀ B s_j,   J_ji = s_jᵀ A s_i + s_iᵀ B s_j.
A is how the forces answer a motion; B is how the motion axes turn under forces that are held still.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable, Sequence
from functools import cached_property

import torch
from torch import Tensor

from pbfd_torch.balance.chords import ChordBalance
from pbfd_torch.terms.load import ChordLoad, JointLoad, LinkLoad, Load
from pbfd_torch.tree.kinematics import Placement, link_jacobians, link_residual, subtree_sum


def _total(values: Iterable[Tensor]) -> Tensor:
    return functools.reduce(operator.add, values)


class Balance:
    """The balance of a sum of loads. The matrices are assembled when first asked for.

    placement, loads: where, and of what. residual: r `[*batch, nv]` [N, N m], zero where Newton's law holds at the end of the
    step."""

    def __init__(self, placement: Placement, loads: Sequence[Load]) -> None:
        self.placement = placement
        self.loads = loads
        self._on_joints = [x for x in loads if isinstance(x, JointLoad)]
        self._on_links = [x for x in loads if isinstance(x, LinkLoad)]
        self.chords = [ChordBalance(x) for x in loads if isinstance(x, ChordLoad)]
        nothing = placement.poses.new_zeros(()).expand(*placement.poses.shape[:-2], 3, 4)
        self._moment = subtree_sum(placement, _total([x.moment for x in self._on_links] or [nothing]))
        self.residual = link_residual(placement, self._moment, placement.axes)
        for chord in self.chords:
            self.residual = self.residual + chord.residual
        for load in self._on_joints:
            self.residual = self.residual + load.residual

    @cached_property
    def stiffness(self) -> Tensor:
        """The part of J without the curvature of the tree (B = 0), `[*batch, nv, nv]`."""
        smooth = [x.stiffness for x in self.chords]
        return _total([self._on_moving_links, *smooth, *(x.stiffness for x in self._on_joints)])

    @cached_property
    def _on_moving_links(self) -> Tensor:
        t, axes = self.placement.articulation.topology, self.placement.axes
        column = axes[..., None]
        if not self._on_links:
            return axes.new_zeros(())
        summed = subtree_sum(self.placement, _total(x.stiffness for x in self._on_links))[..., t.dof_joint, :, :]
        below = (summed @ column).squeeze(-1)  # A s_j: j moves, the rows at or above j feel it
        above = (summed.mT @ column).squeeze(-1)  # Aᵀ s_j: something above moves, row j feels it
        upper = (t.above | t.same_joint).to(axes.dtype)
        lower = t.above.T.to(axes.dtype)
        convex = upper * (axes @ below.mT) + lower * (above @ axes.mT)
        for load in self._on_links:
            if load.coupled:
                convex = convex + self._coupled(load.coupling)
        return convex

    def _coupled(self, coupling: Tensor) -> Tensor:
        """S_aᵀ K_ab S_b summed over pairs of links, S the links' twists by the degrees of freedom."""
        twists = link_jacobians(self.placement).flatten(-3, -2)
        return twists.mT @ coupling.transpose(-3, -2).flatten(-4, -3).flatten(-2) @ twists

    @cached_property
    def jacobian(self) -> Tensor:
        """J = ∂r/∂θ `[*batch, nv, nv]`, exact, in the exponential chart at q; not symmetric once there is friction."""
        t, axes = self.placement.articulation.topology, self.placement.axes
        omega, v = axes[..., :3], axes[..., 3:]
        first = self._moment[..., :3][..., t.dof_joint, :, :]
        force = self._moment[..., 3][..., t.dof_joint, :]
        trace = first.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
        torque = torch.linalg.cross(*torch.broadcast_tensors(force, v))
        turned = (first.mT @ omega[..., None]).squeeze(-1) - trace * omega - torque
        curved = t.curvature_weight.to(axes.dtype) * (omega @ turned.mT)
        total = self.stiffness + curved + curved.mT
        for chord in self.chords:
            total = total + chord.curvature
        return total
