"""Calls of the compiled core: a plan, a state's tensors in, and what the core has made of them."""

from __future__ import annotations

import copy
import ctypes
import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.integrators.integrator import State
from pbfd_torch.native.calls import Calls, whole
from pbfd_torch.native.carriers import parted, passed
from pbfd_torch.native.descent import Back, Path, Trail
from pbfd_torch.native.library import Library
from pbfd_torch.native.plan import Plan
from pbfd_torch.native.schemes import ON_POSITIONS, Scheme
from pbfd_torch.native.ways import Ways
from pbfd_torch.solvers.objective import FALLBACKS, Solution
from pbfd_torch.stepping.accuracy import Accuracy

COUNTED = ("status", "evaluations", "iterations", "hazards")
WORTH_A_BLOCK = 128  # steps of worlds: fewer are done about as soon as another thread has begun


class _Steps(ctypes.Structure):
    _fields_ = (
        ("dt", ctypes.c_void_p),
        *((name, ctypes.c_int) for name in ("alike", "halvings")),
        *((name, ctypes.c_double) for name in ("tolerance", "surplus", "share", "jump")),
        *((name, ctypes.c_int) for name in ("evaluations", "worlds", "first", "last", "steps", "held")),
        ("given", ctypes.c_void_p * 10),
        ("control", ctypes.c_void_p),
        ("found", ctypes.c_void_p * 10),
        ("residual_norm", ctypes.c_void_p),
        ("counted", ctypes.c_void_p * len(COUNTED)),
        ("fallbacks", ctypes.c_void_p),
        ("own", ctypes.c_void_p),
        ("trial", ctypes.c_void_p * 7),
        ("poses", ctypes.c_void_p),
        ("timed", ctypes.c_int),
        *((name, ctypes.c_void_p) for name in ("halved", "eased", "ends")),
        *((name, ctypes.c_double) for name in ("accuracy", "shortest")),
        *((name, ctypes.c_void_p) for name in ("wish", "pace", "spacing", "made")),
        ("before_last", ctypes.c_void_p * 10),
        ("trust", ctypes.c_double),
        ("estimate", ctypes.c_void_p),
        ("strike", ctypes.c_void_p),
    )


@dataclass(frozen=True)
class Terms:
    """What is asked of steps. dt [s], `[]`, or `[*batch]` of each world; halvings: how often they may be halved; tolerance of
    ‖r/scale‖; surplus: see `EnergyMomentum`; share: see `Variational`, 1 for implicit Euler; jump: see `Bdf2`; evaluations: at
    most, of each with all that is tried; trust: see `RungeKutta`, 0: no step is explicit."""

    dt: Tensor
    halvings: int
    tolerance: float
    surplus: float
    share: float
    jump: float
    evaluations: int
    trust: float = 0.0


