"""Implicit Euler on positions, the paper's integrator (Eq. 4–5), with a second-order start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.integrators.integrator import Integrator, Starter, State, after, calm, fresh
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.load import StepContext, Term
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import difference, place, retract


@dataclass(frozen=True, eq=False, kw_only=True)
class Positions(State):
    """Attributes:
    q_previous: θ_{n−1} `[*batch, nq]`.
    acceleration: over the last two steps `[*batch, nv]`, zero after an impact; a change of Δt needs it. None: not known, zero.
    """

    q_previous: Tensor
    acceleration: Tensor | None = None


@dataclass(frozen=True)
class ImplicitEuler:
    """κ = 1/Δt², T̂ = 2T_n − T_{n−1} + Δt² [0 | g]. First order in Δt; never gains energy on the smooth part."""

    @property
    def easier(self) -> Sequence[Integrator[Positions]]:
        """None: nothing is easier."""
        return ()

    @property
    def coordinates(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """See `Integrator`."""
        return ("q", "q_previous"), ()

    def adapted(self, articulation: Articulation, terms: Sequence[Term], dt: Tensor) -> Sequence[Term]:
        """The terms themselves, all implicit."""
        return terms

    def start(self, starter: Starter, q: Tensor, v: Tensor, control: Tensor | None) -> Positions:
        """θ_{−1} = θ_0 − Δt v + ½ Δt² a. Leaving out a would shift the whole motion by half a step's impulse (METHOD §5). Stiff
        contacts are felt as they will be, because a comes from a trial step."""
        return self.at_rate(starter.articulation, q, v, starter.trial(q, v, control).acceleration, starter.step_size)

    def at_rate(self, articulation: Articulation, q: Tensor, v: Tensor, acceleration: Tensor, dt: Tensor) -> Positions:
        """State at t = 0 of a motion at constant acceleration `[*batch, nv]`."""
        h = dt[..., None]
        before = retract(articulation, q, 0.5 * h * h * acceleration - h * v)
        return Positions(**fresh(q), q_previous=before, acceleration=acceleration)

    def velocity(self, articulation: Articulation, state: Positions, dt: Tensor) -> Tensor:
        """Average velocity over the step that ends at t_n (Eq. 3), `[*batch, nv]`."""
        return difference(articulation, state.q_previous, state.q) / dt[..., None]

    def pose_rates(self, articulation: Articulation, state: Positions, dt: Tensor) -> Tensor:
        """Average rate of change of the link poses over that step, `[*batch, nlink, 3, 4]`."""
        moved = place(articulation, state.q).poses - place(articulation, state.q_previous).poses
        return moved[..., :3, :] / dt[..., None, None, None]

    def context(
        self, articulation: Articulation, state: Positions, dt: Tensor, gravity: Tensor, control: Tensor | None
    ) -> StepContext:
        """See `Integrator`."""
        now, before = place(articulation, state.q), place(articulation, state.q_previous)
        return StepContext(
            dt=dt,
            previous=now,
            weight=1 / (dt * dt),
            target_poses=fallen(2 * now.poses - before.poses, (dt * dt)[..., None, None] * gravity[..., None, :]),
            target_q=retract(articulation, state.q, difference(articulation, state.q_previous, state.q)),
            control=control,
            time=state.time,
            gravity=gravity,
        )

    def advance(self, objective: BalanceObjective, state: Positions, q: Tensor) -> tuple[Positions, None]:
        """See `Integrator`."""
        a, h = objective.articulation, objective.step.dt[..., None]
        gained = difference(a, state.q, q) / h - self.velocity(a, state, objective.step.dt)
        smooth = calm(objective, objective.step.previous, gained)[..., None]
        acceleration = torch.where(smooth, gained / h, 0.0)
        return Positions(**after(objective, place(a, q)), q_previous=state.q, acceleration=acceleration), None

    def halves(self, objective: BalanceObjective, end: State, solved: Tensor) -> Tensor:
        """Never: an easier step is good enough."""
        return torch.zeros_like(solved, dtype=torch.int32)

    def resized(self, articulation: Articulation, state: Positions, dt: Tensor, new: Tensor) -> Positions:
        """See `Integrator`."""
        h, k = dt[..., None], new[..., None]
        back = k / h * difference(articulation, state.q, state.q_previous)
        if state.acceleration is not None:
            back = back - 0.5 * k * (h - k) * state.acceleration
        return replaced(state, q_previous=retract(articulation, state.q, back))


def fallen(poses: Tensor, fall: Tensor) -> Tensor:
    """Poses `[*batch, nlink, 4, 4]` moved by `fall` `[*, 1, 3]` [m]."""
    moved = torch.zeros_like(poses)
    moved[..., :3, 3] = fall
    return poses + moved
