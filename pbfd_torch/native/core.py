"""Calls of the compiled core: a plan, a state's tensors in, and what the core has made of them."""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.integrators.energy_momentum import EnergyMomentum, Velocities
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import State
from pbfd_torch.integrators.variational import Variational
from pbfd_torch.native.calls import Calls, whole
from pbfd_torch.native.library import Library
from pbfd_torch.native.plan import Plan
from pbfd_torch.solvers.objective import FALLBACKS, Solution

COUNTED = ("status", "evaluations", "iterations", "hazards")
WORTH_A_BLOCK = 128  # steps of worlds: fewer are done about as soon as another thread has begun


@dataclass(frozen=True)
class Scheme:
    """An integrator that the core knows: its function there, and the fields of its states, those of coordinates or of degrees of
    freedom `[*batch, n]` first, and numbers `[*batch]`."""

    function: str
    vectors: tuple[str, ...]
    numbers: tuple[str, ...] = ()

    def fields(self, state: State) -> dict[str, Tensor]:
        """Those of a state, in the order of the core, all worlds one after the other."""
        batch = tuple(state.q.shape[:-1])
        given = {name: whole(x := getattr(state, name), (*batch, x.shape[-1])) for name in self.vectors}
        return given | {name: whole(getattr(state, name), batch) for name in self.numbers}


SCHEMES: dict[type, Scheme] = {
    EnergyMomentum: Scheme("pbfd_energy_momentum", ("q", "v", "push", "steady", "lag", "average"), ("gained", "surplus", "peak")),
    ImplicitEuler: Scheme("pbfd_implicit_euler", ("q", "q_previous", "acceleration")),
    Variational: Scheme("pbfd_implicit_euler", ("q", "q_previous", "acceleration")),
}


class _Steps(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_double) for name in ("dt", "tolerance", "surplus", "share")),
        *((name, ctypes.c_int) for name in ("evaluations", "worlds", "first", "last", "steps", "held")),
        ("given", ctypes.c_void_p * 10),
        ("control", ctypes.c_void_p),
        ("found", ctypes.c_void_p * 10),
        ("residual_norm", ctypes.c_void_p),
        ("counted", ctypes.c_void_p * len(COUNTED)),
        ("fallbacks", ctypes.c_void_p),
        ("grip", ctypes.c_void_p),
    )


@dataclass(frozen=True)
class Terms:
    """What is asked of steps. dt [s]; tolerance of ‖r/scale‖; surplus: see `EnergyMomentum`; share: see `Variational`, 1 for
    implicit Euler; evaluations: at most, of each with all that is tried."""

    dt: float
    tolerance: float
    surplus: float
    share: float
    evaluations: int


