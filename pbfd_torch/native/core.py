"""Calls of the compiled core: a plan, a state's tensors in, and what the core has made of them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.native.library import Library
from pbfd_torch.native.plan import Plan
from pbfd_torch.solvers.objective import FALLBACKS, Solution
from pbfd_torch.tensors.worlds import replaced

VECTORS = ("q", "v", "push", "steady", "lag", "average")
NUMBERS = ("gained", "surplus", "peak")


class _Plan(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int) for name in ("bytes", "dimension", "nodes", "nq", "nv", "nu", "candidates")),
        ("whole", ctypes.c_void_p),
        ("real", ctypes.c_void_p),
    )


class _Step(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_double) for name in ("dt", "tolerance", "surplus")),
        *((name, ctypes.c_int) for name in ("evaluations", "worlds", "first", "last")),
        ("given", ctypes.c_void_p * 10),
        ("found", ctypes.c_void_p * 10),
        ("counted", ctypes.c_void_p * 5),
    )


@dataclass(frozen=True)
class Terms:
    """What a step is asked for. dt [s]; tolerance of ‖r/scale‖; surplus: see `EnergyMomentum`; evaluations: at most."""

    dt: float
    tolerance: float
    surplus: float
    evaluations: int


class Core:
    """A scene's plan in the compiled library. Raises `ValueError` where both do not fit together."""

    def __init__(self, library: Library, plan: Plan) -> None:
        self.plan = plan
        self._functions = library.functions
        for name in ("pbfd_whole_numbers", "pbfd_real_numbers", "pbfd_room"):
            getattr(self._functions, name).restype = ctypes.c_long
        sizes = plan.sizes
        self._plan = _Plan(plan.real.element_size(), plan.dimension, *sizes, plan.whole.data_ptr(), plan.real.data_ptr())
        wanted = (self._asked("pbfd_whole_numbers"), self._asked("pbfd_real_numbers"))
        if wanted != (plan.whole.numel(), plan.real.numel()):
            raise ValueError(f"the plan has {plan.whole.numel()} and {plan.real.numel()} numbers: the core wants {wanted}")
        self._room = self._asked("pbfd_room")

    def _asked(self, name: str) -> int:
        return int(getattr(self._functions, name)(ctypes.byref(self._plan)))

    def energy_momentum(self, state: Velocities, control: Tensor | None, terms: Terms) -> tuple[Velocities, Solution, Tensor]:
        """One step of all worlds: the state after it, how it was solved, and which worlds `[*batch]` the scheme refuses. The
        numbers that a step remembers besides are the state's own."""
        batch = tuple(state.q.shape[:-1])
        worlds = state.q[..., 0].numel()
        like = state.q
        if control is None:
            control = like.new_zeros(self.plan.sizes[3])
        given = [_last(getattr(state, name), batch, worlds) for name in VECTORS]
        given += [getattr(state, name).expand(batch).reshape(worlds).contiguous() for name in NUMBERS]
        given.append(_last(control, batch, worlds))
        found = [torch.empty_like(x) for x in given[:9]] + [like.new_empty(worlds)]
        counted = [torch.empty(worlds, dtype=torch.int32) for _ in range(5)]
        room = torch.empty(self._room + 64, dtype=torch.uint8)
        step = _Step(terms.dt, terms.tolerance, terms.surplus, terms.evaluations, worlds, 0, worlds)
        for array, values in ((step.given, given), (step.found, found), (step.counted, counted)):
            for i, x in enumerate(values):
                array[i] = x.data_ptr()
        aligned = (room.data_ptr() + 63) // 64 * 64
        self._functions.pbfd_energy_momentum(ctypes.byref(self._plan), ctypes.byref(step), ctypes.c_void_p(aligned))

        def shaped(x: Tensor) -> Tensor:
            return x.mT.contiguous().reshape(*batch, -1) if x.ndim == 2 else x.reshape(batch)

        fields = {name: shaped(x) for name, x in zip((*VECTORS, *NUMBERS), found, strict=False)}
        status, evaluations, iterations, refused, hazards = (shaped(x) for x in counted)
        after = replaced(state, **fields, time=state.time + terms.dt, hazards=hazards)
        solution = Solution(
            q=after.q,
            status=status,
            residual_norm=shaped(found[-1]),
            iterations=iterations,
            evaluations=evaluations,
            fallbacks=evaluations.new_zeros((*batch, len(FALLBACKS))),
            lanes=int(evaluations.sum()),
        )
        return after, solution, refused.to(torch.bool)


def _last(values: Tensor, batch: Sequence[int], worlds: int) -> Tensor:
    """`[*batch, n]` → `[n, worlds]`: worlds lie side by side."""
    return values.expand(*batch, values.shape[-1]).reshape(worlds, values.shape[-1]).mT.contiguous()
