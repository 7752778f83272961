"""How every world of a batch has made a step: what a gradient follows back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.tensors.worlds import Worlds, replaced


@dataclass(frozen=True, eq=False)
class Detour:
    """The step of some worlds again, in another way.

    Attributes:
        worlds: which.
        kept: `[n]` bool, those of them that go on from where it ended.
        scheme: the integrator.
        legs: one for a step of the whole length, several for as many shorter ones.
    """

    worlds: Worlds
    kept: Tensor
    scheme: Any
    legs: tuple[Way, ...]


@dataclass(frozen=True, eq=False)
class Way:
    """Attributes:
    q: `[*batch, nq]` where the equations of the step itself left each world.
    detours: what was tried after it, the last one that a world keeps being the one that counts.
    objective: the balance of the step itself, for records of its contacts; None: not kept.
    explicit: q is where the integrator's explicit step has led.
    """

    q: Tensor
    detours: tuple[Detour, ...] = field(default=())
    objective: BalanceObjective | None = None
    explicit: bool = False

    def kept(self) -> Way:
        """The way as derivatives keep it: without the balance, which they make anew."""
        return Way(self.q, self.detours, explicit=self.explicit)

    def groups(self, included: Tensor | None) -> Iterator[tuple[Worlds | None, Detour | None, tuple[Way, ...]]]:
        """The worlds that have gone the same way, each with the detour that they kept (None: the step itself) and its legs for
        them; no worlds: all of them. included: `[*batch]` bool, those that matter; None: all."""
        batch = tuple(self.q.shape[:-1])
        if not self.detours and included is None:
            yield None, None, (self,)
            return
        count = self.q[..., 0].numel()
        owner = torch.zeros(count, dtype=torch.long, device=self.q.device)
        place = torch.zeros_like(owner)
        for k, detour in enumerate(self.detours, start=1):
            kept = detour.kept.reshape(-1)
            owner[detour.worlds.index[kept]] = k
            place[detour.worlds.index[kept]] = kept.nonzero().squeeze(-1)
        if included is not None:
            owner = torch.where(included.reshape(-1), owner, -1)
        ways: tuple[Detour | None, ...] = (None, *self.detours)
        for k, way in enumerate(ways):
            index = (owner == k).nonzero().squeeze(-1)
            if len(index) == 0:
                continue
            worlds = Worlds(batch, index)
            if way is None:
                yield worlds, None, (Way(worlds.rows(self.q), explicit=self.explicit),)
            else:
                yield worlds, way, tuple(leg.take(place[index]) for leg in way.legs)

    def take(self, index: Tensor) -> Way:
        """The way of some worlds, given by their positions in the flattened batch."""
        worlds = Worlds(tuple(self.q.shape[:-1]), index)
        found = torch.full((self.q[..., 0].numel(),), -1, dtype=torch.long, device=index.device)
        found[index] = torch.arange(len(index), device=index.device)
        detours = []
        for detour in self.detours:
            position = found[detour.worlds.index]
            inside = (position >= 0).nonzero().squeeze(-1)
            if len(inside):
                detours.append(
                    Detour(
                        Worlds((len(index),), position[inside]),
                        detour.kept.reshape(-1)[inside],
                        detour.scheme,
                        tuple(leg.take(inside) for leg in detour.legs),
                    )
                )
        return Way(worlds.rows(self.q), tuple(detours), explicit=self.explicit)

    def repeated(self, count: int) -> Way:
        """The same for `count` copies of the batch, as `[count, *batch]`."""
        batch = tuple(self.q.shape[:-1])
        size = self.q[..., 0].numel()
        detours = tuple(
            replaced(
                detour,
                worlds=Worlds((count, *batch), torch.cat([detour.worlds.index + k * size for k in range(count)])),
                kept=detour.kept.reshape(-1).repeat(count),
                legs=tuple(_flat(leg.repeated(count)) for leg in detour.legs),
            )
            for detour in self.detours
        )
        return Way(self.q.expand(count, *self.q.shape), detours, explicit=self.explicit)


def _flat(way: Way) -> Way:
    """The same with the first two dimensions of the batch, the copies and a detour's list of worlds, as one."""
    detours = tuple(
        replaced(d, worlds=Worlds((_count(way),), d.worlds.index), legs=tuple(_flat(x) for x in d.legs)) for d in way.detours
    )
    return Way(way.q.reshape(-1, way.q.shape[-1]), detours, explicit=way.explicit)


def _count(way: Way) -> int:
    return way.q[..., 0].numel()
