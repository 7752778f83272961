"""What the candidates of each link have in common: its pose, and sums over them. No atomics, and no matrix per candidate."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.tensors.constants import indices


class Grouping:
    """Candidates in rows, one row a link that has any. `link` `[n]`: whose each candidate is; the host reads it and lays the rows
    out, so that no step has to wait for that."""

    def __init__(self, link: Tensor) -> None:
        of_link: dict[int, list[int]] = {}
        for k, owner in enumerate(link.tolist()):
            of_link.setdefault(owner, []).append(k)
        members = list(of_link.values())
        width = max(map(len, members))
        self._link = link
        self._count = len(members)
        self._links = indices(list(of_link), link.device)  # whose each row is [nrow]
        # 1 where a candidate stands, 0 in the places left over, [nrow, 1, width]
        there = [[True] * len(row) + [False] * (width - len(row)) for row in members]
        self._there = torch.tensor(there, device=link.device)[:, None]
        self._layout = None if members == _in_turn(len(members), width) else _layout(members, width, link)

    def _coordinates(self, values: Tensor) -> Tensor:
        """`[*, n, k] → [*, k, nrow, width]`."""
        if self._layout is None:
            return values.mT.unflatten(-1, (self._count, -1))
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
        return of_links.mT[..., self._link].mT

    def products(self, left: Tensor, right: Tensor) -> Tensor:
        """Σ l rᵀ over the candidates of each of the `rows`, `[*, nrow, width, r], [*, nrow, width, c] → [*, nrow, r, c]`."""
        return (left.mT if self._layout is None else left.mT * self._there.to(left.dtype)) @ right

    def sums(self, values: Tensor) -> Tensor:
        """Sums over the candidates of each row, `[*, n, k] → [*, nrow, k]`."""
        rows = values.unflatten(-2, (self._count, -1)) if self._layout is None else values[..., self._layout[0], :]
        there = self._there.to(rows.dtype)
        return (there.expand(*rows.shape[:-3], *there.shape) @ rows).squeeze(-2)

    def spread(self, of_rows: Tensor, links: int) -> Tensor:
        """Each row to its link, zero for the others: `[*, nrow, r, c] → [*, links, r, c]`."""
        touched = self._links
        place = (torch.arange(links, device=touched.device)[:, None] == touched).to(of_rows.dtype)
        place = place.expand(*of_rows.shape[:-3], *place.shape)
        return (place @ of_rows.flatten(-2)).unflatten(-1, of_rows.shape[-2:])


def _in_turn(count: int, width: int) -> list[list[int]]:
    """Rows of candidates as they come."""
    return [list(range(k * width, (k + 1) * width)) for k in range(count)]


def _layout(members: list[list[int]], width: int, link: Tensor) -> tuple[Tensor, Tensor]:
    """Which candidate stands where `[nrow, width]`, a row's first one in the places left over, and where each of them is found in
    the flattened rows `[n]`."""
    order = torch.tensor([row + [row[0]] * (width - len(row)) for row in members], device=link.device)
    place = {k: i * width + j for i, row in enumerate(members) for j, k in enumerate(row)}
    return order, indices([place[k] for k in range(len(link))], link.device)
