"""Explicit steps of fifth order where nothing touches, and energy–momentum steps wherever something does.

M(q) v̇ = f(q, v) − h(q, v) is integrated by the pair of Dormand and Prince (J. Comp. Appl. Math. 6, 1980): seven stages, the last
of them at the end of the step, and how far its solutions of fifth and fourth order end apart is the error estimate. No equation is
solved. Quaternions are integrated as four numbers, and scaled at the end.

A world makes such a step where all that acts on it is smooth and known at an instant, where no contact and no limit pushes at any
of the stages, where springs and damping are not stiff, and where the step is as short as the motion asks for. Its other steps are
those of the energy–momentum scheme, from the same state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.balance.dynamics import apart, generalised_momentum, mass_matrix_at
from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.energy_momentum import EnergyMomentum, Velocities
from pbfd_torch.integrators.fitted import Fitted, stiffness
from pbfd_torch.integrators.integrator import Leap, after
from pbfd_torch.solvers.linear import solved_positive
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.contact_laws import Prepared
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_springs import Armature
from pbfd_torch.terms.load import Flowing, Pushing, Term
from pbfd_torch.tree.articulation import reach
from pbfd_torch.tree.kinematics import Motion, Placement, coordinate_rates, difference, place, retract

# a_ij of the stages after the first; the last row is the solution of fifth order
STAGES = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
# what the solution of fourth order is short of
SHORT = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
STIFFEST = 1.0  # Δt² (∂r/∂q)/m of springs, damping and actuators: beyond, they are left to the other scheme
Pair = tuple[Tensor, Tensor]
SCANS, BISECTIONS = 8, 30  # of a step, for the instant at which something strikes
ROUNDING = 100.0  # of the size of the articulation, in units in the last place: no error is estimated to less


@dataclass(frozen=True)
class RungeKutta(EnergyMomentum):
    """`trust`: > 0, the error estimate, as a share of what the bodies move by in the step, up to which an explicit step is taken.
    Raises `InputError` for others. `surplus`: of the other steps, see `EnergyMomentum`."""

    trust: float = 1e-4

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.trust > 0:
            raise InputError(f"trust is {self.trust}: must be > 0, a share of what the bodies move by in a step")

    @property
    def otherwise(self) -> EnergyMomentum:
        """What makes the steps that are not explicit."""
        return EnergyMomentum(self.surplus)

    def leap(self, terms: Sequence[Term], objective: BalanceObjective, state: Velocities) -> Leap[Velocities]:
        """The explicit step from a state, of the step and the loads that an objective is of; terms: of the scene."""
        a, step = objective.articulation, objective.step
        flow = _Flow(terms, objective)
        h, start = step.dt[..., None], (state.q, self.velocity(a, state, step.dt))
        at, rates = start, [flow.rates(*start)]
        solids = standing(objective)
        off = touched = solids.push(state.q) > 0
        for row in STAGES:
            at = _moved(start, h, row, rates)
            rates.append(flow.rates(*at))
            touched = touched | (solids.push(at[0]) > 0)
        q, v = a.topology.normalized(at[0]), at[1]
        short, slower = _moved((q, v), h, SHORT, rates)
        # what the velocity is off by shows in the next step
        later = retract(a, q, h * (slower - v))
        error = torch.maximum(apart(a, a.topology.normalized(short), q), apart(a, later, q))
        moved = apart(a, state.q, q)
        least = ROUNDING * torch.finfo(q.dtype).eps * reach(a)
        able = flow.smooth & ~off
        good = able & (error <= self.trust * moved + least) & torch.isfinite(v).all(-1)
        strike = torch.ones_like(error)
        if bool((good & touched).any()):
            found = first_strike(solids, h, (state.q, rates[0][0]), (at[0], rates[-1][0]))
            strike = torch.where(good & touched, found, strike)
        now = place(a, q)
        nothing = torch.zeros_like(v)
        lag = flow.lag(now, v, rates[-1][1])
        end = Velocities(
            **after(objective, now),
            v=v - 0.5 * lag,
            push=nothing,
            steady=nothing,
            lag=lag,
            average=difference(a, state.q, q) / h,
            gained=torch.zeros_like(state.gained),
            surplus=state.surplus,
            peak=state.peak,
        )
        stages = 1 + len(STAGES)
        return Leap(end, good & ~touched, error, strike, stages * able.to(torch.int32), stages)


def standing(objective: BalanceObjective) -> BalanceObjective:
    """The same with all solids where they are, and not moved out to throw something back (`Restitution`)."""
    prepared = [replaced(x, bounce=None) if isinstance(x, Prepared) else x for x in objective.prepared]
    return replaced(objective, prepared=prepared)


def first_strike(objective: BalanceObjective, h: Tensor, start: Pair, end: Pair) -> Tensor:
    """The share `[*batch]` of a step after which something first pushes on the cubic between q and q̇ at its start and at its end;
    to 2^−33 and not after; 1: nothing does."""

    def touches(x: Tensor) -> Tensor:
        x = x[..., None]
        y = 1 - x
        ends = y * y * (1 + 2 * x) * start[0] + x * x * (3 - 2 * x) * end[0]
        return objective.push(ends + h * x * y * (y * start[1] - x * end[1])) > 0

    low = torch.zeros_like(h[..., 0].expand(start[0].shape[:-1]))
    high = low + 2
    for k in range(1, SCANS + 1):
        x = torch.full_like(low, k / SCANS)
        high = torch.where(touches(x) & (high > 1), x, high)
        low = torch.where(high > 1, x, low)
    there = high <= 1
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high.clamp_max(1))
        found = touches(middle)
        low, high = torch.where(found, low, middle), torch.where(found, middle, high)
    return torch.where(there, low, 1.0)


def _moved(start: Pair, h: Tensor, row: Sequence[float], rates: Sequence[Pair]) -> Pair:
    """q and v moved by h Σ a k, without scaling quaternions."""
    used = [(a, *rate) for a, rate in zip(row, rates, strict=False) if a]
    return start[0] + h * sum(a * k for a, k, _ in used), start[1] + h * sum(a * k for a, _, k in used)


class _Flow:
    """What makes the bodies move, at an instant. smooth: `[*batch]` bool, where it is all that could act."""

    def __init__(self, terms: Sequence[Term], objective: BalanceObjective) -> None:
        self._objective, self._terms = objective, terms
        step, a = objective.step, objective.articulation
        smooth = torch.ones_like(step.target_q[..., 0], dtype=torch.bool)
        for term in terms:
            if isinstance(term, JointDryFriction):
                smooth = smooth & (term.torque == 0).all(-1)
            elif not isinstance(term, Inertia | Armature | Flowing | Pushing):
                smooth = torch.zeros_like(smooth)
        stiff = stiffness(a, terms, step.dt)
        self.smooth = smooth if stiff is None else smooth & (stiff <= STIFFEST).all(-1)

    def rates(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """How coordinates and velocity change."""
        now = place(self._objective.articulation, q)
        return coordinate_rates(now.articulation, q, v), self._acceleration(now, v)

    def lag(self, now: Placement, v: Tensor, acceleration: Tensor) -> Tensor:
        """See `Velocities`, where the velocity `[*batch, nv]` changes like that."""
        shares = [term.share for term in self._objective.terms if isinstance(term, Fitted)]
        if not shares:
            return torch.zeros_like(v)
        h = self._objective.step.dt[..., None]
        inertia = mass_matrix_at(now, self._terms)
        others = (inertia * acceleration[..., None, :]).sum(-1) - self._force(now, v, fitted=True)
        return _over(inertia, (1 - 2 * shares[0]) * h * others)

    def _acceleration(self, now: Placement, v: Tensor) -> Tensor:
        drift = Motion(now, v).accelerations
        falling = torch.cat((drift[..., :3], drift[..., 3:] - self._objective.step.gravity[..., None, :, None]), -1)
        return _over(mass_matrix_at(now, self._terms), self._force(now, v) - generalised_momentum(now, falling))

    def _force(self, now: Placement, v: Tensor, fitted: bool = False) -> Tensor:
        """Generalised, `[*batch, nv]`; fitted: of what has its share of a step alone."""
        used = [isinstance(term, Fitted) or not fitted for term in self._objective.terms]
        flowing = [term for term, wanted in zip(self._terms, used, strict=True) if wanted and isinstance(term, Flowing)]
        loads = [term.flow(now, v, self._objective.step.control) for term in flowing]
        return -Balance(now, loads).residual if loads else torch.zeros_like(v)


def _over(inertia: Tensor, force: Tensor) -> Tensor:
    """M⁻¹ f."""
    return solved_positive(inertia, force[..., None]).squeeze(-1)
