"""Candidates between round bodies without flat caps: each pair touches where it comes closest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.contact.candidates import Finder, Slots, nearest
from pbfd_torch.contact.closest import Meeting, RoundShape, RoundTable, Sought
from pbfd_torch.contact.curved_pairs import CurvedSlots
from pbfd_torch.tensors.constants import indices


@dataclass(frozen=True, eq=False)
class ClosestPairs(Finder):
    """Pairs of round bodies. `pair`: `[m]` the number of each pair; `body`: `[m, 2]` its bodies; `table`: its shapes in their
    frames."""

    pair: Tensor
    body: Tensor
    table: RoundTable

    @staticmethod
    def of(pairs: Sequence[tuple[int, tuple[int, RoundShape], tuple[int, RoundShape]]], slots: int, like: Tensor) -> ClosestPairs:
        """From pairs (number, one, other), each side with its body; `like`: dtype and device."""
        ordered = [sorted(both, key=lambda side: side[1].wide) for _, *both in pairs]
        return ClosestPairs(
            pair=indices([k for k, *_ in pairs], like.device),
            body=torch.tensor([[body for body, _ in both] for both in ordered], device=like.device),
            table=RoundTable.of([(one, other) for (_, one), (_, other) in ordered], like),
            slots=slots,
        )

    def find(self, bodies: Tensor, ahead: Tensor, reach: Tensor) -> Slots:
        """See `Finder`."""
        sought = self.table.sought(bodies[..., self.body, :3, :])
        moves = reach[..., self.body].sum(-1).detach()
        which, filled, dropped = nearest(sought.gap, sought.gap < moves, self.slots)
        gap, normal, height = (
            x.take_along_dim(which[..., None], -2) for x in (sought.gap[..., None], sought.normal, sought.height)
        )
        gap, table, body = gap.squeeze(-1), self.table.take(which), self.body[which]
        frames = bodies[..., None, :, :3, :].take_along_dim(body[..., None, None], -3)
        both, plane = table.met(frames, Sought(gap, normal, height, filled))
        follows = filled & ~table.held(gap, moves.gather(-1, which))
        return CurvedSlots(
            filled=filled,
            pair=self.pair[which],
            first=body[..., 0],
            position=both.centers[..., 0, :],
            radius=torch.zeros_like(gap),
            second=body[..., 1],
            surface=plane,
            dropped=dropped,
            form=both.forms[..., 0, :, :],
            axis=table.shapes.lines[..., 0, :],
            lying=torch.zeros_like(which),
            meeting=Meeting(both, follows),
        )
