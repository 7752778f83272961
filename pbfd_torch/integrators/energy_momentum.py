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

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.balance.dynamics import (
    armature_diagonal,
    generalised_momentum,
    kinetic_energy,
    mass_matrix,
    mass_matrix_at,
    potential_energy,
    rotor_energy,
)
from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.fitted import Fitted, fitted
from pbfd_torch.integrators.implicit_euler import fallen
from pbfd_torch.integrators.integrator import Halved, Integrator, Refusal, Starter, State, after, calm, fall, fresh
from pbfd_torch.solvers.linear import solved_positive
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_springs import Armature
from pbfd_torch.terms.load import Load, StepContext, Term
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Chord, Motion, Placement, difference, place, retract

FLATTEST = 0.3  # of cos²(φ/2), φ what a link turns by in a step: 2 rad
FARTHEST = 2.0  # [rad] that a joint may turn by in a step
EXCESS = 1e-2  # of the kinetic energies, that of a fall over one step included: what one step may gain
NOISE = 1e-4  # of the same: less in one step is never refused
PATIENCE, FAST = 3, 0.3  # halvings of steps in which a link turns by so much [rad]
SMOOTH_GAIN = 0.25  # of what a step gains of velocity: where halving it changes more, something strikes within
STILL = 0.01  # of the accuracy: where something presses, less is not worth an extrapolation
RESERVE = 1e-2  # of the largest kinetic energy so far: what is kept of losses


@dataclass(frozen=True, eq=False, kw_only=True)
class Velocities(State):
    """Attributes:
    v: the velocity that the next step starts with `[*batch, nv]`.
    push: velocity that contacts, limits and friction have given in the step that ended here, Δt M⁻¹ Σ f, `[*batch, nv]`.
    steady: the part of the push that they have also given in the step before, `[*batch, nv]`: v is short of the velocity at t_n by
        half of it, while an impact's has been given once for all.
    lag: twice what v is short by besides, `[*batch, nv]`: what forces of another weight take from the loads with θ > ½, 2θ − 1 of
        their impulse.
    average: velocity over that step, `[*batch, nv]`: with it the next step's solution is guessed.
    gained: energy [J] `[*batch]` that the last step has gained beyond the work done on the bodies.
    surplus: energy [J] `[*batch]` that all steps together have gained beyond the work done on the bodies. What they have lost makes
        up for it, but for no more than `RESERVE`: what an impact takes is gone.
    peak: the largest kinetic energy so far [J] `[*batch]`, that of a fall over one step included.
    """

    v: Tensor
    push: Tensor
    steady: Tensor
    lag: Tensor
    average: Tensor
    gained: Tensor
    surplus: Tensor
    peak: Tensor


