"""Which pairs of colliders may come near each other: boxes around them, in the axes of the world.

Two ways with one result: all pairs at once on tensors, for all worlds and on any device; and FCL's tree of boxes, world by world on
the CPU, for scenes with so many colliders that most pairs are never near.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.tensors.plain import plain

_ROUNDING = 1e-14  # of a corner's coordinates: FCL's own boxes are no smaller than ours


class BroadPhase(Protocol):
    """Finds pairs of boxes that overlap."""

    def near(self, lower: Tensor, upper: Tensor) -> Tensor:
        """bool `[*batch, npair]`: which pairs of boxes with these corners `[*batch, ncollider, 3]` [m] overlap."""
        ...


@dataclass(frozen=True, eq=False)
class AllPairs:
    """Looks at every pair. `first`, `second`: `[npair]` the colliders of each pair."""

    first: Tensor
    second: Tensor

    def near(self, lower: Tensor, upper: Tensor) -> Tensor:
        """See `BroadPhase`."""
        one, other = self.first, self.second
        # nothing is near what is not finite
        return ((lower[..., one, :] <= upper[..., other, :]) & (lower[..., other, :] <= upper[..., one, :])).all(-1)


@dataclass(frozen=True, eq=False)
class FclTree:
    """FCL's dynamic tree of boxes. `first`, `second`: `[npair]` the colliders of each pair; other pairs are left out.

    FCL only compares boxes here: what it says of the shapes themselves comes later, pair by pair."""

    first: Tensor
    second: Tensor

    @cached_property
    def _number(self) -> dict[tuple[int, int], int]:
        return {pair: k for k, pair in enumerate(zip(self.first.tolist(), self.second.tolist(), strict=True))}

    def near(self, lower: Tensor, upper: Tensor) -> Tensor:
        """See `BroadPhase`."""
        import fcl

        batch = lower.shape[:-2]
        low, high = (plain(x).to("cpu", torch.float64).reshape(-1, *x.shape[-2:]).numpy() for x in (lower, upper))
        middle = 0.5 * (high + low)
        size = np.maximum(high - low, 0.0) + _ROUNDING * np.maximum(np.abs(low), np.abs(high))
        found = np.zeros((len(low), len(self._number)), dtype=bool)

        finite = np.isfinite(size).all((-2, -1)) & np.isfinite(middle).all((-2, -1))
        for k in np.flatnonzero(finite):
            hits, sizes, places = found[k], size[k], middle[k]
            # FCL hands out new objects in its calls: what is known of one is where it is, and colliders may share a centre
            at: dict[bytes, list[int]] = {}
            for number, place in enumerate(places):
                at.setdefault(place.tobytes(), []).append(number)
            manager = fcl.DynamicAABBTreeCollisionManager()
            boxes = [fcl.CollisionObject(fcl.Box(*x), fcl.Transform(p)) for x, p in zip(sizes, places, strict=True)]
            manager.registerObjects(boxes)
            manager.setup()
            manager.collide((at, hits), self._note)
        world, row = found.nonzero()  # FCL gives too many of these: all at one place, and those that almost touch
        one, other = (x.cpu().numpy()[row] for x in (self.first, self.second))
        apart = (low[world, one] > high[world, other]) | (low[world, other] > high[world, one])
        found[world, row] = ~apart.any(-1)
        return torch.from_numpy(found).to(lower.device).reshape(*batch, -1)

    def _note(self, one: Any, other: Any, found: tuple[dict[bytes, list[int]], NDArray[np.bool_]]) -> bool:
        """Marks a pair of boxes that FCL finds overlapping; False: it is to go on."""
        at, hits = found
        for a, b in itertools.product(at[one.getTranslation().tobytes()], at[other.getTranslation().tobytes()]):
            k = self._number.get((a, b), self._number.get((b, a)))
            if k is not None:
                hits[k] = True
        return False
