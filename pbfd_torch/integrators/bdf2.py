"""BDF2 on positions, with a step of implicit Euler where a contact force jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.integrators.implicit_euler import fallen
from pbfd_torch.integrators.integrator import Integrator, Refusal, Starter, State, after, fresh
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.load import StepContext, Term
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Motion, difference, place, retract

Past = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True, eq=False, kw_only=True)
class FourPoses(State):
    """Attributes:
    history: link poses T_{n−1}, T_{n−2}, T_{n−3}, each `[*batch, nlink, 4, 4]`. Those before the start fit no joints: they are on
        the bodies' parabolas, which keeps momentum.
    moves: the last three displacements, the latest first, each `[*batch, nv]`.
    push: how hard contacts and limits pushed at θ_n, in weights, `[*batch]`; NaN: not known, and no jump to whatever comes.
    """

    history: Past
    moves: Past
    push: Tensor


@dataclass(frozen=True)
class Bdf2:
    """Ṫ = (3T_{n+1} − 4T_n + T_{n−1})/(2Δt), applied twice: κ = 9/(4Δt²) and a target made of the last four poses. Second order,
    and damped. Its long memory would throw bodies back after an impact: where contacts and limits push harder or less hard than a
    step before by more than `jump` weights, the step is one of implicit Euler, and the memory starts anew at its velocity."""

    jump: float = 0.3

    @property
    def easier(self) -> Sequence[Integrator[FourPoses]]:
        """Implicit Euler."""
        return (_Drop(),)

    @property
    def coordinates(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """See `Integrator`."""
        return ("q",), ("history", "moves")

    def adapted(self, articulation: Articulation, terms: Sequence[Term], dt: Tensor) -> Sequence[Term]:
        """The terms themselves, all implicit."""
        return terms

    def start(self, starter: Starter, q: Tensor, v: Tensor, control: Tensor | None) -> FourPoses:
        """A past of constant acceleration, that of a trial step."""
        a, h = starter.articulation, starter.step_size
        acceleration = starter.trial(q, v, control).acceleration
        now = place(a, q)
        motion = Motion(now, v)
        curved = motion.accelerations + Motion(now, acceleration).rates
        return FourPoses(
            **fresh(q),
            history=_before(now.poses, motion.rates, curved, h),
            moves=_moved(v, acceleration, h),
            push=torch.full_like(q[..., 0], torch.nan),
        )

    def velocity(self, articulation: Articulation, state: FourPoses, dt: Tensor) -> Tensor:
        """That of BDF2 at t_n."""
        last, before, _ = state.moves
        return (1.5 * last - 0.5 * before) / dt[..., None]

    def pose_rates(self, articulation: Articulation, state: FourPoses, dt: Tensor) -> Tensor:
        """Those of BDF2 at t_n."""
        last, before, _ = _steps(place(articulation, state.q).poses, state)
        return (1.5 * last - 0.5 * before)[..., :3, :] / dt[..., None, None, None]

    def context(
        self, articulation: Articulation, state: FourPoses, dt: Tensor, gravity: Tensor, control: Tensor | None
    ) -> StepContext:
        """T̂ = (24T_n − 22T_{n−1} + 8T_{n−2} − T_{n−3})/9 + 4Δt²/9 [0 | g]."""
        now = place(articulation, state.q)
        square = dt * dt
        target = now.poses + _extrapolated(*_steps(now.poses, state))
        return StepContext(
            dt=dt,
            previous=now,
            weight=9 / (4 * square),
            target_poses=fallen(target, (square * (4 / 9))[..., None, None] * gravity[..., None, :]),
            target_q=retract(articulation, state.q, _extrapolated(*state.moves)),
            control=control,
            time=state.time,
            gravity=gravity,
        )

    def advance(self, objective: BalanceObjective, state: FourPoses, q: Tensor) -> tuple[FourPoses, Refusal | None]:
        """See `Integrator`."""
        step, push = objective.step, objective.push(q)
        end = FourPoses(
            **after(objective, place(objective.articulation, q)),
            history=(step.previous.poses, *state.history[:2]),
            moves=(difference(objective.articulation, state.q, q), *state.moves[:2]),
            push=push,
        )
        return end, lambda: (push - state.push).abs() > self.jump

    def halves(self, objective: BalanceObjective, end: State, solved: Tensor) -> Tensor:
        """Never: an easier step is good enough."""
        return torch.zeros_like(solved, dtype=torch.int32)

    def resized(self, articulation: Articulation, state: FourPoses, dt: Tensor, new: Tensor) -> FourPoses:
        """A past of constant acceleration, that of the last two steps."""
        now = place(articulation, state.q).poses
        last, before, _ = _steps(now, state)
        rates, square = self.pose_rates(articulation, state, dt), dt * dt
        curved = (last - before)[..., :3, :] / square[..., None, None, None]
        acceleration = (state.moves[0] - state.moves[1]) / square[..., None]
        return replaced(
            state,
            history=_before(now, rates, curved, new),
            moves=_moved(self.velocity(articulation, state, dt), acceleration, new),
        )


@dataclass(frozen=True)
class _Drop(Bdf2):
    """A step of implicit Euler that forgets what was before it."""

    @property
    def easier(self) -> Sequence[Integrator[FourPoses]]:
        """None."""
        return ()

    def context(
        self, articulation: Articulation, state: FourPoses, dt: Tensor, gravity: Tensor, control: Tensor | None
    ) -> StepContext:
        """T̂ = 2T_n − T_{n−1} + Δt² [0 | g]."""
        now = place(articulation, state.q)
        square = dt * dt
        return StepContext(
            dt=dt,
            previous=now,
            weight=1 / square,
            target_poses=fallen(2 * now.poses - state.history[0], square[..., None, None] * gravity[..., None, :]),
            target_q=retract(articulation, state.q, state.moves[0]),
            control=control,
            time=state.time,
            gravity=gravity,
        )

    def advance(self, objective: BalanceObjective, state: FourPoses, q: Tensor) -> tuple[FourPoses, None]:
        """With a past of constant velocity."""
        end, _ = super().advance(objective, state, q)
        now, last = place(objective.articulation, q).poses, end.history[0]
        still = torch.zeros_like(now[..., :3, :])
        past = _before(now, (now - last)[..., :3, :], still, torch.ones_like(state.time))
        return replaced(end, history=past, moves=(end.moves[0],) * 3), None


def _before(poses: Tensor, rates: Tensor, accelerations: Tensor, dt: Tensor) -> Past:
    """T_{−1}, T_{−2}, T_{−3} of poses `[*batch, nlink, 4, 4]` with constant accelerations `[*batch, nlink, 3, 4]`."""
    h = dt[..., None, None, None]

    def at(k: int) -> Tensor:
        moved = 0.5 * (k * h) ** 2 * accelerations - k * h * rates
        return poses + torch.cat((moved, torch.zeros_like(moved[..., :1, :])), -2)

    return at(1), at(2), at(3)


def _moved(v: Tensor, acceleration: Tensor, dt: Tensor) -> Past:
    """The last three displacements of a motion at constant acceleration, each `[*batch, nv]`."""
    h = dt[..., None]

    def back(k: int) -> Tensor:
        return h * (v - (k - 0.5) * h * acceleration)

    return back(1), back(2), back(3)


def _steps(now: Tensor, state: FourPoses) -> list[Tensor]:
    """The last three differences of the poses, the latest first, each `[*batch, nlink, 4, 4]`."""
    return [last - before for last, before in pairwise((now, *state.history))]


def _extrapolated(last: Tensor, before: Tensor, oldest: Tensor) -> Tensor:
    """The next displacement without forces; written in differences, because poses far from the origin would cancel."""
    return (15 * last - 7 * before + oldest) / 9
