"""What BDF2 remembers, as the core has it: the poses of nodes, side by side, where the reference has those of links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.tree.articulation import Articulation, homogeneous

ENTRIES = 12  # of a pose: rotation and position


@dataclass(frozen=True, eq=False)
class Seats:
    """Where links are on nodes.

    Attributes:
        node: `[nlink]` of each link, 0: the world.
        frame: `[*, nlink, 4, 4]` of each link on its node.
        link: `[nodes]` a link on each node; one without links moves nothing, and has any.
    """

    node: Tensor
    frame: Tensor
    link: Tensor

    @staticmethod
    def of(a: Articulation) -> Seats:
        """Of a tree, as `aligned` gives it."""
        node = list(a.topology.link_node)
        link = [node.index(k) if k in node else 0 for k in range(1, a.topology.njoint + 1)]
        return Seats(torch.tensor(node), a.link_frame, torch.tensor(link))

    def take(self, worlds: Worlds) -> Seats:
        """Those of some worlds."""
        return replaced(self, frame=worlds.pick(self.frame, 3))

    def of_nodes(self, history: Sequence[Tensor]) -> Tensor:
        """Poses of all links, each `[*batch, nlink, 4, 4]`, as those of the nodes, `[*batch, len(history) · nodes · ENTRIES]`."""
        links = torch.stack(tuple(history), -4)[..., self.link, :, :]
        poses = links @ self._back[..., None, self.link, :, :]
        return torch.cat((poses[..., :3, :3].flatten(-2), poses[..., :3, 3]), -1).flatten(-3)

    def of_links(self, history: Tensor, count: int) -> tuple[Tensor, ...]:
        """The same back: `count` times the poses of all links."""
        entries = history.unflatten(-1, (count, len(self.link), ENTRIES))
        nodes = homogeneous(entries[..., :9].unflatten(-1, (3, 3)), entries[..., 9:])
        world = torch.eye(4, dtype=nodes.dtype).expand(*nodes.shape[:-3], 1, 4, 4)
        return (torch.cat((world, nodes), -3)[..., self.node, :, :] @ self.frame[..., None, :, :, :]).unbind(-4)

    @cached_property
    def _back(self) -> Tensor:
        """Of each node on its link."""
        return torch.linalg.inv(self.frame)