class Journey:
    """Steps of all worlds: what they are to be made of, and room for what they come to.

    Attributes:
        given: what each world sets out from, `[*batch, ...]`, q first.
        control: `[steps, *batch, nu]`, or `[1, *batch, nu]` for all steps. own: see `Plan`.
        poses: of the obstacles that move, at the ends of all parts of all steps, see `Carriers.poses`.
        found: what it has after each step, `[*steps, *batch, ...]`; steps: how many, or nothing for a single one.
        residual_norm, counted, fallbacks: how each was solved, `[*steps, *batch, ...]`.
        ways: how it was made, of a single step, where that is asked for.
        frames: what there is beside, where steps are `Frames`.
    """

    def __init__(
        self,
        given: dict[str, Tensor],
        found: dict[str, Tensor],
        control: Tensor,
        steps: tuple[int, ...],
        own: Tensor,
        poses: Tensor,
        ways: Ways | None = None,
        frames: Frames | None = None,
    ) -> None:
        self.ways, self.frames = ways, frames
        self.given, self.found, self.poses = given, found, poses
        batch = tuple(given["q"].shape[:-1])
        self._steps, self._worlds = math.prod(steps), math.prod(batch)
        self.control = whole(control, (len(control), *batch, control.shape[-1]))
        self.own = whole(own, (*batch, own.shape[-1]))
        self.residual_norm = control.new_empty((*steps, *batch))
        first, *others = COUNTED
        self.counted = {first: torch.empty((*steps, *batch), dtype=torch.int32)}
        self.counted |= {name: torch.empty_like(self.counted[first]) for name in others}
        self._estimate: Tensor | None = None  # of explicit steps, see `Solution`
        self._strike: Tensor | None = None
        self.fallbacks = torch.empty((*steps, *batch, len(FALLBACKS)), dtype=torch.int32)

    def call(self, terms: Terms) -> _Steps:
        """What the core is to be asked."""
        alike = terms.dt.ndim == 0
        self._dt = terms.dt if alike else whole(terms.dt, tuple(self.given["q"].shape[:-1]))
        asked = _Steps(self._dt.data_ptr(), alike, terms.halvings)
        asked.tolerance, asked.surplus, asked.share, asked.jump = terms.tolerance, terms.surplus, terms.share, terms.jump
        asked.evaluations, asked.worlds, asked.last, asked.steps = terms.evaluations, self._worlds, self._worlds, self._steps
        asked.held, asked.control = len(self.control) == 1, self.control.data_ptr()
        asked.given[: len(self.given)] = [x.data_ptr() for x in self.given.values()]
        asked.found[: len(self.found)] = [x.data_ptr() for x in self.found.values()]
        asked.counted[:] = [x.data_ptr() for x in self.counted.values()]
        asked.residual_norm, asked.fallbacks = self.residual_norm.data_ptr(), self.fallbacks.data_ptr()
        asked.own = self.own.data_ptr()
        asked.trust = terms.trust
        if terms.trust > 0 and self.frames is None:
            self._estimate, self._strike = torch.empty_like(self.residual_norm), torch.empty_like(self.residual_norm)
            asked.estimate, asked.strike = self._estimate.data_ptr(), self._strike.data_ptr()
        asked.poses, asked.timed = self.poses.data_ptr(), self.poses.shape[1]
        if self.ways is not None:
            asked.halved, asked.eased, asked.ends = (x.data_ptr() for x in (self.ways.halved, self.ways.eased, self.ways.ends))
        if self.frames is not None:
            frames = self.frames
            asked.accuracy, asked.shortest = frames.accuracy.length, frames.accuracy.shortest
            asked.wish, asked.pace, asked.spacing, asked.made = (
                x.data_ptr() for x in (frames.wish, frames.pace, frames.spacing, frames.made)
            )
            asked.before_last[: len(frames.before_last)] = [x.data_ptr() for x in frames.before_last.values()]
        return asked

    def other(self, time: Tensor) -> dict[str, Tensor]:
        """What states after steps have besides the core's fields, at these times `[*steps, *batch]`."""
        pace = {} if self.frames is None else {"pace": self.frames.pace}
        return {"time": time, "hazards": self.counted["hazards"]} | pace

    @property
    def solution(self) -> Solution:
        """How the steps were solved, `[*steps, *batch, ...]`."""
        counted = {name: x for name, x in self.counted.items() if name != "hazards"}
        lanes = int(counted["evaluations"].sum())
        steps = None if self.frames is None else self.frames.made
        return Solution(
            self.found["q"],
            residual_norm=self.residual_norm,
            fallbacks=self.fallbacks,
            lanes=lanes,
            estimate=self._estimate,
            strike=self._strike,
            steps=steps,
            **counted,
        )


class Frames:
    """Room for what frames leave beside states: how long each world's next step had better be [s], the length of the last one, how
    many it has made, and the state before that, `[*steps, *batch, ...]`. wish: how long the first one had better be, `[*batch]`."""

    def __init__(self, accuracy: Accuracy, wish: Tensor, found: dict[str, Tensor]) -> None:
        self.accuracy, self.wish = accuracy, wish.contiguous()
        batch = found["q"].shape[:-1]
        self.pace, self.spacing = wish.new_empty(batch), wish.new_empty(batch)
        self.made = torch.empty(batch, dtype=torch.int32)
        self.before_last = {name: torch.empty_like(x) for name, x in found.items()}

    def part(self, first: int, last: int) -> Frames:
        """Frames first … last − 1 of them."""
        other = copy.copy(self)
        other.pace, other.spacing, other.made = (x[first:last] for x in (self.pace, self.spacing, self.made))
        other.before_last = {name: x[first:last] for name, x in self.before_last.items()}
        return other


