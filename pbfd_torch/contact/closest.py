"""Where round shapes come closest, and whether they touch there at one point.

A shape is one ellipsoid, or the hull of two equal ones on its axis (`shapes.Rim`): it touches with the one, with the other, or with
what lies between, one ellipsoid swept along the axis. For every choice of both shapes `approach` finds a direction. The gap of the
whole shapes along any direction is never more than their signed distance, so the direction with the largest gap is the right one.

The caps of cylinders are flat, and cylinders may lie side by side: there shapes touch along a face or a line.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from pbfd_torch.contact.approach import Approach, Swept
from pbfd_torch.contact.shapes import Rim
from pbfd_torch.contact.surface import Plane
from pbfd_torch.tensors.vectors import axis, dot, rotated, unit

_STEPS = 8  # of Newton's method, from a direction that only knows the forms
_SOFT = (0.05, 1.0)  # of the forms' size, which is added to them for two such directions: rims are thin
_FLAT = 0.02  # [rad] between a cap's normal and the direction, under which the cap is what touches
_PARALLEL = 1e-2  # sine of the angle between axes under which shapes lie side by side


class RoundShape(NamedTuple):
    """A round shape: its ellipsoids, whether it has flat caps, and where it is `[4, 4]`."""

    rim: Rim
    capped: bool
    frame: Tensor

    @property
    def thin(self) -> float:
        """Half its thickness [m]."""
        x, y, z = self.rim.form
        return min(x**0.5, y**0.5, z**0.5 + self.rim.half)

    @property
    def wide(self) -> float:
        """The largest semi-axis of its ellipsoids [m]: of two shapes the less wide one rolls on the other, and goes first."""
        return max(self.rim.form) ** 0.5


class Sought(NamedTuple):
    """Of every pair the `gap` `[*, m]` [m], along which `normal` `[*, m, 3]`, out of which ellipsoids `height` `[*, m, 2]`, and
    whether it touches at one point, `alone` `[*, m]`."""

    gap: Tensor
    normal: Tensor
    height: Tensor
    alone: Tensor


@dataclass(frozen=True, eq=False)
class Meeting:
    """Where bodies come closest. `both`: `[*, n]` the bodies in their frames; where there is a line, the nearest point of it is the
    centre. `follows`: `[*, n]` bool, where the normal turns with both of them, and is not that of a plane."""

    both: Swept
    follows: Tensor


@dataclass(frozen=True, eq=False)
class RoundTable:
    """Pairs of round shapes.

    Attributes:
        shapes: `[m]` the ellipsoids in their middles, with lines along the axes, in the frames that they are given in.
        half: `[m, 2]` [m] how far from there they go.
        thin: `[m]` [m] half the thickness of the thinner one.
        capped: `[m, 2]` bool.
        height: `[m, c, 2]` what each choice takes: 0: the ellipsoid swept; −1, 1: one at an end. Some are there twice.
    """

    shapes: Swept
    half: Tensor
    thin: Tensor
    capped: Tensor
    height: Tensor

    @staticmethod
    def of(pairs: Sequence[tuple[RoundShape, RoundShape]], like: Tensor) -> RoundTable:
        """`like`: dtype and device."""
        heights = [list(itertools.product(*[(0, -1, 1) if x.rim.half else (0,) for x in both])) for both in pairs]
        most = max(map(len, heights))
        frames = torch.stack([torch.stack([x.frame[:3] for x in both]) for both in pairs]).to(like)
        forms = torch.diag_embed(like.new_tensor([[x.rim.form for x in both] for both in pairs]))
        here = Swept(torch.zeros_like(frames[..., 3]), forms, axis(2, frames[..., 3]).expand_as(frames[..., 3]))
        return RoundTable(
            shapes=here.moved(frames),
            half=like.new_tensor([[x.rim.half for x in both] for both in pairs]),
            thin=like.new_tensor([min(x.thin for x in both) for both in pairs]),
            capped=torch.tensor([[x.capped for x in both] for both in pairs], device=like.device),
            height=like.new_tensor([[*some, *[some[0]] * (most - len(some))] * len(_SOFT) for some in heights]),
        )

    def take(self, pairs: Tensor) -> RoundTable:
        """The table of some pairs `[*, n]`."""
        shapes = Swept(self.shapes.centers[pairs], self.shapes.forms[pairs], self.shapes.lines[pairs])
        return RoundTable(shapes, self.half[pairs], self.thin[pairs], self.capped[pairs], self.height[pairs])

    def sought(self, frames: Tensor) -> Sought:
        """Of all pairs, which stand at `frames` `[*, m, 2, 3, 4]`; without derivatives."""
        with torch.no_grad():
            whole = self.shapes.moved(frames)
            spread = Swept(whole.centers[..., None, :, :], whole.forms[..., None, :, :, :], whole.lines[..., None, :, :])
            choices = _chosen(spread, self.half[..., None, :], self.height)
            found, _ = Approach(choices, _first(choices)).closest(_STEPS)
            normals = torch.cat((found.normal, whole.lines, -whole.lines), -2)
            along = dot(spread.lines, normals[..., None, :]).abs()
            gaps = Approach(spread, normals).gap - dot(self.half[..., None, :], along)
            count = self.height.shape[-2]
            gap, choice = gaps[..., :count].max(-1, keepdim=True)
            cap = torch.where(torch.cat((self.capped, self.capped), -1), gaps[..., count:], -torch.inf).amax(-1)

            def of_choice(values: Tensor) -> Tensor:
                return values.expand(*choice.shape[:-1], *values.shape[-2:]).take_along_dim(choice[..., None], -2).squeeze(-2)

            height = of_choice(self.height)
            flat = (self.capped & (of_choice(along) > 1 - 0.5 * _FLAT**2)).any(-1)
            sides = ((height == 0) & (self.half > 0)).all(-1)
            beside = 1 - dot(whole.lines[..., 0, :], whole.lines[..., 1, :]).square() < _PARALLEL**2
            gap = gap.squeeze(-1)
            return Sought(gap, of_choice(normals), height, (gap >= cap) & ~flat & ~(sides & beside))

    def held(self, gap: Tensor, moves: Tensor) -> Tensor:
        """Which pairs come so far `[*, m]` [m] that they may be past each other's middle, where these gaps lie between them."""
        return (gap > 0) & (moves > gap + self.thin)

    def met(self, frames: Tensor, found: Sought) -> tuple[Swept, Plane]:
        """Both ellipsoids of every pair in their frames, where there is a line about the nearest point of it, and the plane that
        touches the second one."""
        here = _chosen(self.shapes, self.half, found.height)
        seen, slides = Approach(here.moved(frames), found.normal).nearer()
        along = torch.stack((-slides[..., 0], slides[..., 1]), -1)
        both = Swept(here.centers + along[..., None] * here.lines, here.forms, here.lines)
        normal = rotated(frames[..., 1, :, :3].mT, seen.normal)
        return both, Plane(normal, dot(normal, both.centers[..., 1, :]) + seen.reaches[..., 1])


def _chosen(whole: Swept, half: Tensor, height: Tensor) -> Swept:
    """Of shapes with these half lengths the ellipsoids at these heights, all `[*, 2]`."""
    lines = torch.where(((height == 0) & (half > 0))[..., None], whole.lines, 0.0)
    return Swept(whole.centers + (height * half)[..., None] * whole.lines, whole.forms, lines)


def _first(both: Swept) -> Tensor:
    """Directions between shapes `[*, m, c, 3]` to begin with: normals of ellipsoids about as large as both, where these are on the
    way from the one to the other. The choices are there once for each softness."""
    forms = both.forms.sum(-3)
    size = forms.diagonal(dim1=-2, dim2=-1).sum(-1)
    between = both.centers[..., 0, :] - both.centers[..., 1, :]
    times = between.shape[-2] // len(_SOFT)
    soft = torch.cat([size.new_full((times,), x) for x in _SOFT]) * size
    a, b, c = (forms + torch.diag_embed(soft[..., None].expand_as(between))).unbind(-1)
    sides = [dot(torch.linalg.cross(x, y), between) for x, y in ((b, c), (c, a), (a, b))]
    return unit(torch.stack(sides, -1) / size.square()[..., None], axis(2, between))[0]
