"""Steps as nodes of the graph of derivatives: made without any first, and retraced with them when they are asked for.

A node keeps the tensors that its step set out from, which the step before has made anyway, and how the step was made (`Way`): no
graph, no Jacobian. So a rollout that carries derivatives is as large as its states.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import Tensor

from pbfd_torch.errors import GradientError, GradientWarning
from pbfd_torch.gradients.implicit import Doubt, Doubtful, Factors, Gradients, followed
from pbfd_torch.gradients.parts import of_parts, parts_of, precise
from pbfd_torch.integrators.integrator import S
from pbfd_torch.solvers.objective import Solution, Status, is_solved
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.stepping.stepper import Stepper
from pbfd_torch.stepping.way import Way
from pbfd_torch.tensors.plain import carries, plain, wrapped
from pbfd_torch.tensors.structures import in_dtype, mapped_tensors, tensors_of

NO_SECOND = "steps have first derivatives only: use torch.autograd.grad without create_graph, or torch.func.jvp"


def doubts_of(status: Tensor) -> Tensor:
    """The bits of `Doubt` that are known from values of `Status`."""
    detours = (status == int(Status.EASED)) | (status == int(Status.HALVED))
    return int(Doubt.UNSOLVED) * (~is_solved(status)).int() + int(Doubt.DETOUR) * detours.int()


@dataclass(eq=False)
class Made:
    """A step that carries derivatives.

    Attributes:
        solution: how it was solved; way: how it was made.
        doubts: `[*batch]` int, bits of `Doubt`.
        factors: those of J once they are there, if they are to be kept.
    """

    solution: Solution
    way: Way
    doubts: Tensor
    factors: list[Factors] | None = None


Engine = Callable[[EagerStepper[Any]], Stepper[Any]]


class Linked(Generic[S]):
    """The steps of a stepper as functions that carry derivatives.

    `gradients`: how they are differentiated. `engine`: what makes steps without derivatives, of the stepper that defines them.
    `active`: the positions, among all tensors of the stepper's parts, of those that carry any."""

    def __init__(self, stepper: EagerStepper[S], gradients: Gradients, engine: Engine) -> None:
        self.stepper = stepper
        self.gradients = gradients
        self.engine = engine
        self.parts = parts_of(stepper)
        self.leaves = tensors_of(self.parts)
        self.active = [k for k, x in enumerate(self.leaves) if carries(x) or wrapped(x)]
        self._plain: EagerStepper[S] | None = None
        self._wrapped = False  # torch.func is at work on what it is made of
        self._maker: Stepper[S] | None = None

    def carry(self, *values: Any) -> bool:
        """Whether steps from these values carry derivatives."""
        return bool(self.active) or any(map(carries, tensors_of(list(values))))

    def plain(self, values: Sequence[Tensor]) -> EagerStepper[S]:
        """The stepper without derivatives, from plain values of the active tensors."""
        if self._plain is None:
            self._plain = self.with_values(values) if self.active else self.stepper
            self._wrapped = any(map(wrapped, values))
        return self._plain

    def maker(self, stepper: EagerStepper[Any], start: Any) -> Stepper[Any]:
        """What makes the steps of a stepper without derivatives from such a start."""
        if self._wrapped or any(map(wrapped, tensors_of(start))):
            return stepper  # PyTorch alone looks into the tensors of torch.func
        if stepper is not self._plain:
            return self.engine(stepper)
        if self._maker is None:
            self._maker = self.engine(stepper)
        return self._maker

    def with_values(self, values: Sequence[Tensor]) -> EagerStepper[S]:
        """The stepper with other values of the active tensors."""
        if not self.active:
            return self.stepper
        leaves = list(self.leaves)
        for k, value in zip(self.active, values, strict=True):
            leaves[k] = value
        order = iter(leaves)
        return of_parts(self.stepper, mapped_tensors(self.parts, lambda _: next(order)))

    def step(self, state: S, control: Tensor | None) -> tuple[S, Made]:
        """See `Simulator.step`."""
        play = Step(self, state, control)
        end = play.perform(state, control)
        assert play.made is not None
        return end, play.made

    def initial_state(self, q: Tensor, v: Tensor, control: Tensor | None) -> S:
        """See `Simulator.initial_state`."""
        play = _Start(self, (q, v), control)
        start: S = play.perform((q, v), control)
        return start


T = TypeVar("T")
_Function = Callable[..., tuple[Tensor, ...]]


