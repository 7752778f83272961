"""Calls of the compiled core: a plan, a state's tensors in, and what the core has made of them."""

from __future__ import annotations

import ctypes
import dataclasses
import itertools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import State
from pbfd_torch.native.library import Library
from pbfd_torch.native.plan import Plan
from pbfd_torch.solvers.objective import FALLBACKS, Solution

COUNTED = ("status", "evaluations", "iterations", "hazards")
ALIGNMENT = 64
WORTH_A_BLOCK = 128  # steps of worlds: fewer are done about as soon as another thread has begun
BLOCKS = 4  # for each thread: some worlds take longer than others


@dataclass(frozen=True)
class Scheme:
    """An integrator that the core knows: its function there, and the fields of its states, those of coordinates or of degrees of
    freedom `[*batch, n]` first, and numbers `[*batch]`."""

    function: str
    vectors: tuple[str, ...]
    numbers: tuple[str, ...] = ()


SCHEMES: dict[type, Scheme] = {
    EnergyMomentum: Scheme("pbfd_energy_momentum", ("q", "v", "push", "steady", "lag", "average"), ("gained", "surplus", "peak")),
    ImplicitEuler: Scheme("pbfd_implicit_euler", ("q", "q_previous", "acceleration")),
}


class _Plan(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int) for name in ("bytes", "nodes", "nq", "nv", "nu", "candidates", "halvings")),
        ("whole", ctypes.c_void_p),
        ("real", ctypes.c_void_p),
    )


class _Steps(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_double) for name in ("dt", "tolerance", "surplus")),
        *((name, ctypes.c_int) for name in ("evaluations", "worlds", "first", "last", "steps", "held")),
        ("given", ctypes.c_void_p * 9),
        ("control", ctypes.c_void_p),
        ("found", ctypes.c_void_p * 9),
        ("residual_norm", ctypes.c_void_p),
        ("counted", ctypes.c_void_p * len(COUNTED)),
        ("fallbacks", ctypes.c_void_p),
    )


@dataclass(frozen=True)
class Terms:
    """What is asked of steps. dt [s]; tolerance of ‖r/scale‖; surplus: see `EnergyMomentum`; evaluations: at
    most, of each with all that is tried."""

    dt: float
    tolerance: float
    surplus: float
    evaluations: int


class Journey:
    """Several steps of all worlds.

    Attributes:
        given: the fields of the state `[*batch, ...]` that each world sets out from.
        control: `[steps, *batch, nu]`, or `[1, *batch, nu]` for all steps.
        fields: of the state after each step, `[steps, *batch, ...]`.
        residual_norm, counted, fallbacks: how each was solved, `[steps, *batch, ...]`.
    """

    def __init__(self, scheme: Scheme, state: State, control: Tensor, steps: int) -> None:
        batch = tuple(state.q.shape[:-1])
        self.given = {name: _whole(getattr(state, name), (*batch, getattr(state, name).shape[-1])) for name in scheme.vectors}
        self.given |= {name: _whole(getattr(state, name), batch) for name in scheme.numbers}
        self.control = _whole(control, (len(control), *batch, control.shape[-1]))
        self.fields = {name: x.new_empty((steps, *x.shape)) for name, x in self.given.items()}
        self.residual_norm = state.q.new_empty((steps, *batch))
        self.counted = {name: torch.empty((steps, *batch), dtype=torch.int32) for name in COUNTED}
        self.fallbacks = torch.empty((steps, *batch, len(FALLBACKS)), dtype=torch.int32)

    def call(self, terms: Terms) -> _Steps:
        """What the core is to be asked."""
        steps, *batch = self.residual_norm.shape
        worlds = math.prod(batch)
        asked = _Steps(*dataclasses.astuple(terms), worlds, 0, worlds, steps, len(self.control) == 1)
        asked.control, asked.residual_norm = self.control.data_ptr(), self.residual_norm.data_ptr()
        asked.fallbacks = self.fallbacks.data_ptr()
        for array, values in ((asked.given, self.given), (asked.found, self.fields), (asked.counted, self.counted)):
            for i, x in enumerate(values.values()):
                array[i] = x.data_ptr()
        return asked

    @property
    def solution(self) -> Solution:
        """How the steps were solved, `[steps, *batch, ...]`."""
        counted = {name: x for name, x in self.counted.items() if name != "hazards"}
        lanes = int(counted["evaluations"].sum())
        return Solution(self.fields["q"], residual_norm=self.residual_norm, fallbacks=self.fallbacks, lanes=lanes, **counted)


class Core:
    """A scene's plan and a scheme's steps in the compiled library. `threads`: at most, of those that share a call's worlds. Raises
    `ValueError` where library and plan do not fit together."""

    def __init__(self, library: Library, plan: Plan, scheme: Scheme, terms: Terms, threads: int) -> None:
        self.plan, self._scheme, self._terms, self._threads = plan, scheme, terms, threads
        self._functions = library.functions
        self._plan = _Plan(plan.real.element_size(), *plan.sizes, plan.whole.data_ptr(), plan.real.data_ptr())
        wanted = (self._asked("pbfd_whole_numbers"), self._asked("pbfd_real_numbers"))
        if wanted != (plan.whole.numel(), plan.real.numel()):
            raise ValueError(f"the plan has {plan.whole.numel()} and {plan.real.numel()} numbers: the core wants {wanted}")
        self._room = self._asked("pbfd_room") + ALIGNMENT
        self._rooms: list[Tensor] = []  # that no call is in
        self._lanes = library.lanes(plan.real.dtype)

    def _asked(self, name: str) -> int:
        return int(getattr(self._functions, name)(ctypes.byref(self._plan)))

    def go(self, state: State, control: Tensor, steps: int) -> Journey:
        """So many steps of all worlds from a state under controls `[steps, *batch, nu]`, or `[1, *batch, nu]` for all steps. On
        several threads where that is worth it: worlds do not know of each other, and it makes no difference to any."""
        journey = Journey(self._scheme, state, control, steps)
        asked = journey.call(self._terms)
        blocks = min(BLOCKS * self._threads, asked.worlds * steps // WORTH_A_BLOCK, asked.worlds // self._lanes)
        if self._threads == 1 or blocks < 2:
            self._make(asked)
            return journey
        calls = []
        for first, last in _blocks(asked.worlds, blocks, self._lanes):
            part = _Steps.from_buffer_copy(asked)
            part.first, part.last = first, last
            calls.append(part)
        list(_pool(self._threads).map(self._make, calls))
        return journey

    def _make(self, asked: _Steps) -> None:
        try:
            room = self._rooms.pop()
        except IndexError:
            room = torch.empty(self._room, dtype=torch.uint8)
        aligned = -(-room.data_ptr() // ALIGNMENT) * ALIGNMENT
        make = getattr(self._functions, self._scheme.function)
        make(ctypes.byref(self._plan), ctypes.byref(asked), ctypes.c_void_p(aligned))
        self._rooms.append(room)


def _whole(values: Tensor, shape: tuple[int, ...]) -> Tensor:
    """All numbers of a tensor that may be one for several worlds, one after the other."""
    return values.expand(shape).contiguous()


def _blocks(worlds: int, count: int, lanes: int) -> list[tuple[int, int]]:
    """Worlds from … to, in so many parts of whole registers."""
    registers = -(-worlds // lanes)
    bounds = [min(worlds, registers * i // count * lanes) for i in range(count + 1)]
    return list(itertools.pairwise(bounds))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "pbfd")
