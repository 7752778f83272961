"""A step as a linear system, dx⁺ = A dx + B du, exact at its point, for all worlds at once.

x are the coordinates of what the next step depends on (`Integrator.coordinates`): for the energy–momentum scheme the configuration
and the velocity. Configurations move in the exponential chart, so they have nv entries.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol

import torch
from torch import Tensor

from pbfd_torch.gradients.implicit import Doubt, Doubtful, Gradients, followed
from pbfd_torch.gradients.linked import Engine, complain, doubts_of
from pbfd_torch.gradients.parts import precise
from pbfd_torch.integrators.integrator import Integrator, S
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.stepping.descending import Descending
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.stepping.stepper import Stepper
from pbfd_torch.tensors.structures import in_dtype, mapped_tensors, tensors_of
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import difference, retract


@dataclass(frozen=True, eq=False)
class Linearization(Generic[S]):
    """Attributes:
    A: `[*batch, nx, nx]`; B: `[*batch, nx, nu]`.
    end: the state after the step; solution: how it was solved.
    doubts: `[*batch]` bits of `Doubt`.
    """

    A: Tensor
    B: Tensor
    end: S
    solution: Solution
    doubts: Tensor


class Scheme(Protocol[S]):
    """What has an articulation and an integrator: a `Simulator`, a stepper."""

    @property
    def articulation(self) -> Articulation: ...

    @property
    def integrator(self) -> Integrator[S]: ...


class Chart(Generic[S]):
    """States near a state by their coordinates x `[*, nx]`, `*` having the batch's dimensions last.

    `layout`: the slice of x that each part of the state has. `size`: nx."""

    def __init__(self, simulator: Scheme[S], state: S) -> None:
        self._articulation: Articulation = simulator.articulation
        self.state = state
        configurations, others = simulator.integrator.coordinates
        batch = state.time.ndim
        remembered = ("memory",) if any(x.numel() for x in state.memory) else ()
        self._configurations, self._others = configurations, (*others, *remembered)
        self.layout: dict[str, slice] = {}
        self.size = 0
        for name in (*self._configurations, *self._others):
            parts = tensors_of(getattr(state, name))
            length = self._articulation.nv if name in configurations else sum(x[(0,) * batch].numel() for x in parts)
            self.layout[name] = slice(self.size, self.size + length)
            self.size += length

    def at(self, x: Tensor) -> S:
        """The state at coordinates x."""
        changes = {
            name: retract(self._articulation, getattr(self.state, name).expand(*x.shape[:-1], -1), x[..., self.layout[name]])
            for name in self._configurations
        }
        for name in self._others:
            left = x[..., self.layout[name]]

            def moved(value: Tensor) -> Tensor:
                nonlocal left
                own = value.shape[self.state.time.ndim :]
                step, left = left.split((own.numel(), left.shape[-1] - own.numel()), -1)
                return value + step.reshape(*x.shape[:-1], *own)

            changes[name] = mapped_tensors(getattr(self.state, name), moved)
        copies = x.shape[: x.ndim - 1 - self.state.time.ndim]
        wide: S = mapped_tensors(self.state, lambda value: value.expand(*copies, *value.shape))
        return replaced(wide, **changes)

    @property
    def rows(self) -> Tensor:
        """A derivative by each coordinate, of copies of the batch `[nx, *batch, nx]`."""
        eye = torch.eye(self.size, dtype=self.state.q.dtype, device=self.state.q.device)
        batch = self.state.time.shape
        return eye.reshape(self.size, *(1,) * len(batch), self.size).expand(self.size, *batch, self.size)

    def of(self, state: S) -> Tensor:
        """The coordinates of a state."""
        found = [difference(self._articulation, getattr(self.state, name), getattr(state, name)) for name in self._configurations]
        lead = state.time.shape
        for name in self._others:
            pairs = zip(tensors_of(getattr(state, name)), tensors_of(getattr(self.state, name)), strict=True)
            found += [(now - base).reshape(*lead, -1) for now, base in pairs]
        return torch.cat(found, -1)


def linearized(
    stepper: EagerStepper[S], gradients: Gradients, engine: Engine, state: S, control: Tensor | None
) -> Linearization[S]:
    """See `Simulator.linearize`."""
    maker = engine(stepper)
    if isinstance(maker, Descending) and maker.descends and gradients.blur is None:
        end, solution, singular, A, B = _pulled(maker, engine, stepper, gradients, state, control)
    else:
        end, solution, singular, A, B = _retraced(maker, stepper, gradients, state, control)
    policy = gradients.doubtful
    doubts = doubts_of(solution.status) | int(Doubt.SINGULAR) * singular.int()
    complain(policy, doubts, state.time)
    lost = (doubts & int(Doubt.UNSOLVED | Doubt.SINGULAR)) > 0 if policy is Doubtful.ZERO else torch.zeros_like(doubts) > 0
    A, B = (torch.where(lost[..., None, None], 0.0, g.movedim(0, -2)).to(state.q.dtype) for g in (A, B))
    return Linearization(A, B, end, solution, doubts)


_Rows = tuple[S, Solution, Tensor, Tensor, Tensor]
"""The end of a step, how it was solved, where J is singular `[*batch]`, and the rows of A and B, `[nx, *batch, nx or nu]`."""


def _pulled(
    maker: Descending[S], engine: Engine, stepper: EagerStepper[S], gradients: Gradients, state: S, control: Tensor | None
) -> _Rows[S]:
    """By the engine that makes the step: one call for all rows."""
    wide = precise(stepper)
    back = maker if wide is stepper else engine(wide)
    assert isinstance(back, Descending)
    walked = maker.walk(state, None if control is None else control.detach()[None], 1)
    states = maker.restored(state, walked.found, walked.other)
    end, solution = (mapped(lambda x: x[0], x) for x in (states, walked.solution))
    before, after = (Chart(wide, in_dtype(x, torch.float64)) for x in (state, end))
    fields = {name: x[0].double() for name, x in walked.found.items()}
    seen = {name: x.expand(after.size, *x.shape).clone().requires_grad_() for name, x in fields.items()}
    other = {name: x[0].expand(after.size, *x.shape[1:]) for name, x in walked.other.items()}
    x = before.state.q.new_zeros((after.size, *state.time.shape, before.size), requires_grad=True)
    with torch.enable_grad():
        rows = after.of(back.restored(after.state, seen, other))
        set_out = back.fields(before.at(x))
    # the coordinates by the fields after the step, these by those before it, and these by the coordinates
    found = torch.autograd.grad(rows, list(seen.values()), after.rows, allow_unused=True, materialize_grads=True)
    last = dict(zip(seen, found, strict=True))
    pulled = back.back(walked.path, {}, last, dropped=gradients.doubtful is Doubtful.ZERO)
    reached = [(y, pulled.start[name]) for name, y in set_out.items() if y.requires_grad]
    (A,) = torch.autograd.grad([y for y, _ in reached], x, [by for _, by in reached])
    return end, solution, pulled.singular[0], A, pulled.control[:, 0]


def _retraced(maker: Stepper[S], stepper: EagerStepper[S], gradients: Gradients, state: S, control: Tensor | None) -> _Rows[S]:
    """By PyTorch, along the way that the step was made."""
    nu = stepper.scene.nu
    end, solution, way = maker.made(state, control)
    wide = precise(stepper)
    before, after = (Chart(wide, in_dtype(x, torch.float64)) for x in (state, end))
    # one copy of the batch for every coordinate of the end: a single pass back gives a row of A and B each
    like = before.state.q
    x = like.new_zeros((after.size, *state.time.shape, before.size), requires_grad=True)
    held = like.new_zeros(nu) if control is None else control.detach().double()
    u = held.expand(after.size, *state.time.shape, nu).clone().requires_grad_()
    with torch.enable_grad():
        reached, singular = followed(wide, before.at(x), u if nu else None, way.repeated(after.size), gradients.blur)
        rows = after.of(reached)
    A, B = torch.autograd.grad(rows, (x, u), after.rows, allow_unused=True, materialize_grads=True)
    return end, solution, singular[0], A, B
