"""Round bodies where they come closest: the normal turns with both of them, and so does the point that touches.

The depth is d = −gap(n) with n from `contact.approach`. As n makes the gap the largest, the depth answers a motion as if n stayed:
∂gap/∂W = n · (the velocity of the body at p). The force acts at the first body's nearest point, p = c + s with s = −M n/h − μ l,
and the slip is that of the material of both bodies there, as in `supported`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pbfd_torch.contact.approach import Approach
from pbfd_torch.contact.closest import Meeting
from pbfd_torch.tensors.vectors import cross, outer, rows
from pbfd_torch.terms.supported import Supported
from pbfd_torch.terms.touching import shifting
from pbfd_torch.tree.rotations import skew

_STEPS = 5  # of Newton's method, from the direction at the start of the step


@dataclass(frozen=True, eq=False, kw_only=True)
class Approaching(Supported):
    """Attributes:
    approach: both bodies, seen along n.
    slide: μ `[*, n]` [m] of the first one.
    follows: `[*, n]` bool; the others are beside planes, as `Supported` says.
    """

    approach: Approach
    slide: Tensor
    follows: Tensor

    @staticmethod
    def beside(planes: Supported, meeting: Meeting, frames: Tensor, raised: Tensor) -> Approaching:
        """Of bodies at `frames` `[*, n, 2, 3, 4]`, where planes between them stand like this, and what solids are moved out by
        `[*, n]` [m]."""
        found, slides = closest_approach(meeting, frames, planes.normal)
        follows = meeting.follows
        fields = {field.name: getattr(planes, field.name) for field in dataclasses.fields(Supported)}
        return Approaching(
            **(fields | {"normal": found.normal, "depth": torch.where(follows, raised - found.gap, planes.depth)}),
            approach=found,
            slide=torch.where(follows, slides[..., 0], 0.0),
            follows=follows,
        )

    @property
    def _line(self) -> Tensor:
        return self.approach.of.lines[..., 0, :]

    @cached_property
    def arm(self) -> Tensor:
        """s `[*, n, 3]` [m]."""
        return super().arm - self.slide[..., None] * self._line

    @cached_property
    def _swings(self) -> Tensor:
        """∂(−μ l)/∂W `[*, n, 3, 6]` as the line turns."""
        by_turn = self.slide[..., None, None] * skew(self._line)
        return torch.cat((by_turn, torch.zeros_like(by_turn)), -1)

    @cached_property
    def _answers(self) -> tuple[Tensor, Tensor]:
        """∂n/∂W `[*, n, 3, 6]`, ∂μ/∂W `[*, n, 6]`."""
        by_turn, reach = self._spread_slope, self._reach[..., None]
        longer = 0.5 * rows(self.normal, by_turn) / reach
        nearest = (outer(self._spread, longer) / reach[..., None] - by_turn) / reach[..., None]
        leans = torch.nn.functional.pad(cross(self._line, self.normal)[..., None, :], (0, 3, 0, 1))
        tilt, slides = self.approach.answer(self.shift + nearest + self._swings, leans)
        follows = self.follows[..., None]
        return torch.where(follows[..., None], tilt, 0.0), torch.where(follows, slides[..., 0, :], 0.0)

    @cached_property
    def tilt(self) -> Tensor:
        """See `Touching`."""
        return self._answers[0]

    @cached_property
    def _arm_slope(self) -> Tensor:
        return super()._arm_slope + self._swings - outer(self._line, self._answers[1])

    @cached_property
    def sinks(self) -> Tensor:
        """See `Touching`."""
        return torch.where(self.follows[..., None], rows(self.normal, shifting(self.points)), super().sinks)


def closest_approach(meeting: Meeting, frames: Tensor, start: Tensor) -> tuple[Approach, Tensor]:
    """Where bodies at `frames` `[*, n, 2, 3, 4]` come closest near these directions `[*, n, 3]`, and μ `[*, n, 2]` [m]; where
    nothing follows, along the direction itself."""
    found, slides = Approach(meeting.both.moved(frames), start).closest(_STEPS)
    return Approach(found.of, torch.where(meeting.follows[..., None], found.normal, start)), slides