@dataclass(frozen=True)
class EnergyMomentum:
    """κ = 1/Δt², T̂ = T_n + Δt V_n + ½Δt² [0 | g], share ½. The step is refused where a link has turned so far that the chord knows
    little of its rotation (virtual work vanishes there, and so does the residual, whatever the forces), and where contacts have
    done more work than they can: in it, or in all steps together.

    `surplus`: > 0, of the largest kinetic energy so far, what all steps together may gain. Infinite: anything, and motions that
    are close to each other are stepped alike, which derivatives like. Raises `InputError` for others."""

    surplus: float = 1e-3

    def __post_init__(self) -> None:
        if not self.surplus > 0:
            raise InputError(f"surplus is {self.surplus}: must be > 0, or infinite for steps that may gain anything")

    def _overdrawn(self, end: Velocities) -> Tensor:
        """Where a step has brought more energy than all together may have gained, `[*batch]` bool."""
        return (end.surplus > self.surplus * end.peak) & (end.gained > NOISE * end.peak)

    @property
    def easier(self) -> Sequence[Integrator[Velocities]]:
        """The paper's step."""
        return (_PaperStep(self.surplus),)

    @property
    def coordinates(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """See `Integrator`."""
        return ("q",), ("v",)

    def adapted(self, articulation: Articulation, terms: Sequence[Term], dt: Tensor) -> Sequence[Term]:
        """Springs, damping and actuators between the trapezoidal rule and implicit Euler."""
        return fitted(articulation, terms, dt)

    def start(self, starter: Starter, q: Tensor, v: Tensor, control: Tensor | None) -> Velocities:
        """With what contacts, limits and friction give in a trial step, unless that is an impact, which has given nothing
        before."""
        trial, dt = starter.trial(q, v, control), starter.step_size
        nothing, zero = torch.zeros_like(v), torch.zeros_like(q[..., 0])
        begin = Velocities(
            **fresh(q), v=v, push=nothing, steady=nothing, lag=nothing, average=v, gained=zero, surplus=zero, peak=zero
        )
        objective = starter.objective(begin, control)
        forces = _Forces(objective, place(starter.articulation, trial.end))
        at = objective.step.previous
        impulse, given = dt[..., None] * forces.rough, dt[..., None] * forces.smooth
        inertia = mass_matrix_at(at, objective.terms)
        gained = dt[..., None] * trial.acceleration
        (push,) = _solved(inertia, impulse)
        push = torch.where((trial.solved & calm(objective, at, push))[..., None], push, nothing)
        other = (inertia * gained[..., None, :]).sum(-1) - given
        (lag,) = _solved(inertia, torch.where(calm(objective, at, gained)[..., None], -forces.ahead * other, nothing))
        return replaced(begin, v=v - 0.5 * (push + lag), push=push, steady=push, lag=lag)

    def velocity(self, articulation: Articulation, state: Velocities, dt: Tensor) -> Tensor:
        """At t_n."""
        return state.v + 0.5 * (state.steady + state.lag)

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
            gravity=gravity,
            share=torch.full_like(state.q[..., 0], 0.5),
            guess=retract(articulation, state.q, dt[..., None] * state.average),
        )

    def advance(self, objective: BalanceObjective, state: Velocities, q: Tensor) -> tuple[Velocities, Refusal | None]:
        """See `Integrator`."""
        step, now = objective.step, place(objective.articulation, q)
        forces, dt = _Forces(objective, now), step.dt
        rates, average = _averages(objective, state, now)
        before = Motion(step.previous, state.v).rates
        early = dt[..., None] * (forces.rough + forces.ahead * forces.smooth)
        momentum = _momentum(objective, now, 2 * rates - before, 2 * average - state.v) - early
        gain = _Gain(objective, state, _ended(objective, state, now, momentum, forces, average), now, forces)

        def refused() -> Tensor:
            flat = torch.linalg.det(Chord(step.previous, now, torch.full_like(state.time, 0.5)).poses[..., :3, :3]).amin(-1)
            turned = objective.turn(dt[..., None] * average)
            excess, overdrawn = gain.energy > EXCESS * gain.kinetic, self._overdrawn(gain.end)
            # what rounding has left of the residual works too: in float32 stiff friction is off by a share of the weight
            suspect = excess | overdrawn
            # what is in the host's own memory it may look at; asking a device would make it wait
            if suspect.device.type != "cpu" or bool(suspect.numpy().any()):
                spurious = dt * (objective.evaluate(q).residual * average).sum(-1)
                excess = gain.energy - spurious > EXCESS * gain.kinetic
                less = replaced(gain.end, surplus=gain.end.surplus - spurious, gained=gain.energy - spurious)
                overdrawn = self._overdrawn(less)
            return (flat < FLATTEST) | (turned > FARTHEST) | excess | overdrawn

        return gain.end, refused

    def halves(self, objective: BalanceObjective, end: Velocities, solved: Tensor) -> Tensor:
        """Once where nothing pushes, nor would where inertia alone leads: there the energy that an easier step would take is worth
        two shorter ones; and up to `PATIENCE` times where nothing but its energy is wrong with the step and it turns fast."""
        step = objective.step
        free = objective.push(step.previous.q) + objective.push(step.target_q) + objective.push(end.q) == 0
        fast = objective.turned(place(objective.articulation, end.q), FAST).any(-1)
        return torch.where(solved & self._overdrawn(end) & fast, PATIENCE, free.to(torch.int32))

    def extrapolated(self, articulation: Articulation, terms: Sequence[Term], made: Halved[Velocities]) -> Velocities:
        """See `Extrapolating`: (4 x(Δt/2) − x(Δt))/3, of fourth order, and 2 x(Δt/2) − x(Δt), of second, where something has
        pressed all along: what contacts give comes early by half a step. Of configurations and momenta, so that what is kept of
        these is kept. What lies still is damped best by the halves."""
        start, whole, end = made.start, made.whole, made.end
        pushed = torch.stack([(x.push != 0).any(-1) for x in (start, whole, made.middle, end)])
        pressed, struck = pushed.all(0), pushed[1:].any(0)
        begin, first, last = (x.v + 0.5 * (x.steady + x.lag) for x in (start, whole, end))
        inertia = mass_matrix(articulation, end.q, terms)
        changed, gained = (((inertia * x[..., None, :]).sum(-1) * x).sum(-1) for x in (last - first, last - begin))
        smooth = pressed & (changed <= SMOOTH_GAIN**2 * gained) & (made.off > STILL * made.accuracy)
        known = ((made.off <= made.accuracy) & (smooth | ~struck))[..., None]
        share = torch.where(pressed, 1.0, 1 / 3).to(end.v.dtype)[..., None]
        q = retract(articulation, end.q, share * difference(articulation, whole.q, end.q))
        coarse = (mass_matrix(articulation, whole.q, terms) * first[..., None, :]).sum(-1)
        momenta = [(inertia * x[..., None, :]).sum(-1) for x in (last, end.push, end.steady, end.lag)]
        momenta[0] = momenta[0] + share * (momenta[0] - coarse)
        v, push, steady, lag = _solved(mass_matrix(articulation, q, terms), *momenta)
        changes = {"q": q, "v": v - 0.5 * (steady + lag), "push": push, "steady": steady, "lag": lag}
        return replaced(end, **{name: torch.where(known, x, getattr(end, name)) for name, x in changes.items()})

    def resized(self, articulation: Articulation, state: Velocities, dt: Tensor, new: Tensor) -> Velocities:
        """See `Integrator`."""
        share = (new / dt)[..., None]
        steady, lag = share * state.steady, share * state.lag
        v = state.v + 0.5 * (state.steady - steady + state.lag - lag)
        return replaced(state, v=v, push=share * state.push, steady=steady, lag=lag)


