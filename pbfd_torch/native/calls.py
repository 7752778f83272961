"""Calls of the compiled core's functions: the plan that they go by, the memory they work in, and threads."""

from __future__ import annotations

import ctypes
import itertools
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.native.library import Library
from pbfd_torch.native.plan import Plan

ALIGNMENT = 64
BLOCKS = 4  # for each thread: some worlds take longer than others


class _Plan(ctypes.Structure):
    _fields_ = (
        *(
            (name, ctypes.c_int)
            for name in (
                *("bytes", "dimension", "nodes", "nq", "nv", "nu"),
                *("candidates", "anchors", "planes", "solids", "samples", "forms", "uncommon", "pushes", "varied"),
            )
        ),
        *((name, ctypes.c_void_p) for name in ("whole", "real", "sample", "which")),
        *((name, ctypes.c_int) for name in ("links", "groups", "rows", "pairs", "colliders", "slots", "remembered")),
        *((name, ctypes.c_void_p) for name in ("body_whole", "body_real")),
        ("moving", ctypes.c_int),
    )


class _Room:
    """Memory to work in, which begins where a register may lie."""

    def __init__(self, size: int) -> None:
        self._memory = torch.empty(size + ALIGNMENT, dtype=torch.uint8)
        self.begin = ctypes.c_void_p(-(-self._memory.data_ptr() // ALIGNMENT) * ALIGNMENT)


class Calls:
    """What the library does for one plan. `threads`: at most, of those that share a call. Raises `ValueError` where library and
    plan do not fit together."""

    def __init__(self, library: Library, plan: Plan, threads: int) -> None:
        self._kept, self._threads = plan, threads  # the library reads the plan's numbers where they are
        self._functions = library.functions
        tables = (x.data_ptr() for x in (plan.whole, plan.real, plan.sample, plan.which))
        bodies = plan.bodies
        self._bodies = torch.tensor(bodies.whole, dtype=torch.int32), bodies.real.to(plan.real.dtype)
        self._plan = _Plan(plan.real.element_size(), plan.dimension, *plan.sizes, len(plan.which), *tables, *bodies.size)
        self._plan.body_whole, self._plan.body_real = (x.data_ptr() for x in self._bodies)
        self._plan.moving = len(plan.carriers)
        wanted = (self._asked("pbfd_whole_numbers"), self._asked("pbfd_real_numbers"))
        if wanted != (len(plan.whole), len(plan.real)):
            raise ValueError(f"the plan has {len(plan.whole)} and {len(plan.real)} numbers: the core wants {wanted}")
        self._pointer = ctypes.byref(self._plan)
        self._size = self._asked("pbfd_room")
        self._rooms: list[_Room] = []  # that no call is in
        self._lanes = library.lanes(plan.real.dtype)

    def _asked(self, name: str) -> int:
        return int(getattr(self._functions, name)(ctypes.byref(self._plan)))

    def make(self, function: str, *arguments: Any) -> None:
        """One call, of a plan, these structures and pointers, and room."""
        room = self._room()
        passed = [ctypes.byref(x) if isinstance(x, ctypes.Structure) else x for x in arguments]
        getattr(self._functions, function)(self._pointer, *passed, room.begin)
        self._rooms.append(room)

    def share(self, function: str, asked: Any, count: int, most: int, *others: Any) -> None:
        """Calls for `first` … `last` of so many, all that `asked` holds, in `most` blocks at most, on several threads; the
        structures `others` come before it."""
        blocks = min(BLOCKS * self._threads, most, count // self._lanes)
        if count == 0:
            return
        if self._threads == 1 or blocks < 2:
            self.make(function, *others, asked)
            return
        parts = []
        for first, last in _blocks(count, blocks, self._lanes):
            part = type(asked).from_buffer_copy(asked)
            part.first, part.last = first, last
            parts.append(part)
        list(_pool(self._threads).map(lambda part: self.make(function, *others, part), parts))

    def _room(self) -> _Room:
        """Memory for one call at a time."""
        try:
            return self._rooms.pop()
        except IndexError:
            return _Room(self._size)


def whole(values: Tensor, shape: tuple[int, ...]) -> Tensor:
    """All numbers of a tensor that may be one for several worlds, one after the other."""
    return values if values.shape == shape and values.is_contiguous() else values.expand(shape).contiguous()


def _blocks(count: int, blocks: int, lanes: int) -> list[tuple[int, int]]:
    """From … to, in so many parts of whole registers."""
    registers = -(-count // lanes)
    bounds = [min(count, registers * i // blocks * lanes) for i in range(blocks + 1)]
    return list(itertools.pairwise(bounds))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "pbfd")
