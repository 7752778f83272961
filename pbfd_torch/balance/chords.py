"""Virtual work on the chord of a step: chord loads → their part of the residual and its exact Jacobian.

For a dof i with twist s̄_i on the chord, at or above dof j, with subtree sums taken at j's joint, w the share of the chord:
    r_i = s̄_i · W,   ∂r_i/∂θ_j = s̄_iᵀ (A + w B) s_j + w s_j · Y_i
A: how the forces answer a motion; B: how the points on the chord move under forces held still; Y_i: how the axis s̄_i does.
Within a ball or free rotation that is the slope of r's components about the body's own axes. All other loads have theirs in the
exponential chart, where it is that of Jr(δ)ᵀ r(q ⊕ δ): less by ½ [r]×. The slopes of loads that balance add up in one chart only.
"""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from pbfd_torch.terms.load import ChordLoad
from pbfd_torch.tree.kinematics import link_residual, subtree_sum
from pbfd_torch.tree.rotations import skew, unskew


class ChordBalance:
    """The part of a chord load in the balance. residual: `[*batch, nv]` [N, N m]."""

    def __init__(self, load: ChordLoad) -> None:
        self._load = load
        self._chord = load.chord
        self._moment = subtree_sum(self._chord.end, load.moment)
        self.residual = link_residual(self._chord.end, self._moment, self._chord.axes)

    @cached_property
    def stiffness(self) -> Tensor:
        """The part of the Jacobian with B = 0 and Y = 0, `[*batch, nv, nv]`."""
        return self._worked(self._load.stiffness)

    @cached_property
    def curvature(self) -> Tensor:
        """What `stiffness` lacks of the exact ∂r/∂θ in the exponential chart, `[*batch, nv, nv]`."""
        rows = self._chord.end.articulation.topology.turning_v
        curved = self._chord.share[..., None, None] * (self._worked(_moved(self._load.moment_at_end)) + self._turned())
        if len(rows):
            curved[..., rows[:, :, None], rows[:, None, :]] -= 0.5 * skew(self.residual[..., rows])
        return curved

    def _worked(self, answer: Tensor) -> Tensor:
        """s̄_iᵀ A s_j over the links that both move, of A `[*batch, nlink, 6, 6]`."""
        end, axes = self._chord.end, self._chord.axes
        t = end.articulation.topology
        summed = subtree_sum(end, answer)[..., t.dof_joint, :, :]
        below = (summed @ end.axes[..., None]).squeeze(-1)  # A s_j: j moves, the rows at or above j feel it
        above = (summed.mT @ axes[..., None]).squeeze(-1)  # Aᵀ s̄_i: something above moves, row i feels it
        upper = (t.above | t.same_joint).to(axes.dtype)
        lower = t.above.T.to(axes.dtype)
        return upper * (axes @ below.mT) + lower * (above @ end.axes.mT)

    def _turned(self) -> Tensor:
        """s_j · Y_i `[*batch, nv, nv]`."""
        end, nodes = self._chord.end, self._chord.nodes
        t = end.articulation.topology
        moment = self._moment[..., t.dof_joint, :, :]
        torque, force = unskew(moment[..., :3]), moment[..., 3]
        omega, v = end.axes[..., :3], end.axes[..., 3:]
        at, on_chord = end.nodes[..., t.dof_node, :3, 3], nodes[..., t.dof_node, :3, 3]
        slide = v - torch.linalg.cross(at, omega)
        pull = torch.linalg.cross(force, self._chord.axes[..., :3])
        turning = (
            torch.linalg.cross(omega, torque - torch.linalg.cross(on_chord, force))
            + torch.linalg.cross(slide, force)
            - torch.linalg.cross(at, pull)
        )
        return t.moves_axis.T.to(omega.dtype) * (torch.cat((turning, -pull), -1) @ end.axes.mT)


def _moved(moment: Tensor) -> Tensor:
    """B of forces with first moment `[*, 3, 4]`: the virtual work ω_i × (ω_j × p + v_j) · f, `[*, 6, 6]`."""
    first = moment[..., :3]
    trace = first.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(3, dtype=moment.dtype, device=moment.device)
    top = torch.cat((first.mT - trace * eye, -skew(moment[..., 3])), -1)
    return torch.cat((top, torch.zeros_like(top)), -2)
