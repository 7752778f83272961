"""The static part of an articulation: names, who is whose parent, and the index tensors that follow from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pbfd_torch.tensors.structures import Constant


@dataclass(frozen=True, eq=False)
class Topology(Constant):
    """Nodes are joints, node 0 is the world, node j + 1 is joint j; parents come first. All index tensors are on `device`, and are
    put there at once: a step must not wait for a copy."""

    link_names: tuple[str, ...]
    link_parent: tuple[int, ...]  # −1: the world
    link_node: tuple[int, ...]
    joint_names: tuple[str, ...]
    joint_sizes: tuple[tuple[int, int], ...]  # (nq, nv) of each joint
    joint_is_hinge: tuple[bool, ...]
    joint_link: tuple[int, ...]
    joint_parent: tuple[int, ...]  # a node
    device: torch.device

    def __post_init__(self) -> None:
        for name, value in vars(Topology).items():
            if isinstance(value, cached_property):
                getattr(self, name)

    def to(self, device: torch.device) -> Topology:
        return self if device == self.device else dataclasses.replace(self, device=device)

    def _long(self, values: Sequence[int]) -> Tensor:
        return torch.tensor(values, dtype=torch.long, device=self.device)

    def _mask(self, values: Sequence[bool] | Sequence[Sequence[bool]]) -> Tensor:
        return torch.tensor(values, dtype=torch.bool, device=self.device)

    @property
    def nlink(self) -> int:
        return len(self.link_names)

    @property
    def njoint(self) -> int:
        return len(self.joint_names)

    @property
    def nnode(self) -> int:
        return self.njoint + 1

    @cached_property
    def nq(self) -> int:
        return sum(nq for nq, _ in self.joint_sizes)

    @cached_property
    def nv(self) -> int:
        return sum(nv for _, nv in self.joint_sizes)

    @cached_property
    def q_start(self) -> tuple[int, ...]:
        """First coordinate of each joint."""
        return tuple(sum(nq for nq, _ in self.joint_sizes[:j]) for j in range(self.njoint))

    @cached_property
    def v_start(self) -> tuple[int, ...]:
        """First degree of freedom of each joint."""
        return tuple(sum(nv for _, nv in self.joint_sizes[:j]) for j in range(self.njoint))

    # hinge and slide joints -------------------------------------------------------------------------------------------
    @cached_property
    def _scalars(self) -> list[int]:
        return [j for j, size in enumerate(self.joint_sizes) if size == (1, 1)]

    @cached_property
    def scalar_joint(self) -> Tensor:
        return self._long(self._scalars)

    @cached_property
    def scalar_is_hinge(self) -> Tensor:
        return self._mask([self.joint_is_hinge[j] for j in self._scalars])

    @cached_property
    def _scalar_q(self) -> list[int]:
        return [self.q_start[j] for j in self._scalars]

    @cached_property
    def scalar_q(self) -> Tensor:
        return self._long(self._scalar_q)

    @cached_property
    def _scalar_v(self) -> list[int]:
        return [self.v_start[j] for j in self._scalars]

    @cached_property
    def scalar_v(self) -> Tensor:
        return self._long(self._scalar_v)

    # ball joints and the rotation of free joints ----------------------------------------------------------------------
    @cached_property
    def _turning(self) -> list[int]:
        return [j for j, (_, nv) in enumerate(self.joint_sizes) if nv >= 3]

    @cached_property
    def turning_joint(self) -> Tensor:
        return self._long(self._turning)

    @cached_property
    def _turning_q(self) -> list[int]:
        ends = [self.q_start[j] + self.joint_sizes[j][0] for j in self._turning]
        return [i for end in ends for i in range(end - 4, end)]

    @cached_property
    def turning_q(self) -> Tensor:
        """Coordinates of the quaternions, `[nturning, 4]`."""
        return self._long(self._turning_q).view(-1, 4)

    @cached_property
    def _turning_v(self) -> list[int]:
        ends = [self.v_start[j] + self.joint_sizes[j][1] for j in self._turning]
        return [i for end in ends for i in range(end - 3, end)]

    @cached_property
    def turning_v(self) -> Tensor:
        """Degrees of freedom of the rotations, `[nturning, 3]`."""
        return self._long(self._turning_v).view(-1, 3)

    def normalized(self, q: Tensor) -> Tensor:
        """A copy of q `[*batch, nq]` with its quaternions at unit norm."""
        q = q.clone()
        turning = q[..., self.turning_q]
        q[..., self.turning_q] = turning / torch.linalg.vector_norm(turning, dim=-1, keepdim=True)
        return q

    # translation of free joints ---------------------------------------------------------------------------------------
    @cached_property
    def _free(self) -> list[int]:
        return [j for j, (_, nv) in enumerate(self.joint_sizes) if nv == 6]

    @cached_property
    def moving(self) -> Tensor:
        """Positions in `turning_joint` of those that translate as well (free joints)."""
        return self._long([k for k, j in enumerate(self._turning) if self.joint_sizes[j][1] == 6])

    @cached_property
    def _free_q(self) -> list[int]:
        return [self.q_start[j] + k for j in self._free for k in range(3)]

    @cached_property
    def free_q(self) -> Tensor:
        """Coordinates of the free joints' positions, `[nfree, 3]`."""
        return self._long(self._free_q).view(-1, 3)

    @cached_property
    def _free_v(self) -> list[int]:
        return [self.v_start[j] + k for j in self._free for k in range(3)]

    @cached_property
    def free_v(self) -> Tensor:
        """Degrees of freedom of the free joints' translations, `[nfree, 3]`."""
        return self._long(self._free_v).view(-1, 3)

    # nodes ------------------------------------------------------------------------------------------------------------
    @cached_property
    def node_order(self) -> Tensor | None:
        """Where to find each joint in the list «hinge and slide joints, then ball and free ones»; None: already in place."""
        order = self._scalars + self._turning
        return None if order == list(range(self.njoint)) else self._long([order.index(j) for j in range(self.njoint)])

    @cached_property
    def v_order(self) -> Tensor:
        """Where to find each degree of freedom in the list «scalar_v, free_v, turning_v»."""
        order = self._scalar_v + self._free_v + self._turning_v
        return self._long([order.index(i) for i in range(self.nv)])

    @cached_property
    def q_order(self) -> Tensor:
        """Where to find each coordinate in the list «scalar_q, free_q, turning_q»."""
        order = self._scalar_q + self._free_q + self._turning_q
        return self._long([order.index(i) for i in range(self.nq)])

    @cached_property
    def jumps(self) -> tuple[Tensor, ...]:
        """Ancestors 1, 2, 4, … steps up, for composing poses along the tree in log₂(depth) rounds."""
        parent = [0, *self.joint_parent]
        tables = []
        while any(parent):
            tables.append(self._long(parent))
            parent = [parent[p] for p in parent]
        return tuple(tables)

    @cached_property
    def _ancestor(self) -> list[list[bool]]:
        """[i][j]: node i is node j or above it."""
        rows = [[i == j for j in range(self.nnode)] for i in range(self.nnode)]
        for j, parent in enumerate(self.joint_parent, start=1):
            for i in range(self.nnode):
                rows[i][j] = rows[i][j] or rows[i][parent]
        return rows

    @cached_property
    def link_node_index(self) -> Tensor:
        return self._long(self.link_node)

    # degrees of freedom -----------------------------------------------------------------------------------------------
    @cached_property
    def dof_joints(self) -> tuple[int, ...]:
        return tuple(j for j, (_, nv) in enumerate(self.joint_sizes) for _ in range(nv))

    @cached_property
    def dof_joint(self) -> Tensor:
        return self._long(self.dof_joints)

    @cached_property
    def translating(self) -> tuple[bool, ...]:
        """Degrees of freedom that are a free joint's translation (along world axes, not along the node's)."""
        return tuple(nv == 6 and k < 3 for _, nv in self.joint_sizes for k in range(nv))

    @cached_property
    def dof_node(self) -> Tensor:
        """The node in whose frame each degree of freedom's unit twist is constant."""
        return self._long([0 if moving else j + 1 for j, moving in zip(self.dof_joints, self.translating, strict=True)])

    @cached_property
    def turns(self) -> Tensor:
        """`[nv]` mask of the degrees of freedom that rotate (radians); the others translate (metres)."""
        return self._mask([i in self._turning_v or self.joint_is_hinge[j] for i, j in enumerate(self.dof_joints)])

    @cached_property
    def moves_link(self) -> Tensor:
        """`[nlink, nv]` 1 where the degree of freedom moves the link."""
        return self._mask([[self._ancestor[j + 1][node] for j in self.dof_joints] for node in self.link_node])

    @cached_property
    def subtree(self) -> Tensor:
        """`[njoint, nlink]` 1 where the link is moved by the joint."""
        return self._mask([[self._ancestor[j + 1][node] for node in self.link_node] for j in range(self.njoint)])

    @cached_property
    def above(self) -> Tensor:
        """`[nv, nv]` 1 where i belongs to a joint strictly above j's joint."""
        return self._mask([[i != j and self._ancestor[i + 1][j + 1] for j in self.dof_joints] for i in self.dof_joints])

    @cached_property
    def same_joint(self) -> Tensor:
        """`[nv, nv]` 1 where both belong to one joint."""
        return self.dof_joint[:, None] == self.dof_joint[None, :]

    @cached_property
    def carries(self) -> Tensor:
        """`[nv, nv]` 1 where i moves the axis of j: a joint above, or a free joint's translation below its rotation."""
        translating = self._mask(self.translating)
        return self.above | (self.same_joint & translating[:, None] & ~translating[None, :])

    @cached_property
    def moves_axis(self) -> Tensor:
        """`[nv, nv]` 1 where i moves the frame in which the twist of j is constant: all that `carries` it, and its own joint."""
        return self.above | (self.same_joint & ~self._mask(self.translating)[None, :])

    @cached_property
    def curvature_weight(self) -> Tensor:
        """`[nv, nv]` weight w of s_iᵀ B s_j in the Jacobian, J += Q + Qᵀ with Q = w ∘ (SᵀBS): 1 where i carries j's axis, ½ within
        one rotation, where the second derivative is the symmetric one of the exponential chart."""
        return self.carries.to(torch.float64) + 0.5 * (self.same_joint & ~self.carries & ~self.carries.T)
