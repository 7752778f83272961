"""What a term gives to the assembly: a load on links or on joints, and its stiffness; and what a term looks like."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Chord, Motion, Placement, place


@dataclass(frozen=True, eq=False)
class StepContext:
    """What is known before a step is solved; a term's `prepare` reads it.

    Attributes:
        dt: step [s], a scalar tensor or `[*batch]`.
        previous: the placement at the start of the step, θ_n.
        weight: κ [1/s²] of the integrator, like dt.
        target_poses: T̂ `[*batch, nlink, 4, 4]`, gravity folded in: inertia pulls the link poses there.
        target_q: q̂ `[*batch, nq]`: where inertia pulls the joints' own rotors (armature).
        control: `[*batch, nu]` or None.
        time: [s] at the start, like dt.
        share: w `[*batch]`, where on the chord from the start of the step to its end inertia does its virtual work; None: at
            its end, as in the paper.
        gravity: `[*batch, 3]` [m/s²], or one for all; the target poses hold it.
        guess: `[*batch, nq]` where the step may end; None: at target_q.
    """

    dt: Tensor
    previous: Placement
    weight: Tensor
    target_poses: Tensor
    target_q: Tensor
    control: Tensor | None
    time: Tensor
    gravity: Tensor
    share: Tensor | None = None
    guess: Tensor | None = None

    @property
    def coasting_poses(self) -> Tensor:
        """Where the links would end without any force, as far as gravity is all there is, `[*batch, nlink, 4, 4]`."""
        poses = self.target_poses.clone()
        poses[..., :3, 3] -= (self.dt * self.dt)[..., None, None] * self.gravity[..., None, :]
        return poses

    def take(self, worlds: Worlds) -> StepContext:
        """The step of some worlds."""
        before = self.previous
        return StepContext(
            dt=worlds.pick(self.dt, 0),
            previous=place(before.articulation.take(worlds), worlds.pick(before.q, 1)),
            weight=worlds.pick(self.weight, 0),
            target_poses=worlds.pick(self.target_poses, 3),
            target_q=worlds.pick(self.target_q, 1),
            control=worlds.pick(self.control, 1),
            time=worlds.pick(self.time, 0),
            gravity=worlds.pick(self.gravity, 1),
            share=worlds.pick(self.share, 0),
            guess=worlds.pick(self.guess, 1),
        )


class LinkLoad:
    """Loads on links, in world coordinates about the world origin. The matrices are computed when first asked for.

    moment: `[*batch, nlink, 3, 4]` [G | g] of METHOD §3: minus the first moment Σ f p̄ᵀ of the forces [N m | N]. coupled: whether
    the wrench on one link answers the twist of another. outlook: of forces that set in or change abruptly: takes a motion from the
    load's placement to the work r·d [J] of its forces, d the motion's velocity, where links have moved to second order in the
    length a: `[k, *batch] → [k, *batch]`; without it the load is taken to change linearly."""

    def __init__(
        self,
        moment: Tensor,
        stiffness: Callable[[], Tensor],
        coupling: Callable[[], Tensor] | None = None,
        outlook: Callable[[Motion], Callable[[Tensor], Tensor]] | None = None,
    ) -> None:
        self.moment = moment
        self.coupled = coupling is not None
        self._stiffness = stiffness
        self._coupling = coupling
        self.outlook = outlook

    @cached_property
    def stiffness(self) -> Tensor:
        """A `[*batch, nlink, 6, 6]`: how the wrench (torque, force) answers a twist (ω, v) of the link, axes held still."""
        return self._stiffness()

    @cached_property
    def coupling(self) -> Tensor:
        """`[*batch, nlink, nlink, 6, 6]`: how the wrench on the first link answers a twist of the second, another one; zero unless
        `coupled`."""
        if self._coupling is None:
            links = self.moment.shape[-3]
            return self.moment.new_zeros((*self.moment.shape[:-2], links, 6, 6))
        return self._coupling()


class ChordLoad:
    """Loads on links that do their virtual work on the chord of the step; smooth. The matrices are computed when first asked for.

    chord: where. moment: `[*batch, nlink, 3, 4]` as of a `LinkLoad`, of points on the chord. stiffness: `[*batch, nlink, 6, 6]` how
    the wrench on points on the chord answers a twist of the link at the chord's end. moment_at_end: the same forces' moment about
    the points at the chord's end."""

    def __init__(self, chord: Chord, moment: Tensor, stiffness: Callable[[], Tensor], moment_at_end: Callable[[], Tensor]) -> None:
        self.chord = chord
        self.moment = moment
        self._stiffness = stiffness
        self._moment_at_end = moment_at_end

    @cached_property
    def stiffness(self) -> Tensor:
        return self._stiffness()

    @cached_property
    def moment_at_end(self) -> Tensor:
        return self._moment_at_end()


class JointLoad:
    """Loads on degrees of freedom: `residual` `[*batch, nv]`, minus the generalised force. The stiffness is computed when first
    asked for."""

    def __init__(self, residual: Tensor, stiffness: Callable[[], Tensor]) -> None:
        self.residual = residual
        self._stiffness = stiffness

    @cached_property
    def stiffness(self) -> Tensor:
        """Its derivative by the degrees of freedom `[*batch, nv, nv]`."""
        return self._stiffness()


