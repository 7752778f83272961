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
        *(
            (name, ctypes.c_int)
            for name in ("bytes", "nodes", "nq", "nv", "nu", "candidates", "planes", "solids", "samples", "forms", "pushes")
        ),
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
        ("grip", ctypes.c_void_p),
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
        self._plan = _Plan(plan.real.element_size(), *sizes, plan.whole.data_ptr(), plan.real.data_ptr())
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
        step, given = self._step(state, control, terms)
        worlds = step.worlds
        found = [torch.empty_like(x) for x in given[:9]] + [state.q.new_empty(worlds)]
        counted = [torch.empty(worlds, dtype=torch.int32) for _ in range(5)]
        for array, values in ((step.found, found), (step.counted, counted)):
            for i, x in enumerate(values):
                array[i] = x.data_ptr()
        room = self._aligned_room()
        self._functions.pbfd_energy_momentum(ctypes.byref(self._plan), ctypes.byref(step), ctypes.c_void_p(room.data_ptr()))

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

    def balance(self, state: Velocities, control: Tensor | None, terms: Terms, q: Tensor) -> tuple[Tensor, Tensor]:
        """Of the step from a state, at q `[*batch, nq]`: r `[*batch, nv]` and J `[*batch, nv, nv]`."""
        batch, nv = tuple(state.q.shape[:-1]), self.plan.sizes[2]
        step, _kept = self._step(state, control, terms)
        at = _last(q, batch, step.worlds)
        residual, jacobian = q.new_empty(nv, step.worlds), q.new_empty(nv * nv, step.worlds)
        room = self._aligned_room()
        addresses = [ctypes.c_void_p(x.data_ptr()) for x in (at, residual, jacobian, room)]
        self._functions.pbfd_balance(ctypes.byref(self._plan), ctypes.byref(step), *addresses)
        return residual.mT.reshape(*batch, nv), jacobian.mT.reshape(*batch, nv, nv)

    def _step(self, state: Velocities, control: Tensor | None, terms: Terms) -> tuple[_Step, list[Tensor]]:
        """What is given to a step of all worlds, and the arrays that it points to."""
        batch, worlds = tuple(state.q.shape[:-1]), state.q[..., 0].numel()
        if control is None:
            control = state.q.new_zeros(self.plan.sizes[3])
        given = [_last(getattr(state, name), batch, worlds) for name in VECTORS]
        given += [getattr(state, name).expand(batch).reshape(worlds).contiguous() for name in NUMBERS]
        given.append(_last(control, batch, worlds))
        step = _Step(terms.dt, terms.tolerance, terms.surplus, terms.evaluations, worlds, 0, worlds)
        for i, x in enumerate(given):
            step.given[i] = x.data_ptr()
        if self.plan.grip is not None:
            given.append(_last(self.plan.grip, batch, worlds))
            step.grip = given[-1].data_ptr()
        return step, given

    def _aligned_room(self) -> Tensor:
        """Memory to work in, which begins where a register may lie."""
        room = torch.empty(self._room + 64, dtype=torch.uint8)
        return room[-room.data_ptr() % 64 :]


def _last(values: Tensor, batch: Sequence[int], worlds: int) -> Tensor:
    """`[*batch, n]` → `[n, worlds]`: worlds lie side by side."""
    return values.expand(*batch, values.shape[-1]).reshape(worlds, values.shape[-1]).mT.contiguous()
