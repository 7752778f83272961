"""Forward kinematics: q → node and link poses, motion axes, twists; and the manifold's retract and difference.

All functions take any batch shape; batch dimensions of the articulation's parameters and of q broadcast.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pbfd_torch.tensors.shapes import broadcast_shapes
from pbfd_torch.tree.articulation import Articulation, homogeneous
from pbfd_torch.tree.rotations import (
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_matrix,
    quaternion_multiply,
    quaternion_normalize,
    skew,
    unskew,
)


@dataclass(frozen=True, eq=False)
class Placement:
    """An articulation placed at a configuration.

    Attributes:
        articulation: what is placed.
        q: `[*batch, nq]` the configuration.
        nodes: `[*batch, nnode, 4, 4]` world pose of every node (node 0: the world).
        poses: `[*batch, nlink, 4, 4]` world pose of every link.
    """

    articulation: Articulation
    q: Tensor
    nodes: Tensor
    poses: Tensor

    @cached_property
    def axes(self) -> Tensor:
        """Unit twists s_i = (ω_i, v_i) of all degrees of freedom `[*batch, nv, 6]`, v taken at the world origin."""
        return motion_axes(self.articulation, self.nodes)


def place(articulation: Articulation, q: Tensor) -> Placement:
    """Poses of all nodes and links at q `[*batch, nq]`."""
    nodes = node_poses(articulation, q)
    poses = nodes[..., articulation.topology.link_node_index, :, :] @ articulation.link_frame
    return Placement(articulation, q, nodes, poses)


@dataclass(frozen=True, eq=False)
class Chord:
    """Between two placements: `share` w `[*batch]` of the way from every pose of the start to that of the end, in a straight
    line; its rotation matrices are none, but shrink by the cosine of half the turn in the middle."""

    start: Placement
    end: Placement
    share: Tensor

    def _between(self, start: Tensor, end: Tensor) -> Tensor:
        return start + self.share[..., None, None, None] * (end - start)

    @cached_property
    def poses(self) -> Tensor:
        """`[*batch, nlink, 4, 4]`."""
        return self._between(self.start.poses, self.end.poses)

    @cached_property
    def nodes(self) -> Tensor:
        """`[*batch, nnode, 4, 4]`."""
        return self._between(self.start.nodes, self.end.nodes)

    @cached_property
    def axes(self) -> Tensor:
        """Twists of the degrees of freedom about the axes on the chord, `[*batch, nv, 6]`."""
        return motion_axes(self.end.articulation, self.nodes)


def _local_poses(articulation: Articulation, q: Tensor) -> Tensor:
    """Pose of every joint on its previous node, `[*batch, njoint, 4, 4]`."""
    t = articulation.topology
    groups = []
    if len(t.scalar_joint):
        x = q[..., t.scalar_q] - articulation.joint_ref[..., t.scalar_joint]
        frame = articulation.joint_frame[..., t.scalar_joint, :, :]
        groups.append(frame + frame @ scalar_motion(articulation.joint_axis[..., t.scalar_joint, :], t.scalar_is_hinge, x))
    if len(t.turning_joint):
        position = q.new_zeros((*q.shape[:-1], len(t.turning_joint), 3))
        if len(t.free_q):
            position[..., t.moving, :] = q[..., t.free_q]
        turned = homogeneous(quaternion_matrix(q[..., t.turning_q]), position)
        groups.append(articulation.joint_frame[..., t.turning_joint, :, :] @ turned)
    if len(groups) == 1:
        return groups[0]
    batch = broadcast_shapes(*(g.shape[:-3] for g in groups))
    local = torch.cat([g.expand(*batch, *g.shape[-3:]) for g in groups], -3)
    return local if t.node_order is None else local[..., t.node_order, :, :]


def scalar_motion(axis: Tensor, hinge: Tensor, x: Tensor) -> Tensor:
    """M − 1 `[*, n, 4, 4]`, M the motion by x `[*, n]` [rad or m] about or along a unit axis `[*, n, 3]`; hinge: `[n]` bool. With
    the 1 small motions would be rounded."""
    k = skew(axis)
    half_sine = torch.sin(0.5 * x)
    sine, versine = (torch.where(hinge, y, 0.0)[..., None, None] for y in (torch.sin(x), 2 * half_sine * half_sine))
    turn = sine * k + versine * (k @ k)  # Rodrigues; 1 − cos x without cancellation
    shift = torch.where(hinge, 0.0, x)[..., None] * axis
    return torch.nn.functional.pad(torch.cat((turn, shift[..., None]), -1), (0, 0, 0, 1))


def node_poses(articulation: Articulation, q: Tensor) -> Tensor:
    """World poses of the nodes `[*batch, nnode, 4, 4]`, composed along the tree in log₂(depth) rounds."""
    local = _local_poses(articulation, q)
    world = torch.eye(4, dtype=q.dtype, device=q.device).expand(*local.shape[:-3], 1, 4, 4)
    nodes = torch.cat((world, local), -3)
    for ancestor in articulation.topology.jumps:
        nodes = nodes[..., ancestor, :, :] @ nodes
    return nodes


def motion_axes(articulation: Articulation, nodes: Tensor) -> Tensor:
    """World unit twists (ω, v at the world origin) of all degrees of freedom, `[*batch, nv, 6]` (METHOD §3)."""
    t = articulation.topology
    local = local_twists(articulation)
    frame = nodes[..., t.dof_node, :3, :]
    turned = frame[..., :3] @ local  # columns ω, v
    omega, v = turned.unbind(-1)
    return torch.cat((omega, v + torch.linalg.cross(frame[..., 3], omega)), -1)


def local_twists(articulation: Articulation) -> Tensor:
    """Unit twists in the frame of `dof_node`, `[*, nv, 3, 2]` with columns (ω, v)."""
    t = articulation.topology
    axis = articulation.joint_axis[..., t.scalar_joint, :]
    zero = torch.zeros_like(axis)
    hinge = t.scalar_is_hinge[:, None]
    scalar = torch.stack((torch.where(hinge, axis, zero), torch.where(hinge, zero, axis)), -1)
    eye = torch.eye(3, dtype=axis.dtype, device=axis.device).expand(*axis.shape[:-2], 3, 3)
    flat = torch.zeros_like(eye)
    moving = torch.stack((flat, eye), -1).repeat(*[1] * (axis.ndim - 2), len(t.free_v), 1, 1)
    turning = torch.stack((eye, flat), -1).repeat(*[1] * (axis.ndim - 2), len(t.turning_v), 1, 1)
    return torch.cat((scalar, moving, turning), -3)[..., t.v_order, :, :]


def subtree_sum(placement: Placement, of_links: Tensor) -> Tensor:
    """Sum over all links that each joint moves, `[*batch, nlink, r, c] → [*batch, njoint, r, c]`."""
    mask = placement.articulation.topology.subtree.to(of_links.dtype)
    mask = mask.expand(*of_links.shape[:-3], *mask.shape)
    return (mask @ of_links.flatten(-2)).unflatten(-1, of_links.shape[-2:])


def link_residual(placement: Placement, moment: Tensor, axes: Tensor) -> Tensor:
    """r_i = s_i · W of subtree-summed moments `[*batch, njoint, 3, 4]` along twists s `[*batch, nv, 6]`: `[*batch, nv]`."""
    wrench = torch.cat((unskew(moment[..., :3]), moment[..., 3]), -1)
    return (axes * wrench[..., placement.articulation.topology.dof_joint, :]).sum(-1)


def link_jacobians(placement: Placement) -> Tensor:
    """World twist of every link per unit velocity of every degree of freedom, `[*batch, nlink, 6, nv]`."""
    moves = placement.articulation.topology.moves_link.to(placement.q.dtype)
    return placement.axes.mT[..., None, :, :] * moves[:, None, :]


@dataclass(frozen=True, eq=False)
class Motion:
    """An articulation that moves from a placement with velocity v `[*batch, nv]` and no generalised acceleration."""

    placement: Placement
    v: Tensor

    @cached_property
    def twists(self) -> Tensor:
        """World twists V = (ω, v at the world origin) of all links `[*batch, nlink, 6]`."""
        return self._of_links(self.placement.axes * self.v[..., None])

    @cached_property
    def drifts(self) -> Tensor:
        """How the twists change, V̇ = Σ ṡ_i v_i with ṡ_i = ad(V_carrier) s_i, `[*batch, nlink, 6]`."""
        axes = self.placement.axes
        carriers = self.placement.articulation.topology.carries.T.to(self.v.dtype)
        # not by a matrix product, which in float32 rounds differently for one world and for many
        carrier = (carriers[..., None] * (axes * self.v[..., None])[..., None, :, :]).sum(-2)
        turned = torch.linalg.cross(carrier[..., :3], axes[..., :3])
        moved = torch.linalg.cross(carrier[..., :3], axes[..., 3:]) + torch.linalg.cross(carrier[..., 3:], axes[..., :3])
        return self._of_links(torch.cat((turned, moved), -1) * self.v[..., None])

    def _of_links(self, of_dofs: Tensor) -> Tensor:
        """Sums over the degrees of freedom that move each link."""
        moves = self.placement.articulation.topology.moves_link.to(of_dofs.dtype)
        return moves.expand(*of_dofs.shape[:-2], *moves.shape) @ of_dofs

    @cached_property
    def velocities(self) -> Tensor:
        """[V], which takes a point of a link to its velocity, `[*batch, nlink, 3, 4]`."""
        return _hat(self.twists)

    @cached_property
    def changes(self) -> Tensor:
        """[V̇] + [V]², which takes a point of a link to its acceleration, `[*batch, nlink, 3, 4]`."""
        return _hat(self.drifts) + skew(self.twists[..., :3]) @ self.velocities

    @cached_property
    def rates(self) -> Tensor:
        """Ṫ = [V]T of all link poses `[*batch, nlink, 3, 4]`."""
        return self.velocities @ self.placement.poses

    @cached_property
    def accelerations(self) -> Tensor:
        """T̈ = ([V̇] + [V]²)T of all link poses `[*batch, nlink, 3, 4]`."""
        return self.changes @ self.placement.poses


def _hat(twist: Tensor) -> Tensor:
    """[V] without its row of zeros, `[*, 6] → [*, 3, 4]`."""
    return torch.cat((skew(twist[..., :3]), twist[..., 3:, None]), -1)


def retract(articulation: Articulation, q: Tensor, delta: Tensor) -> Tensor:
    """q moved by the tangent vector `delta` `[*batch, nv]`: sums, and q ⊗ exp(δ) for rotations. Quaternions come out at unit
    norm."""
    t = articulation.topology
    parts = [q[..., t.scalar_q] + delta[..., t.scalar_v]]
    if len(t.free_q):
        parts.append((q[..., t.free_q] + delta[..., t.free_v]).flatten(-2))
    if len(t.turning_q):
        turned = quaternion_multiply(q[..., t.turning_q], quaternion_exp(delta[..., t.turning_v]))
        parts.append(quaternion_normalize(turned).flatten(-2))
    return parts[0] if len(parts) == 1 else torch.cat(parts, -1)[..., t.q_order]


def coordinate_rates(articulation: Articulation, q: Tensor, v: Tensor) -> Tensor:
    """q̇ `[*batch, nq]` of a velocity `[*batch, nv]`; quaternions, of any norm, turn by ½ q ⊗ ω and keep it."""
    t = articulation.topology
    parts = [v[..., t.scalar_v]]
    if len(t.free_q):
        parts.append(v[..., t.free_v].flatten(-2))
    if len(t.turning_q):
        turning = v[..., t.turning_v]
        spin = torch.cat((torch.zeros_like(turning[..., :1]), turning), -1)
        parts.append(0.5 * quaternion_multiply(q[..., t.turning_q], spin).flatten(-2))
    return parts[0] if len(parts) == 1 else torch.cat(parts, -1)[..., t.q_order]


def velocity_of_rates(articulation: Articulation, q: Tensor, rates: Tensor) -> Tensor:
    """The velocity `[*batch, nv]` with which coordinates, their quaternions of any norm, change at `rates` `[*batch, nq]`: undoes
    `coordinate_rates`. What changes a quaternion's norm is no motion and left out."""
    t = articulation.topology
    parts = [rates[..., t.scalar_q]]
    if len(t.free_q):
        parts.append(rates[..., t.free_q].flatten(-2))
    if len(t.turning_q):
        turning = q[..., t.turning_q]
        spin = quaternion_multiply(quaternion_conjugate(turning), rates[..., t.turning_q])
        parts.append((2 * spin[..., 1:] / turning.square().sum(-1, keepdim=True)).flatten(-2))
    return parts[0] if len(parts) == 1 else torch.cat(parts, -1)[..., t.v_order]


def difference(articulation: Articulation, start: Tensor, end: Tensor) -> Tensor:
    """Tangent vector `[*batch, nv]` that takes `start` to `end`: retract(start, difference(start, end)) = end. Angles of ball and
    free joints come out in [0, π]; hinge angles are plain differences."""
    t = articulation.topology
    parts = [end[..., t.scalar_q] - start[..., t.scalar_q]]
    if len(t.free_q):
        parts.append((end[..., t.free_q] - start[..., t.free_q]).flatten(-2))
    if len(t.turning_q):
        between = quaternion_multiply(quaternion_conjugate(start[..., t.turning_q]), end[..., t.turning_q])
        parts.append(quaternion_log(between).flatten(-2))
    return parts[0] if len(parts) == 1 else torch.cat(parts, -1)[..., t.v_order]