Load = LinkLoad | ChordLoad | JointLoad


class Term(Protocol):
    """One physical effect: an immutable object with its parameters."""

    def prepare(self, step: StepContext) -> Any:
        """What stays fixed while θ_{n+1} is iterated."""
        ...

    def load(self, prepared: Any, placement: Placement) -> Load:
        """The load at a placement, and its stiffness; a pure function of its arguments."""
        ...

    def take(self, worlds: Worlds) -> Self:
        """The same effect with the parameters of some worlds."""
        ...


@runtime_checkable
class OneSided(Protocol):
    """A stiff term that pushes on one side only: contact, limits."""

    def softened(self, factor: float) -> Term:
        """The same term, `factor` times as stiff; works with what the original prepared."""
        ...


@runtime_checkable
class Inert(Protocol):
    """A term of inertial forces."""

    def shortened(self, share: float) -> Term:
        """The same term as a step has it that is `share` ≤ 1 times as long, and leads as far as it would by its speed."""
        ...


@runtime_checkable
class Foreboding(Protocol):
    """A term with normal forces, for derivatives that are to know of contacts before they happen."""

    def seen_from(self, distance: float) -> Term:
        """The same term, whose normal forces set in softly at `distance` > 0 [m]; works with what the original prepared."""
        ...


@runtime_checkable
class Flowing(Protocol):
    """A term whose load is known at an instant, and changes smoothly."""

    def flow(self, placement: Placement, v: Tensor, control: Tensor | None) -> Load:
        """Its load where the velocity is v `[*batch, nv]` under a control `[*batch, nu]`; its stiffness is not asked for."""
        ...


@runtime_checkable
class Pushing(Protocol):
    """A term that sets in abruptly when things meet."""

    def push(self, prepared: Any, placement: Placement) -> Tensor:
        """The sizes of its one-sided forces summed up [N] `[*batch]`, torques by the articulation's reach."""
        ...


@runtime_checkable
class Remembering(Protocol):
    """A term that carries something from step to step; it is part of the state."""

    def memory(self, batch: tuple[int, ...]) -> Tensor:
        """What it remembers at a fresh start, `[*batch, ...]`."""
        ...

    def recall(self, step: StepContext, memory: Tensor) -> Any:
        """`prepare`, knowing what was remembered at the end of the last step."""
        ...

    def remembered(self, prepared: Any, placement: Placement) -> Tensor:
        """What it remembers after a step that ended at a placement."""
        ...


@dataclass(frozen=True, eq=False)
class Aftermath:
    """What a step leaves behind besides where it ended.

    Attributes:
        memory: of the terms that remember something, each `[*batch, ...]`.
        hazards: `[*batch]` int, `Hazard` bits.
    """

    memory: tuple[Tensor, ...]
    hazards: Tensor


@runtime_checkable
class Hazardous(Protocol):
    """A term that can tell what may be wrong with a step although it was solved."""

    def hazards(self, prepared: Any, placement: Placement, turned: Tensor) -> Tensor:
        """`Hazard` bits of a step that ended at a placement, `[*batch]` int; turned: `[*batch, nlink]` bool, the links that have
        turned far in it."""
        ...

    def dangers(self, articulation: Articulation) -> tuple[str, ...]:
        """Names of what may be in danger."""
        ...

    def strain(self, prepared: Any, placement: Placement, turned: Tensor) -> tuple[Tensor, Tensor]:
        """How deep everything is at a placement that ends the prepared step, as a share of the depth that is a hazard, one more
        where it touches a link that has turned far; and its place among `dangers`; `[*batch, n]` each."""
        ...


@runtime_checkable
class Conservative(Protocol):
    """A term that stores energy."""

    def potential(self, placement: Placement, time: Tensor) -> Tensor:
        """Stored energy [J] `[*batch]` at a time [s]."""
        ...


@runtime_checkable
class Potential(Protocol):
    """A term whose load is the gradient of a scalar; that of a term with friction from a normal force only once it is lagged."""

    def energy(self, prepared: Any, placement: Placement) -> Tensor:
        """That scalar [J] `[*batch]` at a placement that ends the prepared step, up to a constant: a summand of E (Eq. 6)."""
        ...


@runtime_checkable
class Frictional(Protocol):
    """A term with dry friction."""

    def widened(self, factor: float) -> Term:
        """The same friction, smooth over a `factor` ≥ 1 times wider range of slip speeds; works with what the original prepared."""
        ...

    def lagged(self, prepared: Any, placement: Placement) -> Term:
        """The same term with its friction held at the normal forces of this placement, which makes it a gradient; works with what
        the original prepared."""
        ...


def diagonal_load(residual: Tensor, stiffness: Tensor) -> JointLoad:
    """A joint load whose stiffness `[*batch, nv]` couples no two degrees of freedom."""
    return JointLoad(residual, lambda: torch.diag_embed(stiffness.expand_as(residual)))
