"""Stretches of steps as one node of the graph of derivatives, where an engine follows its steps back itself (`Descending`).

The node keeps how the steps were made, or, between checkpoints, what they set out from: then they are made once more. One call
goes back through all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, cast

import torch
from torch import Tensor

from pbfd_torch.errors import GradientError
from pbfd_torch.gradients.implicit import Doubt, Doubtful
from pbfd_torch.gradients.linked import NO_SECOND, Linked, complain, doubts_of
from pbfd_torch.gradients.parts import precise
from pbfd_torch.integrators.integrator import S
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.stepping.descending import Descending, Numbers, Walked
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.tensors.plain import carries, changes, primal, wrapped
from pbfd_torch.tensors.shapes import spread
from pbfd_torch.tensors.structures import mapped_tensors, tensors_of
from pbfd_torch.tensors.worlds import replaced


@dataclass(eq=False)
class Walk:
    """Several steps that carry derivatives.

    Attributes:
        solution: how each was solved, `[steps, *batch]`. doubts: `[steps, *batch]` int, bits of `Doubt`.
    """

    solution: Solution
    doubts: Tensor


class Walker(Generic[S]):
    """Makes the steps of a `Linked` stepper and follows them back. Only where `Walker.of` gives one."""

    def __init__(self, linked: Linked[S], maker: Descending[S], back: Descending[S], numbers: Numbers | None) -> None:
        self.gradients, self.maker, self.back = linked.gradients, maker, back
        self.known = () if numbers is None else (numbers.shared, numbers.own, numbers.step_size)

    @property
    def numbered(self) -> bool:
        """Whether the steps depend on the engine's numbers as on the state."""
        return bool(self.known)

    @classmethod
    def of(cls, linked: Linked[S], state: S, controls: Tensor | None) -> Walker[S] | None:
        """Of a stepper whose engine follows these steps back, by all that carries derivatives: by autograd, and exactly."""
        # the engine adapts terms itself
        active = [x for x in tensors_of(replaced(linked.parts, adapted=())) if carries(x) or wrapped(x)]
        given = [*tensors_of([state, controls]), *active]
        if linked.gradients.blur is not None or any(map(wrapped, given)):
            return None
        if any(map(changes, given)) and any(x.requires_grad for x in given):
            return None  # both ways at once
        plain = linked.plain([primal(linked.leaves[k]) for k in linked.active])
        maker = linked.maker(plain, state)
        if not isinstance(maker, Descending) or not maker.descends:
            return None
        wide = precise(plain)
        if not active:
            back = maker if wide is plain else linked.engine(wide)
            return cls(linked, maker, back, None) if isinstance(back, Descending) else None
        if not _known(linked, maker, wide):
            return None
        known = maker.precise(precise(linked.stepper), wide)
        return None if known is None else cls(linked, maker, *known)

    def walk(self, state: S, controls: Tensor | None, steps: int, kept: bool = True) -> tuple[S, Walk]:
        """The states after each of so many steps, `[steps, *batch, ...]`, and how they were made; kept: the node keeps that, and
        does not make them once more."""
        given = self.maker.fields(state)
        controls = None if controls is None else spread(controls, state.time.shape)
        node = _Node(self, state, controls, steps, kept)
        values = [*given.values(), *([] if controls is None else [controls]), *self.known]
        found = dict(zip(given, _Walk.apply(node, *values), strict=True))  # type: ignore[no-untyped-call]
        return self.maker.restored(state, found, node.other), node.walk


def stepped(linked: Linked[S], state: S, control: Tensor | None) -> tuple[S, Solution]:
    """One step, that carries derivatives, under a control `[*batch, nu]`."""
    held = None if control is None else control[None]
    walker = Walker.of(linked, state, held)
    if walker is None:
        end, made = linked.step(state, control)
        return end, made.solution
    states, walk = walker.walk(state, held, 1)
    end, solution = (mapped(lambda x: x[0], x) for x in (states, walk.solution))
    return cast(S, end), cast(Solution, solution)


def _known(linked: Linked[Any], maker: Descending[Any], wide: EagerStepper[Any]) -> bool:
    """Whether an engine's numbers know of all in a stepper that carries derivatives; wide: without any, in double precision."""
    values = [primal(linked.leaves[k]).requires_grad_() for k in linked.active]
    with torch.enable_grad():
        known = maker.precise(precise(linked.with_values(values)), wide)
    if known is None:
        return False
    outputs = [x for x in vars(known[1]).values() if x.requires_grad]
    # the engine adapts terms itself
    count = sum(map(carries, tensors_of(replaced(linked.parts, adapted=()))))
    if not outputs:
        return False
    found = torch.autograd.grad([x.sum() for x in outputs], values[:count], allow_unused=True)
    return all(x is not None for x in found)