class Core:
    """A scene's plan and a scheme's steps in the compiled library. `threads`: at most, of those that share a call's worlds. Raises
    `ValueError` where library and plan do not fit together."""

    def __init__(self, library: Library, plan: Plan, scheme: Scheme, terms: Terms, threads: int) -> None:
        self.plan, self._scheme, self._terms = plan, scheme, terms
        self._calls = Calls(library, plan, threads)

    def go(
        self, state: State, control: Tensor, steps: tuple[int, ...], accuracy: Accuracy | None = None, led: bool = False
    ) -> Journey:
        """Steps of all worlds from a state under controls `[steps, *batch, nu]`, or `[1, *batch, nu]` for all steps; frames of this
        accuracy, if any. led: whether it is to be known how each of several was made. On several threads where that is worth it:
        worlds do not know of each other, and it makes no difference to any."""
        given = self._scheme.fields(state, self.plan)
        found = {name: _room_for(x, steps) for name, x in given.items()}
        ways = None if (steps and not led) or accuracy else Ways(found["q"], self._terms.halvings)
        frames = None if accuracy is None else Frames(accuracy, self._wish(state), found)
        poses = self._poses(state.time, math.prod(steps))
        journey = Journey(given, found, control, steps, self.plan.own, poses, ways, frames)
        asked = journey.call(self._terms)
        self._calls.share(self._scheme.function, asked, asked.worlds, asked.worlds * asked.steps // WORTH_A_BLOCK)
        return journey

    def path(self, journeys: list[Journey], held: bool) -> Path:
        """Journeys, each of which goes on from the end of the last one, as steps that may be followed back. held: under one control
        for all steps."""
        first = journeys[0]
        found = {name: torch.cat([x.found[name] for x in journeys]) for name in first.found}
        trails = [Trail.of(x.ways) for x in journeys if x.ways is not None]
        control = first.control if held or len(journeys) == 1 else torch.cat([x.control for x in journeys])
        poses = torch.cat([first.poses, *(x.poses[1:] for x in journeys[1:])])
        return Path(first.given, found, control, poses, Trail.joined(trails))

    def back(
        self, path: Path, back: Back, seen: Mapping[str, Tensor | None], constant: Tensor | None = None, dropped: bool = False
    ) -> None:
        """Follows a path back, of a core of double precision. seen: derivatives by its fields after each step. constant: `[steps,
        *batch]`, whose ends count as constants; dropped: so do those with a singular J."""
        self._follow("back", path, back, seen, constant, dropped)

    def ahead(self, path: Path, start: Back, found: Mapping[str, Tensor], constant: Tensor | None, dropped: bool) -> None:
        """The same ahead: from changes of what the path was made of to those of its fields after each step, `found`."""
        self._follow("ahead", path, start, found, constant, dropped)

    def _follow(
        self, way: str, path: Path, back: Back, seen: Mapping[str, Tensor | None], constant: Tensor | None, dropped: bool
    ) -> None:
        asked = back.call(path, seen, constant, dropped)
        terms = self._terms
        alike = terms.dt.ndim == 0
        dt = terms.dt if alike else whole(terms.dt, tuple(path.given["q"].shape[:-1]))
        asked.dt, asked.alike, asked.halvings = dt.data_ptr(), alike, terms.halvings
        asked.share, asked.jump = terms.share, terms.jump
        own = whole(self.plan.own, (*path.given["q"].shape[:-1], self.plan.own.shape[-1]))
        asked.own = own.data_ptr()
        self._calls.share(f"{self._scheme.function}_{way}", asked, asked.worlds, asked.worlds * asked.steps // WORTH_A_BLOCK)

    def start(self, q: Tensor, v: Tensor, control: Tensor) -> tuple[Journey, Tensor]:
        """The fields of the states at t = 0 of all worlds at q `[*batch, nq]` with v `[*batch, nv]` under a control `[1, *batch,
        nu]`, and how their trial steps were solved; and where these have ended, `[*batch, nq]`."""
        given = {"q": whole(q, q.shape), "v": whole(v, v.shape)}
        poses = self._poses(torch.zeros_like(q[..., 0]), 1)
        journey = Journey(given, self._empty(self._scheme, q), control, (), self.plan.own, poses)
        asked = journey.call(self._terms)
        (_, *before), end = self._empty(ON_POSITIONS, q).values(), self._empty(ON_POSITIONS, q)
        asked.trial[:] = [x.data_ptr() for x in (*before, *end.values())]
        self._calls.share(self._scheme.start, asked, asked.worlds, asked.worlds // WORTH_A_BLOCK)
        return journey, end["q"]

    def _empty(self, scheme: Scheme, q: Tensor) -> dict[str, Tensor]:
        """Room for the fields of a state of worlds at q `[*batch, nq]`, its memory among them."""
        shapes = scheme.shapes(self.plan) | {"memory": (self.plan.remembered,)}
        return {name: q.new_empty((*q.shape[:-1], *shape)) for name, shape in shapes.items()}

    def _poses(self, time: Tensor, steps: int) -> Tensor:
        """Where the obstacles that move are at the ends of all parts of so many steps from a time `[*batch]` on."""
        if not self.plan.carriers:
            return time.new_empty(0, 1, 0, 12)
        step = self._terms.dt
        return self.plan.carriers.poses(parted(passed(time, step, steps), step, 2**self._terms.halvings))

    def _wish(self, state: State) -> Tensor:
        """How long the first step of a frame had better be."""
        return self._terms.dt.expand(state.time.shape) if state.pace is None else state.pace

    def balance(self, state: Velocities, control: Tensor | None, q: Tensor) -> tuple[Tensor, Tensor]:
        """The balance of forces of the energy–momentum step from a state at q `[*batch, nq]`: r `[*batch, nv]` and
        J `[*batch, nv, nv]`."""
        batch, (_, _, nv, nu) = tuple(state.q.shape[:-1]), self.plan.sizes[:4]
        held = q.new_zeros(1, *batch, nu) if control is None else control.expand(1, *batch, nu)
        journey = Journey(self._scheme.fields(state, self.plan), {}, held, (), self.plan.own, self._poses(state.time, 1))
        at, residual, jacobian = whole(q, q.shape), q.new_empty(*batch, nv), q.new_empty(*batch, nv, nv)
        addresses = [ctypes.c_void_p(x.data_ptr()) for x in (at, residual, jacobian)]
        self._calls.make("pbfd_balance", journey.call(self._terms), *addresses)
        return residual, jacobian


def _room_for(given: Tensor, steps: tuple[int, ...]) -> Tensor:
    """What a field `[*batch, ...]` becomes, `[*steps, *batch, ...]`."""
    return given.new_empty((*steps, *given.shape)) if steps else torch.empty_like(given)  # the quicker one
