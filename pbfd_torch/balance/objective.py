"""The balance of forces at the end of a step, as a solver sees it, and its energy where forces are conservative."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import torch
from torch import Tensor

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.balance.dynamics import armature_diagonal, kinetic_energy
from pbfd_torch.balance.outlook import Outlook
from pbfd_torch.errors import InputError
from pbfd_torch.solvers.objective import Evaluation, weighted_error
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_springs import Armature
from pbfd_torch.terms.load import (
    Aftermath,
    Foreboding,
    Frictional,
    Hazardous,
    Inert,
    Load,
    OneSided,
    Potential,
    Pushing,
    Remembering,
    StepContext,
    Term,
)
from pbfd_torch.tree.articulation import Articulation, force_scale, lever, reach
from pbfd_torch.tree.kinematics import Placement, difference, place, retract

NEGLIGIBLE = 0.1  # of the scale, at most, may be left to rounding
FARTHEST = 0.5 * math.pi  # [rad] that contacts may turn a joint by in a step
ABSURD = 1e6  # what drives the bodies may move them by so many times their extent in a step, or [rad]


@dataclass(frozen=True, eq=False)
class BalanceObjective:
    """r(θ) of one step for all worlds: the root of Eq. 13.

    Attributes:
        articulation, terms, step: what acts, in which step.
        memory, prepared: what the terms that remember something knew before it, and what each term prepared for it.
        scale: `[*batch, nv]` the size of a force that counts as one, see `force_scale`.
        extent: `[*batch, nv]` size of what is rounded in each coordinate: the distance from the world's origin [m], or 1 rad.
        rounding: `[*batch, nv]` the size of the rounding error in r that inertia leaves, see `inertia_rounding`.
    """

    articulation: Articulation
    terms: Sequence[Term]
    step: StepContext
    memory: tuple[Tensor, ...]
    prepared: Sequence[Any]
    scale: Tensor
    extent: Tensor
    rounding: Tensor

    @classmethod
    def of_step(
        cls, articulation: Articulation, terms: Sequence[Term], step: StepContext, scale: Tensor, memory: tuple[Tensor, ...] = ()
    ) -> BalanceObjective:
        """Prepares every term for the step; memory: of the terms that remember something, empty at a fresh start."""
        memory = memory or blank_memory(terms, step.target_q.shape[:-1])
        prepared = _prepared(terms, step, memory)
        far = step.previous.poses[..., :3, 3].abs().amax((-2, -1)) + reach(articulation)
        turns = articulation.topology.turns
        extent = torch.where(turns, torch.ones_like(far)[..., None], far[..., None])
        return cls(articulation, terms, step, memory, prepared, scale, extent, inertia_rounding(articulation, terms, step, far))

    @property
    def guess(self) -> Tensor:
        """`[*batch, nq]` where the integrator expects the step to end."""
        return self.step.target_q if self.step.guess is None else self.step.guess

    def loads(self, placement: Placement) -> list[Load]:
        """Every term's load at a placement."""
        return [term.load(prepared, placement) for term, prepared in zip(self.terms, self.prepared, strict=True)]

    def evaluate(self, q: Tensor) -> Balance:
        """Residual, Jacobian and stiffness at q."""
        placement = place(self.articulation, q)
        return Balance(placement, self.loads(placement))

    def outlook(self, evaluation: Balance, direction: Tensor) -> Outlook:
        """What the work along a direction `[*batch, nv]` from an evaluated point is going to be."""
        return Outlook(self.terms, self.prepared, evaluation, direction)

    def error(self, evaluation: Evaluation, tolerance: float) -> Tensor:
        """‖r / (scale + rounding/tolerance)‖₂ `[*batch]`; the rounding is that of inertia and, for worlds that are not solved with
        it, of what the Jacobian makes of coordinates that are rounded themselves: stiff friction feels a displacement of ε|x|."""
        whole = weighted_error(evaluation.residual, self.scale, torch.zeros_like(self.rounding), tolerance)
        least = tolerance / NEGLIGIBLE * whole
        strict = torch.maximum(weighted_error(evaluation.residual, self.scale, self.rounding, tolerance), least)
        solved = strict <= tolerance
        # what is in the host's own memory it may look at; asking a device would make it wait
        if strict.device.type == "cpu" and bool((solved | ~torch.isfinite(strict)).numpy().all()):
            return strict
        epsilon = 2 * torch.finfo(self.scale.dtype).eps
        felt = (evaluation.jacobian.abs() * self.extent[..., None, :]).sum(-1)
        lenient = weighted_error(evaluation.residual, self.scale, self.rounding + epsilon * felt, tolerance)
        return torch.where(solved, strict, torch.maximum(lenient, least))

    def absurd(self, evaluation: Balance) -> Tensor:
        """Where the forces are not to be balanced, and no search shall try: what drives the bodies, contacts and limits left out,
        which only answer, would move them by more than `ABSURD` times their extent, `[*batch]` bool."""
        driving = [
            load
            for term, load in zip(self.terms, evaluation.loads, strict=True)
            if not isinstance(term, Inertia | Armature | Pushing)
        ]
        force = Balance(evaluation.placement, driving).residual
        # the rounding is that of κ m x
        return (force.abs() / self.rounding * (8 * torch.finfo(self.rounding.dtype).eps)).amax(-1) > ABSURD

    def retract(self, q: Tensor, step: Tensor) -> Tensor:
        """q moved by the tangent vector `step`."""
        return retract(self.articulation, q, step)

    def turn(self, step: Tensor) -> Tensor:
        """Largest rotation [rad] of one joint in a tangent step, `[*batch]`."""
        return (step.abs() * self.articulation.topology.turns.to(step.dtype)).amax(-1)

    def take(self, index: Tensor) -> Self:
        """The same step of some worlds only."""
        worlds = Worlds(self.guess.shape[:-1], index)
        terms = [term.take(worlds) for term in self.terms]
        step = self.step.take(worlds)
        memory = tuple(map(worlds.rows, self.memory))
        return dataclasses.replace(
            self,
            articulation=step.previous.articulation,
            terms=terms,
            step=step,
            memory=memory,
            prepared=_prepared(terms, step, memory),
            scale=worlds.pick(self.scale, 1),
            extent=worlds.pick(self.extent, 1),
            rounding=worlds.pick(self.rounding, 1),
        )

    def softened(self, factor: float) -> Self:
        """The same step with contacts and joint limits `factor` times as stiff."""
        return self._with([term.softened(factor) if isinstance(term, OneSided) else term for term in self.terms])

    def widened(self, factor: float) -> Self:
        """The same step with friction smooth over `factor` times as wide a range of slip."""
        return self._with([term.widened(factor) if isinstance(term, Frictional) else term for term in self.terms])

    def shortened(self, share: float) -> Self:
        """The same step with the inertial forces of one that is `share` ≤ 1 times as long: it ends the nearer to its start."""
        terms = [term.shortened(share) if isinstance(term, Inert) else term for term in self.terms]
        prepared = [
            new.prepare(self.step) if isinstance(new, Inert) else old for new, old in zip(terms, self.prepared, strict=True)
        ]
        return dataclasses.replace(self, terms=terms, prepared=prepared)

    def strayed(self, q: Tensor) -> Tensor:
        """Whether a step that ended at q has turned a joint by more than a quarter turn, and not because its free motion leads
        there, with more kinetic energy than the free motion has, while something touches, `[*batch]` bool: such a root need not
        be where the motion goes. What strikes may fold up fast; what stands may not turn over."""
        a, step = self.articulation, self.step
        far = torch.minimum(*(self.turn(difference(a, x, q)) for x in (step.previous.q, self.guess))) > FARTHEST
        moved, free = (
            kinetic_energy(a, (poses - step.previous.poses)[..., :3, :]) for poses in (place(a, q).poses, step.target_poses)
        )
        return far & (self.push(q) > 0) & (moved > free)

    def seen_from(self, distance: float) -> Self:
        """The same step with normal forces that set in `distance` [m] before anything touches."""
        return self._with([term.seen_from(distance) if isinstance(term, Foreboding) else term for term in self.terms])

    def lagged(self, q: Tensor) -> EnergyObjective:
        """The step whose friction feels the normal forces at q whatever comes: its balance is the gradient of an energy."""
        placement = place(self.articulation, q)
        terms = [
            term.lagged(prepared, placement) if isinstance(term, Frictional) else term
            for term, prepared in zip(self.terms, self.prepared, strict=True)
        ]
        return EnergyObjective(
            self.articulation, terms, self.step, self.memory, self.prepared, self.scale, self.extent, self.rounding
        )

    def aftermath(self, placement: Placement) -> Aftermath:
        """What a step that ended at a placement leaves behind."""
        hazards = torch.zeros_like(placement.q[..., 0], dtype=torch.int32)
        watching = any(isinstance(term, Hazardous) for term in self.terms)
        if not watching and not any(x.numel() for x in self.memory):
            return Aftermath(self.memory, hazards)
        with torch.no_grad():  # hazards do not change smoothly
            turned = self.turned(placement)
        memory = []
        for term, prepared in zip(self.terms, self.prepared, strict=True):
            if isinstance(term, Remembering):
                memory.append(term.remembered(prepared, placement))
            if isinstance(term, Hazardous):
                with torch.no_grad():
                    hazards = hazards | term.hazards(prepared, placement, turned)
        return Aftermath(tuple(memory), hazards)

    def turned(self, placement: Placement, angle: float = FARTHEST) -> Tensor:
        """The links that have turned by more than an angle [rad] in a step that ended at a placement, `[*batch, nlink]` bool."""
        before, now = (x.poses[..., :3, :3] for x in (self.step.previous, placement))
        return (before * now).sum((-2, -1)) < 1 + 2 * math.cos(angle)  # the trace of the rotation between them

    def forces(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Everything but inertia at the end of a step: what contacts and limits do, and the rest, each `[*batch, nv]`."""
        placement = place(self.articulation, q)
        abrupt: list[Load] = []
        others: list[Load] = []
        for term, load in zip(self.terms, self.loads(placement), strict=True):
            if not isinstance(term, Inertia | Armature):
                (abrupt if isinstance(term, Pushing) else others).append(load)
        return -Balance(placement, abrupt).residual, -Balance(placement, others).residual

    def push(self, q: Tensor) -> Tensor:
        """How hard contacts and limits push in all at the end of a step, in weights of the articulation, `[*batch]`."""
        placement = place(self.articulation, q)
        total = torch.zeros_like(q[..., 0])
        for term, prepared in zip(self.terms, self.prepared, strict=True):
            if isinstance(term, Pushing):
                total = total + term.push(prepared, placement)
        return total / (self.scale / lever(self.articulation))[..., 0]

    def _with(self, terms: Sequence[Term]) -> Self:
        return dataclasses.replace(self, terms=terms)


@dataclass(frozen=True, eq=False)
class EnergyObjective(BalanceObjective):
    """E(θ) of one step (Eq. 6), where every load is the gradient of an energy: friction must be lagged or absent. Raises
    `InputError` for a term that has no energy."""

    def __post_init__(self) -> None:
        for term in self.terms:
            if not isinstance(term, Potential):
                raise InputError(f"{type(term).__name__} has no energy: a step with it can be solved as a balance of forces only")

    def evaluate(self, q: Tensor) -> Energy:
        """Energy, gradient and Hessian at q."""
        placement = place(self.articulation, q)
        return Energy(placement, self.loads(placement), self)

    def energy(self, placement: Placement) -> Tensor:
        """E [J] `[*batch]`, up to a constant."""
        total = torch.zeros((), dtype=self.scale.dtype, device=self.scale.device)
        for term, prepared in zip(self.terms, self.prepared, strict=True):
            if isinstance(term, Potential):
                total = total + term.energy(prepared, placement)
        return total


class Energy(Balance):
    """The balance of an `EnergyObjective`, with the energy itself."""

    def __init__(self, placement: Placement, loads: Sequence[Load], objective: EnergyObjective) -> None:
        super().__init__(placement, loads)
        self._objective = objective

    @cached_property
    def value(self) -> Tensor:
        """E [J] `[*batch]`."""
        return self._objective.energy(self.placement)


def blank_memory(terms: Sequence[Term], batch: tuple[int, ...]) -> tuple[Tensor, ...]:
    """What the terms remember at a fresh start."""
    return tuple(term.memory(batch) for term in terms if isinstance(term, Remembering))


def _prepared(terms: Sequence[Term], step: StepContext, memory: tuple[Tensor, ...]) -> list[Any]:
    memories = iter(memory)
    return [term.recall(step, next(memories)) if isinstance(term, Remembering) else term.prepare(step) for term in terms]


def inertia_rounding(articulation: Articulation, terms: Sequence[Term], step: StepContext, far: Tensor) -> Tensor:
    """Rounding error `[*batch, nv]` left in the inertial forces [N, N m]: they are κ m times differences of positions x that were
    rounded to ε|x|. It grows with 1/Δt² and with the distance `far` `[*batch]` [m] from the world's origin."""
    moved = far[..., None] * force_scale(articulation, 1.0) + armature_diagonal(articulation, terms)
    return 8 * torch.finfo(far.dtype).eps * step.weight[..., None] * moved