class _Node:
    """Steps from a state.

    Attributes:
        walk: how they were made. other: what the states after them have besides fields. numbered: whether they depend on the
            engine's numbers.
    """

    def __init__(self, walker: Walker[Any], state: Any, controls: Tensor | None, steps: int, kept: bool) -> None:
        self._walker, self._steps, self._kept = walker, steps, kept
        self.numbered = walker.numbered
        self._state: Any = mapped_tensors(state, primal)
        self._controls = None if controls is None else primal(controls)
        self._path: Any = None

    def run(self) -> tuple[Tensor, ...]:
        """The fields after each step."""
        made = self._made()
        self.other, self.walk = made.other, Walk(made.solution, doubts_of(made.solution.status))
        self._path = made.path if self._kept else None
        return tuple(x.detach() for x in made.found.values())

    def _made(self) -> Walked:
        with torch.no_grad():
            return self._walker.maker.walk(self._state, self._controls, self._steps)

    def pulled(self, seen: Sequence[Tensor | None], numbers: bool) -> list[Tensor | None]:
        """Derivatives by the start's fields, the controls, and the engine's numbers if asked for, of those by the fields after each
        step."""
        path, constant, dropped = self._to_follow()
        named = dict(zip(path.found, seen, strict=True))
        back = self._walker.back.back(path, named, constant=constant, dropped=dropped, numbers=numbers)
        self._note(back.singular)
        found: list[Tensor | None] = [x[0] for x in back.start.values()]
        if self._controls is not None:
            found.append(back.control[0])
        if numbers:
            assert back.numbers is not None
            found += [back.numbers.shared, back.numbers.own, back.numbers.step_size]
        return found

    def pushed(self, changed: Sequence[Tensor | None]) -> list[Tensor]:
        """How the fields after each step change with the start's fields, the controls and the engine's numbers."""
        path, constant, dropped = self._to_follow()
        given, like = list(path.given), self._like(path)
        whole = [torch.zeros_like(x) if y is None else y.to(x.dtype) for x, y in zip(like, changed, strict=True)]
        start, rest = dict(zip(given, whole, strict=False)), whole[len(given) :]
        steps, *batch = path.found["q"].shape[:-1]
        held = rest.pop(0) if self._controls is not None else path.control.new_zeros(steps, *batch, path.control.shape[-1])
        numbers = Numbers(*rest) if self.numbered else None
        found, singular = self._walker.back.ahead(path, start, held.double(), numbers, constant, dropped)
        self._note(singular)
        return list(found.values())

    def _like(self, path: Any) -> list[Tensor]:
        """What `pushed` is given, in double precision."""
        fields = [x.double() for x in path.given.values()]
        held = [] if self._controls is None else [self._controls.double()]
        return [*fields, *held, *map(primal, self._walker.known)]

    def _to_follow(self) -> tuple[Any, Tensor | None, bool]:
        """The path, which of its steps count as constants, and whether those with a singular J do."""
        self._complain(int(Doubt.UNSOLVED))
        unsolved, zero = (self.walk.doubts & int(Doubt.UNSOLVED)) > 0, self._walker.gradients.doubtful is Doubtful.ZERO
        path = self._made().path if self._path is None else self._path
        return path, unsolved if zero and bool(unsolved.any()) else None, zero

    def _note(self, singular: Tensor) -> None:
        self.walk.doubts |= int(Doubt.SINGULAR) * singular.int()
        self._complain(int(Doubt.SINGULAR))

    def _complain(self, doubt: int) -> None:
        """As for single steps, of the last step that is in doubt first."""
        doubts, time = self.walk.doubts & doubt, self.other["time"]
        if not bool(doubts.any()):
            return
        for k in reversed(range(self._steps)):
            complain(self._walker.gradients.doubtful, doubts[k], time[k])


class _Walk(torch.autograd.Function):
    """Several steps as a node of the graph."""

    @staticmethod
    def forward(ctx: Any, node: _Node, *values: Tensor) -> tuple[Tensor, ...]:
        ctx.node, ctx.dtypes = node, [x.dtype for x in values]
        ctx.set_materialize_grads(False)
        return node.run()

    @staticmethod
    def backward(ctx: Any, *seen: Tensor | None) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # as with create_graph=True
            raise GradientError(NO_SECOND)
        if all(x is None for x in seen):
            return None, *(None for _ in ctx.dtypes)
        needed = ctx.needs_input_grad[1:]
        found = ctx.node.pulled(seen, any(needed[-3:]) and ctx.node.numbered)
        found += [None] * (len(needed) - len(found))
        return None, *(None if x is None or not need else x.to(t) for x, need, t in zip(found, needed, ctx.dtypes, strict=True))

    @staticmethod
    def jvp(ctx: Any, _: None, *changed: Tensor | None) -> tuple[Tensor, ...]:
        return tuple(x.to(ctx.dtypes[0]) for x in ctx.node.pushed(changed))