@dataclass(frozen=True)
class _PaperStep(EnergyMomentum):
    """The same step with inertial forces at its end, which is the paper's: a minimisation, with a solution whatever happens, and
    dissipative."""

    @property
    def easier(self) -> Sequence[Integrator[Velocities]]:
        """None."""
        return ()

    def context(
        self, articulation: Articulation, state: Velocities, dt: Tensor, gravity: Tensor, control: Tensor | None
    ) -> StepContext:
        """See `Integrator`."""
        return replaced(super().context(articulation, state, dt, gravity, control), share=None)

    def advance(self, objective: BalanceObjective, state: Velocities, q: Tensor) -> tuple[Velocities, None]:
        """With the average velocity of the step, and what the forces that are not early give after it."""
        step, now = objective.step, place(objective.articulation, q)
        forces, h = _Forces(objective, now), step.dt[..., None]
        rates, average = _averages(objective, state, now)
        rates = torch.cat((rates[..., :3], rates[..., 3:] + 0.5 * (h * step.gravity)[..., None, :, None]), -1)
        momentum = _momentum(objective, now, rates, average) + 0.5 * h * (1 - forces.ahead) * forces.smooth
        end = _ended(objective, state, now, momentum, forces, average)
        return _Gain(objective, state, end, now, forces).end, None


