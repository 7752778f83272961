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
from pbfd_torch.stepping.eager import EagerStepper
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
    nu = stepper.scene.nu
    end, solution, way = engine(stepper).made(state, control)
    doubts = doubts_of(solution.status)
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
    seed = torch.eye(after.size, dtype=x.dtype, device=x.device)
    seed = seed.reshape(after.size, *(1,) * state.time.ndim, after.size).expand_as(rows)
    found = torch.autograd.grad(rows, (x, u), seed, allow_unused=True, materialize_grads=True)
    policy = gradients.doubtful
    doubts = doubts | int(Doubt.SINGULAR) * singular[0].int()
    complain(policy, doubts, state.time)
    lost = (doubts & int(Doubt.UNSOLVED | Doubt.SINGULAR)) > 0 if policy is Doubtful.ZERO else torch.zeros_like(doubts) > 0
    A, B = (torch.where(lost[..., None, None], 0.0, g.movedim(0, -2)).to(state.q.dtype) for g in found)
    return Linearization(A, B, end, solution, doubts)
