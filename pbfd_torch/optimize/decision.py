"""What shooting may choose: a vector x per world, and the start and the controls that follow from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.identify.levenberg_marquardt import Bounds
from pbfd_torch.integrators.integrator import S, State
from pbfd_torch.optimize.limits import Limits
from pbfd_torch.simulator import Simulator
from pbfd_torch.tensors.structures import mapped_tensors

C = TypeVar("C", bound=State, covariant=True)


@dataclass(frozen=True, eq=False)
class Plan(Generic[C]):
    """A start and controls `[T, *batch, nu]`, or none for `steps` without control."""

    start: C
    controls: Tensor | None
    steps: int


class Decision(Protocol[C]):
    """Gives meaning to x. Another choice, such as a parameter of a gait, is another class like those below."""

    @property
    def bounds(self) -> Bounds:
        """Of x, and the size of changes that matter."""
        ...

    def plan(self, x: Tensor) -> Plan[C]:
        """Of x `[*copies, *batch, n]`, differentiable."""
        ...


@dataclass(frozen=True, eq=False)
class Controls(Generic[S]):
    """The controls from a given start.

    Attributes:
        start: `[*batch]`.
        limits: of each control, `[nu]`; finite ones say what changes matter, others take 1.
        steps: T.
        held: how many steps a control is held for; fewer unknowns, smoother motions.
    """

    start: S
    limits: Limits
    steps: int
    held: int = 1

    def __post_init__(self) -> None:
        for name in ("steps", "held"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}: must be ≥ 1")
        if self.limits.lower.ndim != 1:
            raise InputError(f"limits have shape {tuple(self.limits.lower.shape)}: must be [nu]")

    @property
    def count(self) -> int:
        """How many controls are chosen one after the other."""
        return -(-self.steps // self.held)

    @property
    def bounds(self) -> Bounds:
        """See `Decision`."""
        lower, upper = self.limits.lower, self.limits.upper
        width = 0.5 * (upper - lower)
        scale = torch.where(torch.isfinite(width), width, torch.ones_like(width))
        return Bounds(*(value.repeat(self.count) for value in (lower, upper, scale)))

    def x(self, controls: Tensor) -> Tensor:
        """The x `[*batch, n]` of controls `[count, *batch, nu]`."""
        return controls.movedim(0, -2).flatten(-2)

    def plan(self, x: Tensor) -> Plan[S]:
        """See `Decision`."""
        each = x.unflatten(-1, (self.count, -1)).movedim(-2, 0)
        copies = x.shape[: x.ndim - 1 - self.start.time.ndim]
        start: S = mapped_tensors(self.start, lambda value: value.expand(*copies, *value.shape))
        return Plan(start, each.repeat_interleave(self.held, 0)[: self.steps], self.steps)


@dataclass(frozen=True, eq=False)
class StartVelocity(Generic[S]):
    """Velocities at the start, without control.

    Attributes:
        simulator, steps: which motion.
        q: `[nq]` or `[*batch, nq]`; v: `[nv]` or `[*batch, nv]` of what is not chosen.
        free: indices of the n velocities that are.
        bounds: of those.
    """

    simulator: Simulator[S]
    steps: int
    q: Tensor
    v: Tensor
    free: tuple[int, ...]
    bounds: Bounds

    def __post_init__(self) -> None:
        nv = self.simulator.articulation.nv
        if len(set(self.free)) != len(self.free) or not all(0 <= k < nv for k in self.free):
            raise InputError(f"free is {self.free}: must be different numbers from 0 to {nv - 1}")
        if self.bounds.scale.shape != (len(self.free),):
            raise InputError(f"bounds are of {len(self.bounds.scale)} velocities, {len(self.free)} are free: must be as many")

    def plan(self, x: Tensor) -> Plan[S]:
        """See `Decision`."""
        batch, index = x.shape[:-1], torch.tensor(self.free, device=x.device)
        v = self.v.expand(*batch, self.v.shape[-1]).index_copy(-1, index, x)
        return Plan(self.simulator.initial_state(self.q.expand(*batch, self.q.shape[-1]).contiguous(), v), None, self.steps)
