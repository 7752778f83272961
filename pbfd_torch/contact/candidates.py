"""What detection finds between bodies: a fixed number of candidate slots a world, filled or empty."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.contact.surface import Surface
from pbfd_torch.tensors.worlds import replaced


@dataclass(frozen=True, eq=False)
class Slots:
    """Points of bodies beside solids of other bodies, all `[*batch, n, …]`. A body is a link, or an obstacle after all links.

    Attributes:
        filled: bool; an empty slot stands for nothing.
        pair: which pair of colliders it belongs to, long.
        first, position, radius: the body that carries the point, where in its frame [m], and the radius around it [m] ≥ 0.
        second, surface: the body that carries the solid, and the solid in its frame.
        dropped: `[*batch]` bool, whether more was near than there are slots.
    """

    filled: Tensor
    pair: Tensor
    first: Tensor
    position: Tensor
    radius: Tensor
    second: Tensor
    surface: Surface
    dropped: Tensor


@dataclass(frozen=True, eq=False)
class Finder(ABC):
    """Finds the candidates of a step, all of one kind of solid, between colliders that are the same in all worlds. `slots`: how
    many candidates a world keeps."""

    slots: int = field(kw_only=True)

    @abstractmethod
    def find(self, bodies: Tensor, ahead: Tensor, reach: Tensor) -> Slots:
        """Candidates between bodies that stand at `bodies` `[*batch, nbody, 4, 4]`, would freely move to `ahead` in the step, like
        `bodies`, and move at most `reach` `[*batch, nbody]` [m]; constants of the step."""

    def grown(self) -> Self:
        """The same finder with twice as many slots."""
        return replaced(self, slots=2 * self.slots)


def nearest(gap: Tensor, within: Tensor, budget: int) -> tuple[Tensor, Tensor, Tensor]:
    """Of candidates `[*batch, m]` with these gaps [m] the `budget` nearest ones that are `within` (bool): their indices
    `[*batch, budget]`, repeated where there are fewer, which of them are real, and whether some were left out `[*batch]`."""
    order = torch.where(within, gap, torch.inf).sort(dim=-1, stable=True).indices[..., :budget]
    real = within.gather(-1, order)
    missing = budget - order.shape[-1]
    if missing > 0:
        order = torch.cat((order, order[..., :1].expand(*order.shape[:-1], missing)), -1)
        real = torch.cat((real, torch.zeros_like(real[..., :1]).expand(*real.shape[:-1], missing)), -1)
    return order, real, within.sum(-1) > budget