class Journey:
    """Steps of all worlds: what they are to be made of, and room for what they come to.

    Attributes:
        given: the fields of the state `[*batch, ...]` that each world sets out from.
        control: `[steps, *batch, nu]`, or `[1, *batch, nu]` for all steps. grip: see `Plan`.
        fields: of the state after each step, with its memory, `[*steps, *batch, ...]`; steps: how many, or nothing for a single
            one.
        residual_norm, counted, fallbacks: how each was solved, `[*steps, *batch, ...]`.
    """

    def __init__(self, scheme: Scheme, state: State, control: Tensor, steps: tuple[int, ...], plan: Plan) -> None:
        batch = tuple(state.q.shape[:-1])
        self._steps, self._worlds = math.prod(steps), math.prod(batch)
        self.given = scheme.fields(state)
        if any(plan.anchors):
            self.given["memory"] = whole(torch.cat(state.memory, -2), (*batch, sum(plan.anchors), 3))
        self.control = whole(control, (len(control), *batch, control.shape[-1]))
        self.grip = None if plan.grip is None else whole(plan.grip, (*batch, plan.grip.shape[-1]))
        self.found = {name: _room_for(x, steps) for name, x in self.given.items()}
        self.residual_norm = state.q.new_empty((*steps, *batch))
        first, *others = COUNTED
        self.counted = {first: torch.empty((*steps, *batch), dtype=torch.int32)}
        self.counted |= {name: torch.empty_like(self.counted[first]) for name in others}
        self.fallbacks = torch.empty((*steps, *batch, len(FALLBACKS)), dtype=torch.int32)
        memory = tuple(x.expand(*steps, *x.shape) for x in state.memory)  # there is nothing in it without anchors
        if any(plan.anchors):
            memory = self.found["memory"].split(plan.anchors, -2)
        self.fields: dict[str, Any] = self.found | {"memory": memory}

    def call(self, terms: Terms) -> _Steps:
        """What the core is to be asked."""
        asked = _Steps(terms.dt, terms.tolerance, terms.surplus, terms.share, terms.evaluations, self._worlds)
        asked.last, asked.steps = self._worlds, self._steps
        asked.held, asked.control = len(self.control) == 1, self.control.data_ptr()
        asked.given[: len(self.given)] = [x.data_ptr() for x in self.given.values()]
        asked.found[: len(self.found)] = [x.data_ptr() for x in self.found.values()]
        asked.counted[:] = [x.data_ptr() for x in self.counted.values()]
        asked.residual_norm, asked.fallbacks = self.residual_norm.data_ptr(), self.fallbacks.data_ptr()
        if self.grip is not None:
            asked.grip = self.grip.data_ptr()
        return asked

    @property
    def solution(self) -> Solution:
        """How the steps were solved, `[*steps, *batch, ...]`."""
        counted = {name: x for name, x in self.counted.items() if name != "hazards"}
        lanes = int(counted["evaluations"].sum())
        return Solution(self.fields["q"], residual_norm=self.residual_norm, fallbacks=self.fallbacks, lanes=lanes, **counted)


class Core:
    """A scene's plan and a scheme's steps in the compiled library. `threads`: at most, of those that share a call's worlds. Raises
    `ValueError` where library and plan do not fit together."""

    def __init__(self, library: Library, plan: Plan, scheme: Scheme, terms: Terms, threads: int) -> None:
        self.plan, self._scheme, self._terms = plan, scheme, terms
        self._calls = Calls(library, plan, threads)

    def go(self, state: State, control: Tensor, steps: tuple[int, ...]) -> Journey:
        """Steps of all worlds from a state under controls `[steps, *batch, nu]`, or `[1, *batch, nu]` for all steps. On several
        threads where that is worth it: worlds do not know of each other, and it makes no difference to any."""
        journey = Journey(self._scheme, state, control, steps, self.plan)
        asked = journey.call(self._terms)
        self._calls.share(self._scheme.function, asked, asked.worlds, asked.worlds * asked.steps // WORTH_A_BLOCK)
        return journey

    def balance(self, state: Velocities, control: Tensor | None, q: Tensor) -> tuple[Tensor, Tensor]:
        """The balance of forces of the energy–momentum step from a state at q `[*batch, nq]`: r `[*batch, nv]` and
        J `[*batch, nv, nv]`."""
        batch, (_, _, nv, nu) = tuple(state.q.shape[:-1]), self.plan.sizes[:4]
        held = q.new_zeros(1, *batch, nu) if control is None else control.expand(1, *batch, nu)
        journey = Journey(self._scheme, state, held, (), self.plan)
        at, residual, jacobian = whole(q, q.shape), q.new_empty(*batch, nv), q.new_empty(*batch, nv, nv)
        addresses = [ctypes.c_void_p(x.data_ptr()) for x in (at, residual, jacobian)]
        self._calls.make("pbfd_balance", journey.call(self._terms), *addresses)
        return residual, jacobian


def _room_for(given: Tensor, steps: tuple[int, ...]) -> Tensor:
    """What a field `[*batch, ...]` becomes, `[*steps, *batch, ...]`."""
    return given.new_empty((*steps, *given.shape)) if steps else torch.empty_like(given)  # the quicker one
