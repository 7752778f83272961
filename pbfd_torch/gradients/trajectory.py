"""Trajectories that carry derivatives: the configurations and velocities of a rollout as functions of all that they depend on.

A step's node of the graph keeps the state that it set out from. With checkpoints every k steps only every k-th state is kept, and
the steps between are made again, to the same bits, when derivatives are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, cast

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.implicit import Gradients
from pbfd_torch.gradients.linked import Engine, Linked, Made, Play, doubts_of
from pbfd_torch.gradients.walks import Walk, Walker
from pbfd_torch.integrators.integrator import S
from pbfd_torch.solvers.objective import is_solved
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.tensors.plain import carries
from pbfd_torch.tensors.structures import tensors_of

AT_ONCE = 16384  # steps of worlds that are one node, so that progress is told of now and then


@dataclass(frozen=True, eq=False)
class Trajectory(Generic[S]):
    """`T` steps, time first.

    Attributes:
        q: `[T + 1, *batch, nq]`.
        v: `[T + 1, *batch, nv]` as the integrator reports it.
        end: the state after the last step, to go on from.
        status: `[T, *batch]` values of `Status`.
    """

    q: Tensor
    v: Tensor
    end: S
    status: Tensor
    _made: tuple[Sequence[Made] | Walk, ...] = ()  # those of a checkpoint's steps once they were retraced

    @property
    def solved(self) -> Tensor:
        """`[T, *batch]` bool."""
        return is_solved(self.status)

    @property
    def doubts(self) -> Tensor:
        """`[T, *batch]` bits of `Doubt`: what may be wrong with the derivatives of each step. Singular ones are known once
        derivatives were asked for."""
        known = doubts_of(self.status)
        found = [x for some in self._made for x in (some.doubts if isinstance(some, Walk) else [made.doubts for made in some])]
        return known if len(found) < len(known) else known | torch.stack(found)


class _Segment(Play[S]):
    """Some steps; their node keeps the state before the first of them only."""

    def __init__(self, linked: Linked[S], start: S, controls: Tensor | None, steps: int) -> None:
        super().__init__(linked, start, controls)
        self._steps = steps
        self.made: list[Made] = []
        self.status: list[Tensor] = []

    def first(self, stepper: EagerStepper[S], start: S, control: Tensor | None) -> Any:
        """See `Play`: configurations and velocities after every step, and the last state."""
        states, maker = [start], self.linked.maker(stepper, start)
        for k in range(self._steps):
            end, solution, _ = maker.made(states[-1], None if control is None else control[k])
            states.append(end)
            self.status.append(solution.status)
        return _seen(stepper, states)

    def again(self, stepper: EagerStepper[S], start: S, control: Tensor | None) -> Any:
        """See `Play`."""
        states, linked = [start], Linked(stepper, self.linked.gradients, self.linked.engine)
        self.made.clear()
        for k in range(self._steps):
            end, made = linked.step(states[-1], None if control is None else control[k])
            states.append(end)
            self.made.append(made)
        return _seen(stepper, states)


def _seen(stepper: EagerStepper[S], states: list[S]) -> tuple[Tensor, Tensor, S]:
    """Configurations and velocities of all states but the first, and the last one."""
    a, dt = stepper.articulation, stepper.step_size
    v = [stepper.integrator.velocity(a, state, dt) for state in states[1:]]
    return torch.stack([state.q for state in states[1:]]), torch.stack(v), states[-1]


def trajectory(
    stepper: EagerStepper[S],
    gradients: Gradients,
    engine: Engine,
    state: S,
    controls: Tensor | None,
    steps: int | None,
    checkpoint: int,
    progress: Callable[[int], object] | None,
) -> Trajectory[S]:
    """See `Simulator.trajectory`."""
    if checkpoint < 1:
        raise InputError(f"checkpoint is {checkpoint}: must be a number of steps ≥ 1")
    count = stepper.scene.step_count(controls, steps)
    linked = Linked(stepper, gradients, engine)
    carrying = linked.carry(state, controls)
    given = tensors_of([state, controls, *linked.leaves])
    if any(carries(x) and not x.requires_grad for x in given):
        checkpoint = 1  # forward derivatives keep nothing, so there is nothing to save
    walker = Walker.of(linked, state, controls) if carrying else None
    q, v = [state.q[None]], [stepper.integrator.velocity(stepper.articulation, state, stepper.step_size)[None]]
    status: list[Tensor] = []
    kept: list[Sequence[Made] | Walk] = []
    length = checkpoint if walker is None or checkpoint > 1 else max(1, AT_ONCE // max(1, state.time.numel()))
    for k in range(0, count, length):
        size = min(length, count - k)
        held = None if controls is None else controls[k : k + size]
        if walker is not None:
            reached, walk = walker.walk(state, held, size, kept=checkpoint == 1)
            seen = [reached.q, stepper.integrator.velocity(stepper.articulation, reached, stepper.step_size)]
            state = cast(S, mapped(lambda x: x[-1], reached))
            status += walk.solution.status
            kept.append(walk)
        elif carrying and checkpoint > 1:
            segment = _Segment(linked, state, held, size)
            *seen, state = segment.perform(state, held)
            status += segment.status
            kept.append(segment.made)
        else:
            states = [state]
            for i in range(size):
                now = None if held is None else held[i]
                if carrying:
                    end, made = linked.step(states[-1], now)
                    solution = made.solution
                    kept.append([made])
                else:
                    end, solution, _ = linked.maker(stepper, state).made(states[-1], now)
                states.append(end)
                status.append(solution.status)
            *seen, state = _seen(stepper, states)
        q.append(seen[0])
        v.append(seen[1])
        if progress is not None:
            progress(k + size)
    return Trajectory(torch.cat(q), torch.cat(v), state, torch.stack(status), tuple(kept))