class Play(Generic[T]):
    """A computation that is made without derivatives first and retraced with them later. Its inputs: all tensors of `start` and of
    the control, and the stepper's active ones."""

    def __init__(self, linked: Linked[Any], start: Any, control: Tensor | None) -> None:
        self.linked = linked
        # without derivatives, and without memory of what is given anyway
        self._start = mapped_tensors(start, lambda x: x.new_empty(0))
        self._count = len(tensors_of(start))
        self._controlled = control is not None
        self._end: Any = None
        self.plain: tuple[Tensor, ...] = ()

    def perform(self, start: Any, control: Tensor | None) -> Any:
        """The end, carrying derivatives."""
        given = [*tensors_of(start), *([] if control is None else [control])]
        active = [self.linked.leaves[k] for k in self.linked.active]
        values = iter(_Implicit.apply(self, *given, *active))  # type: ignore[no-untyped-call]
        return mapped_tensors(self._end, lambda _: next(values))

    def _unpacked(self, values: Sequence[Tensor]) -> tuple[Any, Tensor | None, Sequence[Tensor]]:
        order = iter(values)
        start = mapped_tensors(self._start, lambda _: next(order))
        control = next(order) if self._controlled else None
        return start, control, list(order)

    def run(self, values: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Without derivatives."""
        with torch.no_grad():
            start, control, active = self._unpacked([x.detach() for x in values])
            end = self.first(self.linked.plain(active), start, control)
        self._end = mapped_tensors(end, lambda x: x.new_empty(0))
        return tuple(tensors_of(end))

    def retraced(self, values: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """With them."""
        start, control, active = self._unpacked(values)
        return tuple(tensors_of(self.again(self.linked.with_values(active), start, control)))

    def first(self, stepper: EagerStepper[Any], start: Any, control: Tensor | None) -> Any:
        """Made without derivatives."""
        raise NotImplementedError

    def again(self, stepper: EagerStepper[Any], start: Any, control: Tensor | None) -> Any:
        """The same as a function that carries derivatives."""
        raise NotImplementedError


class Step(Play[S]):
    """A step."""

    made: Made | None = None

    def first(self, stepper: EagerStepper[S], start: S, control: Tensor | None) -> S:
        end, solution, way = self.linked.maker(stepper, start).made(start, control)
        end = mapped_tensors(end, lambda x: x.clone() if x._is_view() else x)  # see `_Start`
        self.made = Made(solution, way.kept(), doubts_of(solution.status), [] if self.linked.gradients.keep_factors else None)
        return end

    def again(self, stepper: EagerStepper[S], start: S, control: Tensor | None) -> S:
        made, gradients = self.made, self.linked.gradients
        policy = gradients.doubtful
        assert made is not None
        unsolved = (made.doubts & int(Doubt.UNSOLVED)) > 0
        included = ~unsolved if policy is Doubtful.ZERO and bool(unsolved.any()) else None
        dtype = start.time.dtype
        wide, held = precise(stepper), None if control is None else control.double()
        begin = in_dtype(start, torch.float64)
        end, singular = followed(wide, begin, held, made.way, gradients.blur, included, made.factors)
        made.doubts = made.doubts | int(Doubt.SINGULAR) * plain(singular).int()
        complain(policy, made.doubts, start.time)
        lost = (made.doubts & int(Doubt.SINGULAR)) > 0
        end = _constant(end, lost) if policy is Doubtful.ZERO and bool(lost.any()) else end
        return in_dtype(end, dtype)


class _Start(Play[S]):
    """The state at t = 0 of a configuration and a velocity."""

    def first(self, stepper: EagerStepper[S], start: tuple[Tensor, Tensor], control: Tensor | None) -> S:
        self._trials: list[tuple[Way, Tensor]] = []

        def attempt(trial: EagerStepper[Any], state: Any, held: Tensor | None) -> tuple[Any, Tensor]:
            end, solution, way = self.linked.maker(trial, state).made(state, held)
            self._trials.append((way.kept(), solution.solved))
            return end, solution.solved

        begun, maker = stepper.with_attempt(attempt).initial_state(*start, control), self.linked.maker(stepper, start)
        if maker is not stepper:
            begun = maker.initial_state(*start, control)  # the values of a start without derivatives, to the bit
        # what a node gives back must not share memory with what it was given, nor among itself, for forward derivatives
        return mapped_tensors(begun, torch.clone)

    def again(self, stepper: EagerStepper[S], start: tuple[Tensor, Tensor], control: Tensor | None) -> S:
        trials, dtype, blur = iter(self._trials), start[0].dtype, self.linked.gradients.blur

        def attempt(trial: EagerStepper[Any], state: Any, held: Tensor | None) -> tuple[Any, Tensor]:
            way, solved = next(trials)
            return followed(trial, state, held, way, blur)[0], solved

        wide, held = precise(stepper).with_attempt(attempt), None if control is None else control.double()
        q, v = (x.double() for x in start)
        begin: S = in_dtype(wide.initial_state(q, v, held), dtype)
        return begin


def _constant(state: S, worlds: Tensor) -> S:
    """The state, that of some worlds `[*batch]` without derivatives."""

    def still(x: Tensor) -> Tensor:
        return torch.where(worlds.reshape(*worlds.shape, *(1,) * (x.ndim - worlds.ndim)), x.detach(), x)

    result: S = mapped_tensors(state, still)
    return result


def complain(policy: Doubtful, doubts: Tensor, time: Tensor) -> None:
    """Raises `GradientError` or warns where the doubts `[*batch]` are such that the policy says so."""
    if policy is Doubtful.ZERO:
        return
    for doubt in (Doubt.UNSOLVED, Doubt.SINGULAR):
        worlds = ((doubts & int(doubt)) > 0).reshape(-1)
        if not bool(worlds.any()):
            continue
        first = float(plain(time).reshape(-1)[worlds][0])
        message = (
            f"the step at t = {first:.6g} s is {str(doubt.name).lower()} in {int(worlds.sum())} of {len(worlds)} worlds and has no "
            "derivative there: solve it (a smaller dt, other fallbacks), or give the simulator Gradients with Doubtful.WARN or ZERO"
        )
        if policy is Doubtful.RAISE:
            raise GradientError(message)
        warnings.warn(message, GradientWarning, stacklevel=2)


def _pushed(function: _Function, values: list[Tensor], change: list[Tensor]) -> Sequence[Tensor]:
    """How the ends change with the values, by forward derivatives."""
    found: tuple[Tensor, ...] = torch.func.jvp(function, tuple(values), tuple(change))[1]
    return found


def _pushed_twice(function: _Function, values: list[Tensor], change: list[Tensor]) -> Sequence[Tensor]:
    """The same by two backward ones, where forward derivatives, which do not nest, are at work outside: with c ↦ Jᵀc linear, J is
    its derivative's transpose."""
    with torch.enable_grad():
        moved = [x.detach().requires_grad_() for x in values]
        ends = function(*moved)
        probes = [torch.zeros_like(e, requires_grad=True) for e in ends]
        reached = [(e, p) for e, p in zip(ends, probes, strict=True) if e.requires_grad]
        if not reached:
            return [torch.zeros_like(e) for e in ends]
        pulled: Sequence[Tensor | None] = torch.autograd.grad(
            [e for e, _ in reached], moved, [p for _, p in reached], create_graph=True, allow_unused=True
        )
        pairs = [(x, c) for x, c in zip(pulled, change, strict=True) if x is not None and x.requires_grad]
    found: Sequence[Tensor | None] = torch.autograd.grad([x for x, _ in pairs], probes, [c for _, c in pairs], allow_unused=True)
    return [torch.zeros_like(e) if x is None else x for x, e in zip(found, ends, strict=True)]


class _Context(Protocol):
    play: Play[Any]
    saved_tensors: tuple[Tensor, ...]
    needs_input_grad: tuple[bool, ...]


class _Implicit(torch.autograd.Function):
    """A play as a node of the graph, which keeps the play's inputs and nothing else."""

    @staticmethod
    def forward(play: Play[Any], *values: Tensor) -> tuple[Tensor, ...]:
        play.plain = tuple(x.detach() for x in values)
        return play.run(values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.play = inputs[0]
        ctx.save_for_backward(*inputs[1:])
        ctx.mark_non_differentiable(*(x for x in output if not x.is_floating_point()))
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: _Context, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # as with create_graph=True, and in torch.func's backward transforms
            raise GradientError(NO_SECOND)
        needed = ctx.needs_input_grad[1:]
        with torch.enable_grad():
            values = [x.detach().requires_grad_(need) for x, need in zip(ctx.saved_tensors, needed, strict=True)]
            ends = ctx.play.retraced(values)
            pairs = [(e, c) for e, c in zip(ends, cotangents, strict=True) if c is not None and e.requires_grad]
        wanted = [x for x in values if x.requires_grad]
        if not pairs or not wanted:
            return None, *(None for _ in values)
        found = iter(torch.autograd.grad([e for e, _ in pairs], wanted, [c for _, c in pairs], allow_unused=True))
        return None, *(next(found) if x.requires_grad else None for x in values)

    @staticmethod
    def jvp(ctx: _Context, _: None, *tangents: Tensor | None) -> tuple[Tensor | None, ...]:
        values, play = ctx.play.plain, ctx.play
        moves = {k: t for k, t in enumerate(tangents) if t is not None and values[k].is_floating_point()}
        first, change = [values[k] for k in moves], list(moves.values())

        def ends(*moved: Tensor) -> tuple[Tensor, ...]:
            whole = list(values)
            for k, x in zip(moves, moved, strict=True):
                whole[k] = x
            return play.retraced(whole)

        floating = [x.is_floating_point() for x in tensors_of(play._end)]
        push = _pushed if any(wrapped(t) for t in change) else _pushed_twice
        found = push(lambda *x: tuple(e for e, real in zip(ends(*x), floating, strict=True) if real), first, change)
        order = iter(found)
        return tuple(next(order) if real else None for real in floating)
