"""Steps that the compiled core has made one after the other, as it has them: states are made of that when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Generic

from torch import Tensor

from pbfd_torch.integrators.integrator import S
from pbfd_torch.native.core import Frames
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import mapped


@dataclass(frozen=True, eq=False)
class Stretch(Generic[S]):
    """Several steps, or frames.

    Attributes:
        began: when `[*batch]` [s].
        given: the core's fields of the state before the first, `[*batch, ...]`.
        found: those after each, `[steps, *batch, ...]`; other: what else states have, likewise: `time`, `hazards`, `pace`.
        solution: how each was solved.
        frames: what there is beside, where they are frames.
        restored: makes states of the fields and what else they have.
    """

    began: Tensor
    given: Mapping[str, Tensor]
    found: Mapping[str, Tensor]
    other: Mapping[str, Tensor]
    solution: Solution
    frames: Frames | None
    restored: Callable[[Mapping[str, Tensor], Mapping[str, Tensor]], S]

    def __len__(self) -> int:
        return len(self.solution.status)

    def part(self, first: int, last: int) -> Stretch[S]:
        """Steps first … last − 1 of them."""
        found, other = ({name: x[first:last] for name, x in some.items()} for some in (self.found, self.other))
        given = {name: x[first - 1] for name, x in self.found.items()} if first else self.given
        frames = None if self.frames is None else self.frames.part(first, last)
        began = self.other["time"][first - 1] if first else self.began
        return Stretch(began, given, found, other, mapped(lambda x: x[first:last], self.solution), frames, self.restored)

    @cached_property
    def states(self) -> S:
        """Those after each, `[steps, *batch, ...]`."""
        return self.restored(self.found, self.other)

    @cached_property
    def end(self) -> S:
        """The state after the last."""
        found, other = ({name: x[-1] for name, x in some.items()} for some in (self.found, self.other))
        return self.restored(found, other)
