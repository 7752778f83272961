"""Candidates between convex bodies of which one or both are cylinders or ellipsoids: these touch by support points, which move over
them as they turn (`terms.supported`), where polytopes have corners.

`manifold` finds where the bodies overlap, a polytope standing for the curved body. Of a cylinder the ends of that along its axis
are what counts: there its two rims are put, and the corners themselves hold it where it lies flat. An ellipsoid is its own support.

Of two round bodies that touch at one point nothing of that counts: they have one point more, where they come closest (`closest`).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.contact.approach import Swept
from pbfd_torch.contact.candidates import Slots
from pbfd_torch.contact.closest import Meeting, RoundShape, RoundTable, Sought
from pbfd_torch.contact.manifold import Manifold
from pbfd_torch.contact.polytope_pairs import POINTS, PolytopePairs
from pbfd_torch.tensors.constants import indices
from pbfd_torch.tensors.facts import fact
from pbfd_torch.tensors.vectors import dot, rotated

RIMS = 2
_SHORT = 1e-3  # of a cylinder's length: rims nearer to one another are one


@dataclass(frozen=True, eq=False)
class CurvedSlots(Slots):
    """Attributes:
    form: `[*batch, n, 3, 3]` M of the ellipsoid around each point, in its body's frame [m²].
    axis: `[*batch, n, 3]` of the rim that it belongs to, likewise.
    lying: `[*batch, n]`, see `shapes.Supports`.
    meeting: of those slots that follow both bodies; None where no slot of any world does.
    """

    form: Tensor
    axis: Tensor
    lying: Tensor
    meeting: Meeting | None


@dataclass(frozen=True, eq=False)
class _Found(Manifold):
    """Contact points, and of the pairs `[K]` what met at one point; None where none did."""

    meeting: Meeting | None


@dataclass(frozen=True, eq=False)
class CurvedPairs(PolytopePairs):
    """Pairs of convex bodies of which some are curved."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self._round

    @fact("polytopes", "first", "second", "frame")
    def _round(self) -> tuple[RoundTable, Tensor, Tensor] | None:
        """The pairs of two round shapes, the place `[m]` of each pair among them or −1, and which `[m]` are the other way round."""
        here = torch.eye(4, dtype=self.frame.dtype)
        shapes = [x.round and RoundShape(x.round, bool(x.flat.any()), here) for x in self.polytopes]
        pairs: list[tuple[RoundShape, RoundShape]] = []
        place, turned = [-1] * len(self.pair), [False] * len(self.pair)
        for k, (a, b) in enumerate(zip(self.first.tolist(), self.second.tolist(), strict=True)):
            one, other = shapes[a], shapes[b]
            if one and other:
                place[k], turned[k] = len(pairs), other.wide < one.wide
                pairs.append((other, one) if turned[k] else (one, other))
        if not pairs:
            return None
        device = self.frame.device
        return RoundTable.of(pairs, self.frame), indices(place, device), torch.tensor(turned, device=device)

    def _manifolds(self, poses: Tensor, world: Tensor, row: Tensor, moves: Tensor) -> tuple[Manifold, Tensor]:
        found, gap = super()._manifolds(poses, world, row, moves)
        shape, (turn, plane) = self._incident(row, found), self._sides(poses, world, row, found)
        curved, half = self.table.curved[shape], self.table.half[shape]
        along = torch.where(found.mask, found.point[..., 2], found.point[:, :1, 2])
        ends = torch.stack((along.amin(-1), along.amax(-1)), -1).clamp(-half[:, None], half[:, None])
        rims = torch.nn.functional.pad(ends[..., None], (2, 0))
        apart = torch.stack((curved, curved & (ends[:, 1] - ends[:, 0] > _SHORT * half)), -1)
        place = rotated(turn[:, None, :3, :3], rims) + turn[:, None, :3, 3]
        seen = rotated(plane[:, None, :3, :3].mT, place - plane[:, None, :3, 3])
        normal = rotated(turn[:, :3, :3].mT, rotated(plane[:, :3, :3], found.normal))  # in the frame of the curved body
        reach = dot(self.table.form[shape], normal.square()).sqrt()
        of_rims = dot(seen, found.normal[:, None]) - found.offset[:, None] - reach[:, None]
        held = found.mask & ~(curved & (half == 0))[:, None]
        whole = dataclasses.replace(found, point=torch.cat((found.point, rims), 1), mask=torch.cat((held, apart), 1))
        return self._met(poses, world, row, moves, whole, torch.cat((gap, of_rims), 1))

    def _met(
        self, poses: Tensor, world: Tensor, row: Tensor, moves: Tensor, found: Manifold, gap: Tensor
    ) -> tuple[Manifold, Tensor]:
        """Contact points and their gaps, with one point more of each pair where there are pairs that touch at one point: theirs,
        and no other of such a pair."""
        rest = _Found(**{field.name: getattr(found, field.name) for field in dataclasses.fields(found)}, meeting=None)
        if self._round is None:
            return rest, gap
        table, place, turned = self._round
        rows = (place[row] >= 0).nonzero().squeeze(-1)
        if len(rows) == 0:
            return rest, gap
        sides = torch.stack((self.first[row[rows]], self.second[row[rows]]), -1)
        swapped = turned[row[rows]]
        sides = torch.where(swapped[:, None], sides.flip(-1), sides)
        table = table.take(place[row[rows]])
        frames = poses[world[rows][:, None], sides][..., :3, :]
        sought = table.sought(frames)
        # what may come past the other body meets planes with all its corners, as polytopes do
        alone = (sought.alone & ~table.held(sought.gap, moves[rows])).nonzero().squeeze(-1)
        if len(alone) == 0:
            return rest, gap
        rows, table, sought = rows[alone], table.take(alone), Sought(*(x[alone] for x in sought))
        both, plane = table.met(frames[alone], sought)

        def put(values: Tensor, theirs: Tensor) -> Tensor:
            return values.index_put((rows,), theirs)

        none = torch.zeros_like(found.swapped)
        follows = put(none, torch.ones_like(swapped[alone]))
        single = follows[:, None]
        nowhere = torch.zeros_like(found.normal)[:, None].expand(-1, 2, 3)
        unit = torch.eye(3, dtype=gap.dtype, device=gap.device).expand(*nowhere.shape, 3)
        met = _Found(
            point=torch.cat((found.point, put(found.point[:, 0], both.centers[:, 0])[:, None]), 1),
            radius=put(found.radius, self.table.radius[sides[alone, 0]]),
            normal=put(found.normal, plane.normal),
            offset=put(found.offset, plane.offset),
            swapped=put(found.swapped, swapped[alone]),
            mask=torch.cat((found.mask & ~single, single), 1),
            meeting=Meeting(Swept(put(nowhere, both.centers), put(unit, both.forms), put(nowhere, both.lines)), follows),
        )
        return met, torch.cat((gap, put(gap[:, 0], sought.gap)[:, None]), 1)

    def _incident(self, row: Tensor, found: Manifold) -> Tensor:
        return torch.where(found.swapped, self.second[row], self.first[row])

    def _sides(self, poses: Tensor, world: Tensor, row: Tensor, found: Manifold) -> tuple[Tensor, Tensor]:
        """Poses of the bodies that give the points and the plane."""
        a, b = poses[world, self.first[row]], poses[world, self.second[row]]
        swapped = found.swapped[:, None, None]
        return torch.where(swapped, b, a), torch.where(swapped, a, b)

    def _of_points(self, slots: Slots, found: Manifold, points: Tensor, plane: Tensor, rows: Tensor, spot: Tensor) -> CurvedSlots:
        """With what is curved about them."""
        assert isinstance(found, _Found)
        filled = slots.filled

        def shaped(values: Tensor) -> Tensor:
            return values.reshape((*filled.shape, *values.shape[2:]))

        shape, rim = points[rows], spot >= POINTS
        turn = self.frame[shape][..., :3, :3]
        form = turn @ torch.diag_embed(self.table.form[shape] * rim[..., None]) @ turn.mT
        cylinder = self.table.curved[shape] & (self.table.half[shape] > 0) & (spot < POINTS + RIMS)
        lying = torch.where(cylinder, torch.where(rim, -1, 1), 0)
        meeting = found.meeting
        if meeting is not None:
            frames = self.frame[torch.stack((shape, plane[rows]), -1)][..., :3, :]
            both = Swept(meeting.both.centers[rows], meeting.both.forms[rows], meeting.both.lines[rows]).moved(frames)
            both = Swept(shaped(both.centers), shaped(both.forms), shaped(both.lines))
            meeting = Meeting(both, shaped(meeting.follows[rows] & (spot == POINTS + RIMS) & filled.reshape(spot.shape)))
        return self._curved(slots, shaped(form), shaped(turn[..., 2]), shaped(lying), meeting)

    def _empty_points(self, slots: Slots) -> CurvedSlots:
        """With nothing curved about them."""
        zero = torch.zeros_like(slots.position)
        return self._curved(slots, zero[..., None].expand(*zero.shape, 3), zero, torch.zeros_like(slots.pair), None)

    def _curved(self, slots: Slots, form: Tensor, axis: Tensor, lying: Tensor, meeting: Meeting | None) -> CurvedSlots:
        fields = {field.name: getattr(slots, field.name) for field in dataclasses.fields(slots)}
        return CurvedSlots(**fields, form=form, axis=axis, lying=lying, meeting=meeting)
