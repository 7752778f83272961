"""Candidates between convex bodies with flat faces: points of one against a plane of the other, by `manifold`.

The broad phase picks the pairs that may come near each other in the step; of these the direction of separation comes from closed
forms for boxes and from FCL for all others.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from pbfd_torch.contact.broad_phase import overlapping
from pbfd_torch.contact.candidates import Finder, Slots, nearest
from pbfd_torch.contact.manifold import Manifold, manifold
from pbfd_torch.contact.polytope import Polytope, PolytopeTable
from pbfd_torch.contact.separation import box_separation, fcl_geometries, fcl_separation
from pbfd_torch.contact.surface import Plane
from pbfd_torch.tensors.constants import indices
from pbfd_torch.tensors.facts import fact
from pbfd_torch.tensors.vectors import applied, dot, rotated

POINTS = 8  # of one pair at most


@dataclass(frozen=True, eq=False)
class PolytopePairs(Finder):
    """Attributes:
    pair: `[m]` the number of each pair.
    first, second: `[m]` their colliders.
    body, frame: `[c]`, `[c, 4, 4]` the body of each collider, and where its shape is in it.
    polytopes, table: the shapes `[c]`, and as tensors.
    boxes: `[m]` bool, pairs of two boxes.
    """

    pair: Tensor
    first: Tensor
    second: Tensor
    body: Tensor
    frame: Tensor
    polytopes: Sequence[Polytope]
    table: PolytopeTable
    boxes: Tensor

    @classmethod
    def of(
        cls,
        pairs: Sequence[tuple[int, int, int]],
        bodies: Sequence[int],
        frames: Tensor,
        polytopes: Sequence[Polytope],
        are_boxes: Sequence[bool],
        slots: int,
    ) -> Self:
        """From pairs (number, collider, collider); of each collider its body, its frame in it `[c, 4, 4]`, its shape, and whether
        that is a box."""
        device = frames.device
        first, second = indices([a for _, a, _ in pairs], device), indices([b for _, _, b in pairs], device)
        boxes = [are_boxes[a] and are_boxes[b] for _, a, b in pairs]
        return cls(
            pair=indices([k for k, _, _ in pairs], device),
            first=first,
            second=second,
            body=indices(bodies, device),
            frame=frames,
            polytopes=tuple(polytopes),
            table=PolytopeTable.stack(polytopes).to(frames.dtype, device),
            boxes=torch.tensor(boxes, device=device),
            slots=slots,
        )

    def __post_init__(self) -> None:
        _ = self._all_boxes, self._middle  # found here, so that no step has to wait for them

    @fact("polytopes")
    def _geometries(self) -> list[Any]:
        """FCL's shapes, which all worlds share; a copy in another process makes its own."""
        return fcl_geometries(self.polytopes)

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @fact("boxes")
    def _all_boxes(self) -> bool:
        return bool(self.boxes.all())

    def find(self, bodies: Tensor, ahead: Tensor, reach: Tensor) -> Slots:
        """See `Finder`."""
        batch = bodies.shape[:-3]
        poses = bodies[..., self.body, :, :] @ self.frame
        vertices = applied(poses[..., None, :3, :3], self.table.vertices) + poses[..., None, :3, 3]
        room = (self.table.radius + reach[..., self.body])[..., None]
        near = overlapping(vertices.amin(-2) - room, vertices.amax(-2) + room, self.first, self.second)
        world, row = near.reshape(-1, len(self.pair)).nonzero().unbind(-1)
        poses, reach = poses.flatten(0, -4) if batch else poses[None], reach.reshape(-1, reach.shape[-1])
        a, b = self.first[row], self.second[row]
        moves = reach[world, self.body[a]] + reach[world, self.body[b]]
        found, gap = self._manifolds(poses, world, row, moves)
        points = torch.where(found.swapped, b, a)
        plane = torch.where(found.swapped, a, b)
        within = found.mask & (gap < moves[:, None])
        return self._slots(batch, world, row, found, points, plane, gap, within)

    @fact("polytopes", "frame", "first", "second")
    def _middle(self) -> Tensor:
        """`[m]` half the thickness of the thinner one of each pair [m]."""
        thickness = self.frame.new_tensor([x.thickness for x in self.polytopes])
        return 0.5 * torch.minimum(thickness[self.first], thickness[self.second])

    def _manifolds(self, poses: Tensor, world: Tensor, row: Tensor, moves: Tensor) -> tuple[Manifold, Tensor]:
        """Contact points of pairs `row` `[k]` in worlds `[k]` that move so far `[k]` [m], and the gap of each `[k, POINTS]`."""
        a, b = self.first[row], self.second[row]
        pose_a, pose_b = poses[world, a], poses[world, b]
        boxes = self.boxes[row]
        if self._all_boxes:
            apart = box_separation(self.table, a, b, pose_a, pose_b)
            normal, distance = apart.normal, apart.distance
        else:
            normal, distance = torch.empty_like(pose_a[:, :3, 3]), torch.empty_like(pose_a[:, 0, 0])
            for which, separation in ((boxes, box_separation), (~boxes, self._by_fcl)):
                some = which.nonzero().squeeze(-1)
                if len(some):
                    apart = separation(self.table, a[some], b[some], pose_a[some], pose_b[some])
                    normal[some], distance[some] = apart.normal, apart.distance
        # apart, and perhaps past the middle of the thinner one at the end: whatever corner turns round meets the plane as well
        whole = (distance > self._middle[row]) & (moves > distance + self._middle[row])
        found = manifold(self.table, a, b, pose_a, pose_b, normal, whole, POINTS)
        swapped = found.swapped[:, None, None]
        points, plane = torch.where(swapped, pose_b, pose_a), torch.where(swapped, pose_a, pose_b)
        place = rotated(points[:, None, :3, :3], found.point) + points[:, None, :3, 3]
        seen = rotated(plane[:, None, :3, :3].mT, place - plane[:, None, :3, 3])
        gap = dot(seen, found.normal[:, None]) - found.offset[:, None] - found.radius[:, None]
        return found, gap

    def _by_fcl(self, table: PolytopeTable, a: Tensor, b: Tensor, pose_a: Tensor, pose_b: Tensor) -> Any:
        return fcl_separation(table, self._geometries, a, b, pose_a, pose_b)

    def _slots(
        self,
        batch: tuple[int, ...],
        world: Tensor,
        row: Tensor,
        found: Manifold,
        points: Tensor,
        plane: Tensor,
        gap: Tensor,
        within: Tensor,
    ) -> Slots:
        """The contact points of rows in their worlds' slots."""
        worlds = math.prod(batch)
        if len(row) == 0:
            return self._empty(batch)
        # rows of one world stand together: their places among them lead to a padded table [worlds, most, POINTS]
        count = (world == torch.arange(worlds, device=row.device)[:, None]).sum(-1)
        most, points_of_pair = int(count.max()), gap.shape[-1]
        order = torch.arange(len(row), device=row.device) - (count.cumsum(0) - count)[world]
        index = torch.zeros((worlds, most), dtype=torch.long, device=row.device)
        index[world, order] = torch.arange(len(row), device=row.device)
        there = torch.arange(most, device=row.device) < count[:, None]
        picked = index.reshape(-1)
        gaps = gap[picked].reshape(worlds, -1)
        real = (within[picked].reshape(worlds, most, points_of_pair) & there[..., None]).reshape(worlds, -1)
        which, filled, dropped = nearest(gaps, real, self.slots)
        rows = index.gather(-1, which // points_of_pair)
        spot = which % points_of_pair

        def shaped(values: Tensor) -> Tensor:
            return values.reshape((*batch, *values.shape[1:]))

        frame_of_points, frame_of_plane = self.frame[points[rows]], self.frame[plane[rows]]
        position = rotated(frame_of_points[..., :3, :3], found.point[rows, spot]) + frame_of_points[..., :3, 3]
        normal = rotated(frame_of_plane[..., :3, :3], found.normal[rows])
        offset = found.offset[rows] + dot(normal, frame_of_plane[..., :3, 3])
        slots = Slots(
            filled=shaped(filled),
            pair=shaped(self.pair[row[rows]]),
            first=shaped(self.body[points[rows]]),
            position=shaped(position),
            radius=shaped(found.radius[rows]),
            second=shaped(self.body[plane[rows]]),
            surface=Plane(shaped(normal), shaped(offset)),
            dropped=shaped(dropped),
        )
        return self._of_points(slots, found, points, plane, rows, spot)

    def _of_points(self, slots: Slots, found: Manifold, points: Tensor, plane: Tensor, rows: Tensor, spot: Tensor) -> Slots:
        """The slots with what else there is to say about them: they hold the points `spot` of the `rows` of what was found, all
        `[worlds, n]`; of the rows the shapes that give the points and the plane."""
        return slots

    def _empty(self, batch: tuple[int, ...]) -> Slots:
        zero = self.frame.new_zeros((*batch, self.slots))
        none = zero > 0
        number = torch.zeros_like(none, dtype=torch.long)
        up = torch.nn.functional.pad(torch.ones_like(zero)[..., None], (2, 0))
        position = zero[..., None].expand(*zero.shape, 3)
        first, second = number + self.body[self.first[:1]], number + self.body[self.second[:1]]
        slots = Slots(none, number, first, position, zero, second, Plane(up, zero), none[..., 0])
        return self._empty_points(slots)

    def _empty_points(self, slots: Slots) -> Slots:
        """Empty slots with what else there is to say about them."""
        return slots
