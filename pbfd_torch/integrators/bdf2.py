"""BDF2 on positions, with a step of implicit Euler where a contact force jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from pbfd_torch.articulation import Articulation
from pbfd_torch.integrators.implicit_euler import ImplicitEuler, Positions, fallen
from pbfd_torch.integrators.integrator import Integrator, State, Stepper, after, fresh
from pbfd_torch.kinematics import difference, place, retract
from pbfd_torch.objective import BalanceObjective
from pbfd_torch.terms.load import StepContext, Term
from pbfd_torch.worlds import replaced


@dataclass(frozen=True, eq=False, kw_only=True)
class FourPositions(State):
    """Attributes:
    history: θ_{n−1}, θ_{n−2}, θ_{n−3}, each `[*batch, nq]`.
    push: how hard contacts and limits pushed at θ_n, in weights, `[*batch]`; NaN: not known, and no jump to whatever comes.
    """

    history: tuple[Tensor, Tensor, Tensor]
    push: Tensor


@dataclass(frozen=True)
class Bdf2:
    """Ṫ = (3T_{n+1} − 4T_n + T_{n−1})/(2Δt), applied twice: κ = 9/(4Δt²) and a target made of the last four poses. Second order,
    and damped. Its long memory would throw bodies back after an impact: where contacts and limits push harder or less hard than a
    step before by more than `jump` weights, the step is one of implicit Euler, and the memory starts anew at its velocity."""

    jump: float = 0.3

    @property
    def easier(self) -> Sequence[Integrator[FourPositions]]:
        """Implicit Euler."""
        return (_Drop(),)

    def adapted(self, articulation: Articulation, terms: Sequence[Term], dt: Tensor) -> Sequence[Term]:
        """The terms themselves, all implicit."""
        return terms

    def start(self, stepper: Stepper, q: Tensor, v: Tensor, control: Tensor | None) -> FourPositions:
        """A past of constant acceleration, that of a trial step."""
        past = _past(stepper.articulation, q, v, stepper.trial(q, v, control).acceleration, stepper.step_size)
        return FourPositions(**fresh(q), history=past, push=torch.full_like(q[..., 0], torch.nan))

    def velocity(self, articulation: Articulation, state: FourPositions, dt: Tensor) -> Tensor:
        """That of BDF2 at t_n."""
        last, before, _ = _moves(articulation, state)
        return (1.5 * last - 0.5 * before) / dt[..., None]

    def pose_rates(self, articulation: Articulation, state: FourPositions, dt: Tensor) -> Tensor:
        """Those of BDF2 at t_n."""
        now, last, before = (place(articulation, q).poses[..., :3, :] for q in (state.q, *state.history[:2]))
        return (1.5 * (now - last) - 0.5 * (last - before)) / dt[..., None, None, None]

    def context(
        self, articulation: Articulation, state: FourPositions, dt: Tensor, gravity: Tensor, control: Tensor | None
    ) -> StepContext:
        """T̂ = (24T_n − 22T_{n−1} + 8T_{n−2} − T_{n−3})/9 + 4Δt²/9 [0 | g]."""
        placements = [place(articulation, q) for q in (state.q, *state.history)]
        square = dt * dt
        target = placements[0].poses + _extrapolated(*(a.poses - b.poses for a, b in pairwise(placements)))
        return StepContext(
            dt=dt,
            previous=placements[0],
            weight=9 / (4 * square),
            target_poses=fallen(target, (square * (4 / 9))[..., None, None] * gravity[..., None, :]),
            target_q=retract(articulation, state.q, _extrapolated(*_moves(articulation, state))),
            control=control,
            time=state.time,
            gravity=gravity,
        )

    def advance(self, objective: BalanceObjective, state: FourPositions, q: Tensor) -> tuple[FourPositions, Tensor | None]:
        """See `Integrator`."""
        first, second, _ = state.history
        push = objective.push(q)
        end = FourPositions(**after(objective, q), history=(state.q, first, second), push=push)
        return end, (push - state.push).abs() > self.jump

    def halves(self, objective: BalanceObjective, q: Tensor) -> Tensor:
        """None: an easier step is good enough."""
        return torch.zeros_like(q[..., 0], dtype=torch.bool)

    def resized(self, articulation: Articulation, state: FourPositions, dt: Tensor, new: Tensor) -> FourPositions:
        """A past of constant acceleration, that of the last two steps."""
        last, before, _ = _moves(articulation, state)
        acceleration = (last - before) / (dt * dt)[..., None]
        v = self.velocity(articulation, state, dt)
        return replaced(state, history=_past(articulation, state.q, v, acceleration, new))


@dataclass(frozen=True)
class _Drop(Bdf2):
    """A step of implicit Euler that forgets what was before it."""

    @property
    def easier(self) -> Sequence[Integrator[FourPositions]]:
        """None."""
        return ()

    def context(
        self, articulation: Articulation, state: FourPositions, dt: Tensor, gravity: Tensor, control: Tensor | None
    ) -> StepContext:
        """Implicit Euler's."""
        last = Positions(q=state.q, q_previous=state.history[0], time=state.time, hazards=state.hazards)
        return ImplicitEuler().context(articulation, last, dt, gravity, control)

    def advance(self, objective: BalanceObjective, state: FourPositions, q: Tensor) -> tuple[FourPositions, None]:
        """With a past of constant velocity."""
        moved = difference(objective.articulation, state.q, q)
        one = torch.ones_like(moved[..., 0])
        past = _past(objective.articulation, q, moved, torch.zeros_like(moved), one)
        return FourPositions(**after(objective, q), history=past, push=objective.push(q)), None


def _past(articulation: Articulation, q: Tensor, v: Tensor, acceleration: Tensor, dt: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """θ_{−1}, θ_{−2}, θ_{−3} of a motion at constant acceleration."""
    h = dt[..., None]
    first, second, third = (retract(articulation, q, 0.5 * (k * h) ** 2 * acceleration - k * h * v) for k in (1, 2, 3))
    return first, second, third


def _moves(articulation: Articulation, state: FourPositions) -> list[Tensor]:
    """The last three displacements, the latest first, each `[*batch, nv]`."""
    return [difference(articulation, before, now) for now, before in pairwise((state.q, *state.history))]


def _extrapolated(last: Tensor, before: Tensor, oldest: Tensor) -> Tensor:
    """The next displacement without forces; written in differences, because poses far from the origin would cancel."""
    return (15 * last - 7 * before + oldest) / 9
