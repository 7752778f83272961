"""Implicit Euler on positions, the paper's integrator (Eq. 4–5), with a second-order start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.articulation import Articulation
from pbfd_torch.kinematics import difference, place, retract
from pbfd_torch.terms.load import Aftermath, StepContext
from pbfd_torch.worlds import Worlds, replaced


@dataclass(frozen=True, eq=False)
class State:
    """What implicit Euler needs to go on.

    Attributes:
        q, q_previous: the last two configurations `[*batch, nq]`, θ_n and θ_{n−1}.
        time: t_n `[*batch]` [s]; obstacles move by it.
        hazards: `Hazard` bits of the step that ended here, `[*batch]` int.
        memory: what the terms that remember something have from it, each `[*batch, ...]`; empty: nothing yet.
    """

    q: Tensor
    q_previous: Tensor
    time: Tensor
    hazards: Tensor
    memory: tuple[Tensor, ...] = ()

    def take(self, worlds: Worlds) -> Self:
        """The state of some worlds."""
        return replaced(
            self,
            q=worlds.pick(self.q, 1),
            q_previous=worlds.pick(self.q_previous, 1),
            time=worlds.pick(self.time, 0),
            hazards=worlds.pick(self.hazards, 0),
            memory=tuple(map(worlds.rows, self.memory)),
        )


@dataclass(frozen=True)
class ImplicitEuler:
    """κ = 1/Δt², T̂ = 2T_n − T_{n−1} + Δt² [0 | g]. First order in Δt; never gains energy on the smooth part."""

    def start(self, articulation: Articulation, q: Tensor, v: Tensor, acceleration: Tensor, dt: Tensor) -> State:
        """State at t = 0 of the motion with velocity v and acceleration `[*batch, nv]`: θ_{−1} = θ_0 − Δt v + ½ Δt² a. Leaving out
        a would shift the whole motion by half a step's impulse (METHOD §5)."""
        h = dt[..., None]
        before = retract(articulation, q, 0.5 * h * h * acceleration - h * v)
        time = torch.zeros_like(q[..., 0])
        return State(q, before, time, torch.zeros_like(time, dtype=torch.int32))

    def velocity(self, articulation: Articulation, state: State, dt: Tensor) -> Tensor:
        """Average velocity over the step that ends at t_n (Eq. 3), `[*batch, nv]`."""
        return difference(articulation, state.q_previous, state.q) / dt[..., None]

    def pose_rates(self, articulation: Articulation, state: State, dt: Tensor) -> Tensor:
        """Average rate of change of the link poses over that step, `[*batch, nlink, 3, 4]`; its momentum is the one that is
        kept."""
        moved = place(articulation, state.q).poses - place(articulation, state.q_previous).poses
        return moved[..., :3, :] / dt[..., None, None, None]

    def context(self, articulation: Articulation, state: State, dt: Tensor, gravity: Tensor, control: Tensor | None) -> StepContext:
        """What is fixed during the step from `state`."""
        now = place(articulation, state.q)
        before = place(articulation, state.q_previous)
        target = 2 * now.poses - before.poses
        fall = torch.zeros_like(target)
        fall[..., :3, 3] = (dt * dt)[..., None, None] * gravity[..., None, :]
        return StepContext(
            dt=dt,
            previous=now,
            weight=1 / (dt * dt),
            target_poses=target + fall,
            target_q=retract(articulation, state.q, difference(articulation, state.q_previous, state.q)),
            control=control,
            time=state.time,
        )

    def resized(self, articulation: Articulation, state: State, dt: Tensor, new: Tensor) -> State:
        """The state as seen by steps of another length: at the same place with the same velocity."""
        v = self.velocity(articulation, state, dt)
        return replaced(state, q_previous=self.start(articulation, state.q, v, torch.zeros_like(v), new).q_previous)

    def advance(self, state: State, q: Tensor, dt: Tensor, aftermath: Aftermath) -> State:
        """The state after a step of length dt that ended at q."""
        return State(q, state.q, state.time + dt, aftermath.hazards, aftermath.memory)
