"""Obstacles in prescribed motion as the compiled core sees them: where they are whenever a step, or a part of it, may begin or
end.

Motions are Python, and may be a user's own: they are evaluated here, for all steps of a call at once."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.contact.obstacle import Carrier
from pbfd_torch.tensors.worlds import Worlds


@dataclass
class Carriers:
    """What carries the obstacles that move, and those on whose surface candidates run."""

    each: list[Carrier] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.each)

    def number(self, carrier: Carrier) -> int:
        """The place of one among them; contact terms have their own of each obstacle."""
        for k, other in enumerate(self.each):
            if carrier.motion is other.motion and torch.equal(carrier.start, other.start):
                return k
        self.each.append(carrier)
        return len(self.each) - 1

    def take(self, worlds: Worlds) -> Carriers:
        """Those of some worlds."""
        return Carriers([x.take(worlds) for x in self.each])

    @property
    def belts(self) -> list[Tensor]:
        """Velocities of the running surfaces in the obstacles' frames, `[3]` each [m/s]."""
        return [x.belt for x in self.each]

    @torch.no_grad()
    def poses(self, time: Tensor) -> Tensor:
        """Where they are at some instants `[n, *batch]` [s]: rotation and position of each, `[n, worlds, len, 12]`, of one world
        where all have the same."""
        batch = time.shape[1:]
        if not self.each or not time.numel():
            return time.new_empty(len(time), batch.numel(), len(self), 12)
        ones = (1,) * len(batch)
        first = time[:, None].flatten(1)[:, :1].reshape(-1, *ones)
        if bool((time == first).all()):
            time = first
        poses = [x.pose(time) for x in self.each]
        poses = [torch.cat((x[..., :3, :3].flatten(-2), x[..., :3, 3]), -1) for x in poses]
        same = all(x.shape[-1 - len(batch) : -1].numel() == 1 for x in poses)
        told = torch.stack([x.expand(len(time), *(ones if same else batch), 12) for x in poses], -2)
        return told.reshape(len(time), 1 if same else batch.numel(), len(self), 12).contiguous()


def passed(time: Tensor, step: Tensor, count: int) -> Tensor:
    """The times from `time` `[*batch]` on at the ends of so many steps, `[count + 1, *batch]`, as the steps sum them up."""
    ends = torch.cat((time[None], step.expand(count, *time.shape)))
    return torch.from_numpy(np.add.accumulate(ends.detach().numpy()))


def parted(time: Tensor, step: Tensor, parts: int) -> Tensor:
    """The times at the ends of so many parts of all steps between times `[count + 1, *batch]`, `[parts · count + 1, *batch]`."""
    within = step / parts * torch.arange(parts, dtype=time.dtype).reshape(-1, *(1 for _ in time.shape[1:]))
    begun = time[:-1, None] + within
    return torch.cat((begun.flatten(0, 1), time[-1:]))
