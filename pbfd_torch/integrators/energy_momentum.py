"""The projected energy–momentum scheme: second order, conserving, and implicit Euler where something touches.

Every link's pose T moves as T_{n+1} = T_n + Δt (V_n + V_{n+1})/2, and inertial forces S (V_{n+1} − V_n)/Δt do their virtual work in
the middle of the step's chord, ŝ̄ T̄ with T̄ = (T_n + T_{n+1})/2. All constraints of a tree of hinges, balls and free joints are at
most quadratic in the poses, so T_{n+1} − T_n is one of these virtual displacements, and energy and both momenta are conserved as
long as V is carried on; one joint turns by less than half a turn per step, by 2 atan(Δt ω/2). But V_{n+1} does not fit the joints
exactly, and what is off does not decay: so only the part of it that does is kept, v = M⁻¹⟨S V, ∂T/∂θ⟩. That keeps the momenta, and
takes O(Δt³) of energy.

Contact, limits and dry friction must not be carried on as a trapezoidal rule would, which throws bodies back: a force f moves the
bodies by Δt² a, a = M⁻¹f, as in implicit Euler, and not by half of it. So their impulse comes early by half a step, and the state
has v = v(t_n) − Δt a/2 all the time. Loads between those extremes, springs and damping that may be stiff, have a weight between ½
and 1 (`Fitted`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.articulation import Articulation
from pbfd_torch.assembly import Balance
from pbfd_torch.dynamics import armature_diagonal, generalised_momentum, mass_matrix
from pbfd_torch.integrators.fitted import Fitted, fitted
from pbfd_torch.integrators.implicit_euler import fallen
from pbfd_torch.integrators.integrator import Integrator, State, after, fresh
from pbfd_torch.kinematics import Motion, Placement, difference, place, retract
from pbfd_torch.objective import BalanceObjective
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_springs import Armature
from pbfd_torch.terms.load import Load, StepContext, Term
from pbfd_torch.worlds import replaced


@dataclass(frozen=True, eq=False, kw_only=True)
class Velocities(State):
    """Attributes:
    v: the velocity that the next step starts with `[*batch, nv]`, short of that at t_n by half of `push`.
    push: velocity that early forces have given in the step that ended here, Δt M⁻¹ Σ (2θ − 1) f, `[*batch, nv]`.
    """

    v: Tensor
    push: Tensor


@dataclass(frozen=True)
class EnergyMomentum:
    """κ = 1/Δt², T̂ = T_n + Δt V_n + ½Δt² [0 | g], share ½."""

    @property
    def easier(self) -> Sequence[Integrator[Velocities]]:
        """The paper's step."""
        return (_PaperStep(),)

    def adapted(self, articulation: Articulation, terms: Sequence[Term], dt: Tensor) -> Sequence[Term]:
        """Springs, damping and actuators between the trapezoidal rule and implicit Euler."""
        return fitted(articulation, terms, dt)

    def start(self, articulation: Articulation, q: Tensor, v: Tensor, acceleration: Callable[[], Tensor], dt: Tensor) -> Velocities:
        """The velocity itself: contacts that hold from the start on find their own half step."""
        return Velocities(**fresh(q), v=v, push=torch.zeros_like(v))

    def velocity(self, articulation: Articulation, state: Velocities, dt: Tensor) -> Tensor:
        """At t_n."""
        return state.v + 0.5 * state.push

    def pose_rates(self, articulation: Articulation, state: Velocities, dt: Tensor) -> Tensor:
        """At t_n."""
        return Motion(place(articulation, state.q), self.velocity(articulation, state, dt)).rates

    def context(
        self, articulation: Articulation, state: Velocities, dt: Tensor, gravity: Tensor, control: Tensor | None
    ) -> StepContext:
        """See `Integrator`."""
        now = place(articulation, state.q)
        square = dt * dt
        moved = torch.zeros_like(now.poses)
        moved[..., :3, :] = dt[..., None, None, None] * Motion(now, state.v).rates
        return StepContext(
            dt=dt,
            previous=now,
            weight=1 / square,
            target_poses=fallen(now.poses + moved, (0.5 * square)[..., None, None] * gravity[..., None, :]),
            target_q=retract(articulation, state.q, dt[..., None] * state.v),
            control=control,
            time=state.time,
            share=torch.full_like(state.q[..., 0], 0.5),
        )

    def advance(self, objective: BalanceObjective, state: Velocities, q: Tensor) -> Velocities:
        """See `Integrator`."""
        articulation, step = objective.articulation, objective.step
        now = place(articulation, q)
        twice = 2 / step.dt
        rates = twice[..., None, None, None] * (now.poses - step.previous.poses)[..., :3, :]
        turning = twice[..., None] * difference(articulation, state.q, q)
        momentum = _momentum(objective, now, rates - Motion(step.previous, state.v).rates, turning - state.v)
        early = step.dt[..., None] * _early_forces(objective, now)
        v, push = _velocities(objective, now, momentum - early, early)
        return Velocities(**after(objective, q), v=v, push=push)

    def resized(self, articulation: Articulation, state: Velocities, dt: Tensor, new: Tensor) -> Velocities:
        """See `Integrator`."""
        push = (new / dt)[..., None] * state.push
        return replaced(state, v=state.v + 0.5 * (state.push - push), push=push)

    def refused(self, objective: BalanceObjective, state: Velocities, advanced: Velocities) -> Tensor | None:
        """None: every solved step stands."""
        return None


