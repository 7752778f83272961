"""Steps that the compiled core has made one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

from pbfd_torch.integrators.integrator import S
from pbfd_torch.native.core import Frames
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import mapped


@dataclass(frozen=True, eq=False)
class Stretch(Generic[S]):
    """Several steps, or frames.

    Attributes:
        before: the state before the first.
        states: those after each, `[steps, *batch, ...]`.
        solution: how each was solved, likewise.
        frames: what there is beside, where they are frames.
    """

    before: S
    states: S
    solution: Solution
    frames: Frames | None = None

    def __len__(self) -> int:
        return len(self.solution.status)

    def part(self, first: int, last: int) -> Stretch[S]:
        """Steps first … last − 1 of them."""
        states, solution = (mapped(lambda x: x[first:last], whole) for whole in (self.states, self.solution))
        before = mapped(lambda x: x[first - 1], self.states) if first else self.before
        return Stretch(before, states, solution, None if self.frames is None else self.frames.part(first, last))

    @property
    def end(self) -> S:
        """The state after the last."""
        end: S = mapped(lambda x: x[-1], self.states)
        return end
