"""Records of rollouts, written by the compiled core into a rollout's own arrays."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from typing import Any, Generic

import torch
from torch import Tensor

from pbfd_torch.integrators.integrator import S
from pbfd_torch.native.calls import Calls, whole
from pbfd_torch.native.core import Frames
from pbfd_torch.native.library import Library
from pbfd_torch.native.plan import Plan, planned_in_space
from pbfd_torch.native.roster import CONTACT, rostered
from pbfd_torch.native.schemes import SCHEMES
from pbfd_torch.native.stretch import Stretch
from pbfd_torch.records.recording import assembled
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.objective import FALLBACKS
from pbfd_torch.stepping.eager import EagerStepper

WORTH_A_BLOCK = 1024  # steps of worlds: fewer are recorded about as soon as another thread has begun
_STATE = ("q", "v", "link_poses", "center_of_mass", "kinetic_energy", "potential_energy", "linear_momentum", "angular_momentum")
_SOLUTION = ("status", "iterations", "evaluations", "residual_norm", "fallbacks")


class _Roster(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int) for name in ("links", "slots", "first_limit", "own")),
        *((name, ctypes.c_void_p) for name in ("carrier", "slot", "danger", "real", "meeting_slot", "meeting_danger")),
    )


class _Record(ctypes.Structure):
    _fields_ = (
        ("dt", ctypes.c_void_p),
        ("alike", ctypes.c_int),
        ("spacing", ctypes.c_void_p),
        *((name, ctypes.c_int) for name in ("worlds", "first", "last")),
        ("given", ctypes.c_void_p * 10),
        ("found", ctypes.c_void_p * 10),
        *((name, ctypes.c_void_p) for name in ("hazards", "own", *_STATE, *CONTACT, "suspect", "poses")),
        ("timed", ctypes.c_int),
    )


class Writer(Generic[S]):
    """Writes what a record has of the steps of a stepper. `plan`: the steps'; `threads`: at most."""

    def __init__(self, library: Library, eager: EagerStepper[S], plan: Plan, threads: int) -> None:
        self.scene, self.dt, self._size = eager.scene, eager.dt, eager.step_size.detach()
        space = plan if plan.dimension == 3 else planned_in_space(eager)
        self.roster = rostered(eager, space)
        self._scheme, self._plan = SCHEMES[type(eager.integrator)], plan
        self._calls, self._own = Calls(library, space, threads), space.own

    def fields(self, state: S) -> dict[str, Tensor]:
        """Those of a state, as the core has them."""
        return self._scheme.fields(state, self._plan)

    def write(
        self,
        times: Tensor,
        given: Mapping[str, Tensor],
        found: Mapping[str, Tensor],
        arrays: dict[str, Tensor],
        frames: Frames | None = None,
    ) -> None:
        """Of steps or frames from the state before the first to those after each, at times `[steps + 1, *batch]`, in arrays of this
        length: the state after each, and its contacts if there is a `suspect`; `hazards` are there already."""
        given = given if frames is None else frames.before_last
        batch = tuple(times.shape[1:])
        worlds, steps = math.prod(batch), math.prod(found["q"].shape[:-1])
        alike = self._size.ndim == 0
        dt = self._size if alike else whole(self._size, batch)
        asked = _Record(dt.data_ptr(), alike, None if frames is None else frames.spacing.data_ptr(), worlds, 0, steps)
        for i, (start, end) in enumerate(zip(given.values(), found.values(), strict=True)):
            asked.given[i], asked.found[i] = start.data_ptr(), end.data_ptr()
        for name, array in arrays.items():
            setattr(asked, name, array.data_ptr())
        poses = self._plan.carriers.poses(times)
        asked.poses, asked.timed = poses.data_ptr(), poses.shape[1]
        own, r = whole(self._own, (*batch, self._own.shape[-1])), self.roster
        asked.own = own.data_ptr()
        real = r.real if r.real.ndim == 1 else whole(r.real, (*batch, r.real.shape[-1]))
        listed = _Roster(len(r.carrier), r.slots, r.first_limit, real.ndim > 1)
        tables = {"carrier": r.carrier, "slot": r.slot, "danger": r.danger, "real": real}
        tables |= {"meeting_slot": r.meeting_slot, "meeting_danger": r.meeting_danger}
        for name, table in tables.items():
            setattr(listed, name, table.data_ptr())
        self._calls.share(f"{self._scheme.function}_record", asked, steps, steps // WORTH_A_BLOCK, listed)


class Record(Generic[S]):
    """The arrays of a rollout, with room for so many steps from a state. `steps`: those that are in it."""

    def __init__(self, writer: Writer[S], state: S, room: int) -> None:
        self._writer, self._began, self.steps, self._lanes = writer, state.time, 0, 0
        batch = state.q.shape[:-1]
        like, roster = state.q, writer.roster
        count = torch.empty(0, dtype=torch.int32)
        self._states = {name: like.new_empty(room + 1, *batch, *event) for name, event in _state_events(writer.scene).items()}
        self._contacts = {name: like.new_empty(room, *batch, roster.slots, *event) for name, event in CONTACT.items()}
        self._seen = {name: count.new_empty(room, *batch) for name in ("suspect", "hazards")}
        self._substeps = count.new_ones(room, *batch)
        events: dict[str, tuple[int, ...]] = dict.fromkeys(_SOLUTION, ()) | {"fallbacks": (len(FALLBACKS),)}
        self._solution = {
            name: (like if name == "residual_norm" else count).new_empty(room, *batch, *event) for name, event in events.items()
        }
        slots, still = roster.still
        for name, values in still.items():
            if CONTACT[name]:
                self._contacts[name][..., slots, :] = values
            else:
                self._contacts[name][..., slots] = values
        now = writer.fields(state)
        writer.write(state.time.expand(2, *batch), now, now, {name: x[:1] for name, x in self._states.items()})

    def add(self, stretch: Stretch[S]) -> None:
        """Further steps. An interruption before the end leaves the record as it was."""
        solution, time, hazards = stretch.solution, stretch.other["time"], stretch.other["hazards"]
        first, last = self.steps, self.steps + len(stretch)
        if solution.steps is not None:
            self._substeps[first:last] = solution.steps
        self._seen["hazards"][first:last] = hazards
        for name in _SOLUTION:
            self._solution[name][first:last] = getattr(solution, name)
        arrays = {name: x[first + 1 : last + 1] for name, x in self._states.items()}
        arrays |= {name: x[first:last] for name, x in (self._contacts | self._seen).items()}
        self._writer.write(torch.cat((stretch.began[None], time)), stretch.given, stretch.found, arrays, stretch.frames)
        self.steps, self._lanes = last, self._lanes + solution.lanes

    def finish(self) -> Rollout:
        """The record so far."""
        arrays = {name: x[: self.steps + 1] for name, x in self._states.items()}
        arrays |= {name: x[: self.steps] for name, x in (self._contacts | self._seen | self._solution).items()}
        arrays["substeps"] = self._substeps[: self.steps]
        return assembled(self._writer.scene, self._writer.dt, self._began, self._lanes, arrays)


def _state_events(scene: Scene) -> dict[str, Any]:
    """What the record has of one state, by the shapes."""
    a = scene.articulation
    sizes: dict[str, tuple[int, ...]] = {"q": (a.nq,), "v": (a.nv,), "link_poses": (a.nlink, 3, 4)}
    sizes |= dict.fromkeys(("center_of_mass", "linear_momentum", "angular_momentum"), (3,))
    return {name: sizes.get(name, ()) for name in _STATE}
