"""What the candidates of each link have in common: its pose, and sums over them. No atomics, and no matrix per candidate."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Grouping:
    """Candidates in rows, one row a link that has any. `link` `[n]`: whose each candidate is."""

    link: Tensor

    @cached_property
    def _members(self) -> list[list[int]]:
        of_link: dict[int, list[int]] = {}
        for k, link in enumerate(self.link.tolist()):
            of_link.setdefault(link, []).append(k)
        return list(of_link.values())

    @cached_property
    def _layout(self) -> tuple[Tensor, Tensor] | None:
        """Which candidate stands where `[nrow, width]`, its first one in the places left over, and where each of them is found in
        the flattened rows `[n]`; None: as they come."""
        members = self._members
        width = max(map(len, members))
        if members == [list(range(k * width, (k + 1) * width)) for k in range(len(members))]:
            return None
        order = torch.tensor([row + [row[0]] * (width - len(row)) for row in members], device=self.link.device)
        place = {k: i * width + j for i, row in enumerate(members) for j, k in enumerate(row)}
        return order, torch.tensor([place[k] for k in range(len(self.link))], device=self.link.device)

    @cached_property
    def _there(self) -> Tensor:
        """1 where a candidate stands, 0 in the places left over, `[nrow, 1, width]`."""
        width = max(map(len, self._members))
        there = [[1.0] * len(row) + [0.0] * (width - len(row)) for row in self._members]
        return torch.tensor(there, device=self.link.device)[:, None]

    @cached_property
    def _links(self) -> Tensor:
        """Whose each row is `[nrow]`."""
        return self.link[torch.tensor([row[0] for row in self._members], device=self.link.device)]

    def _coordinates(self, values: Tensor) -> Tensor:
        """`[*, n, k] → [*, k, nrow, width]`."""
        if self._layout is None:
            return values.mT.unflatten(-1, (len(self._members), -1))
        return values.mT[..., self._layout[0]]

    def rows(self, values: Tensor) -> Tensor:
        """`[*, n, k] → [*, nrow, width, k]`, coordinate by coordinate in memory; what is in places left over does not count."""
        return self._coordinates(values).transpose(-3, -2).contiguous().mT

    def mapped(self, matrices: Tensor, points: Tensor) -> Tensor:
        """M p̄ with the M of each candidate's link, `[*, nlink, 3 or 4, 4], [*, n, 3] → [*, n, 3]`, coordinate by coordinate in
        memory."""
        columns = matrices[..., self._links, :3, :].transpose(-3, -2).movedim(-1, 0).contiguous()[..., None]
        x, y, z = self._coordinates(points).contiguous().split(1, -3)
        rows = torch.addcmul(columns[3], columns[0], x)
        rows = torch.addcmul(torch.addcmul(rows, columns[1], y), columns[2], z).flatten(-2)
        return (rows if self._layout is None else rows[..., self._layout[1]]).mT

    def picked(self, of_links: Tensor) -> Tensor:
        """To each candidate what its link has, `[*, nlink, k] → [*, n, k]`, coordinate by coordinate in memory."""
        return of_links.mT[..., self.link].mT

    def products(self, left: Tensor, right: Tensor) -> Tensor:
        """Σ l rᵀ over the candidates of each of the `rows`, `[*, nrow, width, r], [*, nrow, width, c] → [*, nrow, r, c]`."""
        return (left.mT if self._layout is None else left.mT * self._there.to(left.dtype)) @ right

    def sums(self, values: Tensor) -> Tensor:
        """Sums over the candidates of each row, `[*, n, k] → [*, nrow, k]`."""
        rows = values.unflatten(-2, (len(self._members), -1)) if self._layout is None else values[..., self._layout[0], :]
        there = self._there.to(rows.dtype)
        return (there.expand(*rows.shape[:-3], *there.shape) @ rows).squeeze(-2)

    def spread(self, of_rows: Tensor, links: int) -> Tensor:
        """Each row to its link, zero for the others: `[*, nrow, r, c] → [*, links, r, c]`."""
        touched = self._links
        place = (torch.arange(links, device=touched.device)[:, None] == touched).to(of_rows.dtype)
        place = place.expand(*of_rows.shape[:-3], *place.shape)
        return (place @ of_rows.flatten(-2)).unflatten(-1, of_rows.shape[-2:])
