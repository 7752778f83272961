"""How the compiled core has made steps, as derivatives follow them back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.solvers.objective import Status
from pbfd_torch.stepping.way import Detour, Way
from pbfd_torch.tensors.worlds import Worlds


class Ways:
    """Room for how steps of worlds `[*batch]` are made, each as 2^halved parts at most.

    Attributes:
        halved: `[*batch]` int.
        eased: `[*batch, parts]` int, which of the easier steps each part is; 0: the scheme's own, −1: that was explicit.
        ends: `[*batch, parts, nq]`.
    """

    def __init__(self, q: Tensor, halvings: int) -> None:
        batch, parts = q.shape[:-1], 2**halvings
        self.halved = torch.empty(batch, dtype=torch.int32)
        self.eased = torch.empty((*batch, parts), dtype=torch.int32)
        self.ends = q.new_empty(*batch, parts, q.shape[-1])

    def way(self, integrator: Integrator[Any], q: Tensor) -> Way:
        """That of steps which end at q `[*batch, nq]`."""
        if not bool((self.halved | self.eased[..., 0]).any()):  # as most steps are
            return Way(q)
        explicit = (self.eased[..., 0] == int(Status.EXPLICIT)) & (self.halved == 0)
        if bool(explicit.all()):
            return Way(q, explicit=True)
        detours = list(_eased(torch.where(self.halved == 0, self.eased[..., 0], 0), integrator, self.ends[..., 0, :]))
        for times in self.halved[self.halved > 0].unique().tolist():
            worlds = Worlds(tuple(self.halved.shape), _where(self.halved == times))
            eased, ends = worlds.rows(self.eased), worlds.rows(self.ends)
            parts = range(2**times)
            legs = tuple(Way(ends[..., k, :], tuple(_eased(eased[..., k], integrator, ends[..., k, :]))) for k in parts)
            detours.append(_taken(worlds, integrator, legs))
        if bool(explicit.any()):
            worlds = Worlds(tuple(explicit.shape), _where(explicit))
            detours.append(_taken(worlds, integrator, (Way(worlds.rows(q), explicit=True),)))
        return Way(q, tuple(detours))


def _eased(which: Tensor, integrator: Integrator[Any], ends: Tensor) -> Iterator[Detour]:
    """Those of worlds that have made easier steps: which `[*batch]`, to ends `[*batch, nq]`."""
    for k in which[which > 0].unique().tolist():
        worlds = Worlds(tuple(which.shape), _where(which == k))
        yield _taken(worlds, integrator.easier[k - 1], (Way(worlds.rows(ends)),))


def _where(which: Tensor) -> Tensor:
    """The positions of some worlds `[*batch]` in the flattened batch."""
    return which.reshape(-1).nonzero().squeeze(-1)


def _taken(worlds: Worlds, scheme: Integrator[Any], legs: tuple[Way, ...]) -> Detour:
    return Detour(worlds, torch.ones(len(worlds.index), dtype=torch.bool), scheme, legs)
