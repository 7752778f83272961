"""How the compiled core has made steps, as derivatives follow them back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.stepping.way import Detour, Way
from pbfd_torch.tensors.worlds import Worlds


class Ways:
    """Room for how steps of worlds `[*batch]` are made, each as 2^halved parts at most.

    Attributes:
        halved: `[*batch]` int.
        eased: `[*batch, parts]` int, which of the easier steps each part is; 0: the scheme's own.
        ends: `[*batch, parts, nq]`.
    """

    def __init__(self, q: Tensor, halvings: int) -> None:
        batch, parts = q.shape[:-1], 2**halvings
        self.halved = torch.empty(batch, dtype=torch.int32)
        self.eased = torch.empty((*batch, parts), dtype=torch.int32)
        self.ends = q.new_empty(*batch, parts, q.shape[-1])

    def way(self, integrator: Integrator[Any], q: Tensor) -> Way:
        """That of steps which end at q `[*batch, nq]`."""
        batch, halved = tuple(q.shape[:-1]), self.halved.reshape(-1)
        eased, ends = (x.reshape(-1, *x.shape[len(batch) :]) for x in (self.eased, self.ends))
        if not bool((halved | eased[:, 0]).any()):  # as most steps are
            return Way(q)
        detours = list(_eased(batch, torch.where(halved == 0, eased[:, 0], 0), integrator, ends[:, 0]))
        for times in halved[halved > 0].unique().tolist():
            index = (halved == times).nonzero().squeeze(-1)
            legs = tuple(self._leg(eased[index, part], integrator, ends[index, part]) for part in range(2**times))
            detours.append(_taken(batch, index, integrator, legs))
        return Way(q, tuple(detours))

    @staticmethod
    def _leg(eased: Tensor, integrator: Integrator[Any], ends: Tensor) -> Way:
        return Way(ends, tuple(_eased((len(ends),), eased, integrator, ends)))


def _eased(batch: tuple[int, ...], which: Tensor, integrator: Integrator[Any], ends: Tensor) -> Iterator[Detour]:
    """Those of worlds that have made easier steps."""
    for k in which[which > 0].unique().tolist():
        index = (which == k).nonzero().squeeze(-1)
        yield _taken(batch, index, integrator.easier[k - 1], (Way(ends[index]),))


def _taken(batch: tuple[int, ...], index: Tensor, scheme: Integrator[Any], legs: tuple[Way, ...]) -> Detour:
    return Detour(Worlds(batch, index), torch.ones(len(index), dtype=torch.bool), scheme, legs)