class _Gain:
    """What a step has gained beyond the forces' work on what has moved: `energy` and the `kinetic` energies at its start and end
    together, that of a fall over it included, [J] `[*batch]`; and the state at its `end` with all accounts kept."""

    def __init__(self, objective: BalanceObjective, state: Velocities, end: Velocities, now: Placement, forces: _Forces) -> None:
        a, step = objective.articulation, objective.step
        with torch.no_grad():  # which steps are refused does not change smoothly
            first, last = (
                kinetic_energy(a, Motion(at, v).rates) + rotor_energy(a, v, objective.terms)
                for at, v in ((step.previous, state.v + 0.5 * state.steady), (now, end.v + 0.5 * end.steady))
            )
            lost = potential_energy(step.previous, step.gravity) - potential_energy(now, step.gravity)
            work = step.dt * ((forces.rough + forces.smooth) * end.average).sum(-1)
            self.energy, self.kinetic = last - first - lost - work, first + last + fall(objective)
            peak = torch.maximum(state.peak, torch.maximum(first, last) + fall(objective))
            surplus = torch.maximum(state.surplus + self.energy, -RESERVE * peak)
        self.end = replaced(end, gained=self.energy, surplus=surplus, peak=peak)


class _Forces:
    """Generalised forces `[*batch, nv]` at the end of a step, but for inertia: `rough` ones, which come early (θ = 1), and `smooth`
    ones, of which 2θ − 1, `ahead` `[*, nv]`, comes early."""

    def __init__(self, objective: BalanceObjective, now: Placement) -> None:
        rough: list[Load] = []
        self.rough = torch.zeros_like(now.axes[..., 0])
        self.smooth, self.ahead = self.rough, self.rough
        for term, prepared in zip(objective.terms, objective.prepared, strict=True):
            if isinstance(term, Fitted):
                self.smooth = self.smooth - term.load(prepared, now).residual / term.share
                self.ahead = 2 * term.share - 1
            elif not isinstance(term, Inertia | Armature):
                rough.append(term.load(prepared, now))
        if rough:
            self.rough = -Balance(now, rough).residual


def _averages(objective: BalanceObjective, state: Velocities, now: Placement) -> tuple[Tensor, Tensor]:
    """Rates of the link poses `[*batch, nlink, 3, 4]` and velocity `[*batch, nv]` over a step."""
    step = objective.step
    rates = (now.poses - step.previous.poses)[..., :3, :] / step.dt[..., None, None, None]
    return rates, difference(objective.articulation, state.q, now.q) / step.dt[..., None]


def _momentum(objective: BalanceObjective, now: Placement, rates: Tensor, turning: Tensor) -> Tensor:
    """⟨S V, ∂T/∂θ⟩ `[*batch, nv]` of links with pose rates V `[*batch, nlink, 3, 4]` and rotors that turn at `turning`."""
    rotors = armature_diagonal(objective.articulation, objective.terms)
    return generalised_momentum(now, rates) + rotors * turning


def _ended(
    objective: BalanceObjective, state: Velocities, now: Placement, momentum: Tensor, forces: _Forces, average: Tensor
) -> Velocities:
    """The state at a placement with that momentum."""
    h = objective.step.dt[..., None]
    impulse = h * forces.rough
    inertia = mass_matrix_at(now, objective.terms)
    v, push = _solved(inertia, momentum, impulse)
    # ⟨p, M p'⟩ / ⟨p, M p⟩ is how much of this push p the last one p' was
    kept, whole = (impulse * state.push).sum(-1), (impulse * push).sum(-1)
    share = (kept / torch.where(whole > 0, whole, torch.ones_like(whole))).clamp(0, 1)[..., None]
    before = (inertia * state.v[..., None, :]).sum(-1)
    other = momentum - before - h * forces.smooth - (1 - share) * impulse
    (lag,) = _solved(inertia, -forces.ahead * other)
    return Velocities(
        **after(objective, now),
        v=v,
        push=push,
        steady=share * push,
        lag=lag,
        average=average,
        gained=state.gained,
        surplus=state.surplus,
        peak=state.peak,
    )


def _solved(inertia: Tensor, *momenta: Tensor) -> tuple[Tensor, ...]:
    """The velocities M⁻¹ of momenta, each `[*batch, nv]`."""
    columns = solved_positive(inertia, torch.stack(momenta, -1))
    return tuple(x.contiguous() for x in columns.unbind(-1))