@dataclass(frozen=True)
class _PaperStep(EnergyMomentum):
    """The same step with inertial forces at its end, which is the paper's: a minimisation, with a solution whatever happens, and
    dissipative."""

    @property
    def easier(self) -> Sequence[Integrator[Velocities]]:
        """None."""
        return ()

    def adapted(self, articulation: Articulation, terms: Sequence[Term], dt: Tensor) -> Sequence[Term]:
        """The terms themselves, all implicit."""
        return terms

    def context(
        self, articulation: Articulation, state: Velocities, dt: Tensor, gravity: Tensor, control: Tensor | None
    ) -> StepContext:
        """See `Integrator`."""
        return replaced(super().context(articulation, state, dt, gravity, control), share=None)

    def advance(self, objective: BalanceObjective, state: Velocities, q: Tensor) -> Velocities:
        """With the average velocity of the step, and what gravity adds to it in half a step."""
        articulation, step = objective.articulation, objective.step
        now = place(articulation, q)
        # T̂ is ahead of T_n + Δt V by the way of gravity, ½Δt² g
        moved = (now.poses - step.previous.poses + step.target_poses - step.previous.poses)[..., :3, :]
        rates = moved / step.dt[..., None, None, None] - Motion(step.previous, state.v).rates
        turning = difference(articulation, state.q, q) / step.dt[..., None]
        early = step.dt[..., None] * _early_forces(objective, now)
        v, push = _velocities(objective, now, _momentum(objective, now, rates, turning), early)
        return Velocities(**after(objective, q), v=v, push=push)


def _momentum(objective: BalanceObjective, now: Placement, rates: Tensor, turning: Tensor) -> Tensor:
    """⟨S V, ∂T/∂θ⟩ `[*batch, nv]` of links with pose rates V `[*batch, nlink, 3, 4]` and rotors that turn at `turning`."""
    rotors = armature_diagonal(objective.articulation, objective.terms)
    return generalised_momentum(now, rates) + rotors * turning


def _early_forces(objective: BalanceObjective, now: Placement) -> Tensor:
    """Σ (2θ − 1) f over everything but inertia `[*batch, nv]`."""
    loads: list[Load] = []
    for term, prepared in zip(objective.terms, objective.prepared, strict=True):
        if isinstance(term, Fitted):
            loads.append(term.early(prepared, now))
        elif not isinstance(term, Inertia | Armature):
            loads.append(term.load(prepared, now))
    return -Balance(now, loads).residual


def _velocities(objective: BalanceObjective, now: Placement, momentum: Tensor, impulse: Tensor) -> tuple[Tensor, Tensor]:
    """The velocities M⁻¹ of a momentum and of an impulse."""
    inertia = mass_matrix(objective.articulation, now.q, objective.terms)
    both, _ = torch.linalg.solve_ex(inertia, torch.stack((momentum, impulse), -1))
    v, push = both.unbind(-1)
    return v.contiguous(), push.contiguous()
