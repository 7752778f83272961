"""Gradients of steps by the implicit function theorem.

A step ends where r(q, x) = 0, x all that it depends on: state, control, the scene's numbers, Δt. So q moves by δ = −J⁻¹ (∂r/∂x) dx
in the exponential chart at q, J the exact, non-symmetric ∂r/∂q there. The solve itself is never differentiated: it runs without
derivatives, and only its inputs are kept. When derivatives are asked for, the residual is evaluated once more at q with a graph,
the integrator goes on from q ⊕ δ, and the graph of both is followed: one factorisation of J a step, whatever the number of
parameters. Values are those of the solve to the bit. A step that was made in another way (`Way`) is differentiated in that way.

Derivatives of float32 steps are taken in float64, at the root that one of Newton's steps in float64 makes of the one found: what
stiff contacts add to J leaves a 32-step gradient of a hopper right to 1 % in float32.

First derivatives only: a second one would need ∂J/∂q, and asking for it is an error.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.integrator import Leaping, S
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.stepping.way import Way
from pbfd_torch.tensors.plain import plain
from pbfd_torch.tensors.structures import mapped_tensors, tensors_of
from pbfd_torch.tensors.worlds import Worlds

SINGULAR = 64.0  # of the machine's ε: a pivot this small is rounding


class Doubt(enum.IntFlag):
    """What may be wrong with the derivatives of a step, as bits per world; 0: nothing."""

    UNSOLVED = 1  # no root was found, so there is nothing whose derivative could be taken
    SINGULAR = 2  # J is singular at the root: a fold, or something that nothing holds; known once derivatives were asked for
    DETOUR = 4  # exact, but of the easier or shorter steps that were taken here; another state nearby may not need them


class Doubtful(enum.Enum):
    """What happens when derivatives of an unsolved or singular step are asked for."""

    RAISE = "raise"  # `GradientError`
    WARN = "warn"  # `GradientWarning`: at an unsolved step's best point as if it were a root; a singular J is damped
    ZERO = "zero"  # the worlds' derivatives end there: the step's end counts as a constant


@dataclass(frozen=True)
class Blur:
    """Contact as derivatives see it, softened so that they know of it before it happens; values are not touched. **Such gradients
    are biased**: they are those of no simulation.

    `widening` ≥ 1: friction is smooth over so many times its range of slip. `distance` ≥ 0 [m]: normal forces set in from there."""

    widening: float = 1.0
    distance: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= self.widening < float("inf"):
            raise InputError(f"widening is {self.widening}: must be ≥ 1 and finite")
        if not 0 <= self.distance < float("inf"):
            raise InputError(f"distance is {self.distance} m: must be ≥ 0 and finite")


@dataclass(frozen=True)
class Gradients:
    """How steps are differentiated.

    `doubtful`: what happens at steps that have no derivative. `blur`: None: exact. `keep_factors`: keep J's factors once they are
    there, nv² numbers a step and world: for several gradients of one rollout."""

    doubtful: Doubtful = Doubtful.RAISE
    blur: Blur | None = None
    keep_factors: bool = False


@dataclass(frozen=True, eq=False)
class Factors:
    """LU factors of D⁻¹J D⁻¹ `[*batch, nv, nv]` and their pivots, D² = |diag K| `[*batch, nv]` being the size of what J is made of,
    and which worlds' J was singular beside that `[*batch]`, and so damped."""

    lu: Tensor
    pivots: Tensor
    size: Tensor
    singular: Tensor

    @staticmethod
    def of(jacobian: Tensor, stiffness: Tensor) -> Factors:
        """Damped by √ε D² where a pivot is lost in rounding. stiffness: K."""
        info = torch.finfo(jacobian.dtype)
        size = stiffness.diagonal(dim1=-2, dim2=-1).abs().clamp_min(info.tiny).sqrt()
        scaled = jacobian / (size[..., :, None] * size[..., None, :])
        lu, _, _ = torch.linalg.lu_factor_ex(scaled)
        singular = ~(lu.diagonal(dim1=-2, dim2=-1).abs().amin(-1) > SINGULAR * info.eps)
        eye = torch.eye(jacobian.shape[-1], dtype=jacobian.dtype, device=jacobian.device)
        damped = (scaled + info.eps**0.5 * eye).nan_to_num(0.0, 0.0, 0.0)
        lu, pivots, _ = torch.linalg.lu_factor_ex(torch.where(singular[..., None, None], damped, scaled))
        return Factors(lu, pivots, size, singular)

    def plain(self) -> Factors:
        """Their values alone."""
        return Factors(plain(self.lu), plain(self.pivots), plain(self.size), plain(self.singular))

    def solve(self, right: Tensor) -> Tensor:
        """J⁻¹ of vectors `[*batch, nv]`."""
        return torch.linalg.lu_solve(self.lu, self.pivots, (right / self.size)[..., None]).squeeze(-1) / self.size


def blurred(objective: BalanceObjective, blur: Blur | None) -> BalanceObjective:
    """The step as derivatives see it."""
    if blur is None:
        return objective
    wide = objective.widened(blur.widening) if blur.widening > 1 else objective
    return wide.seen_from(blur.distance) if blur.distance > 0 else wide


def attached(objective: BalanceObjective, q: Tensor, blur: Blur | None, factors: Factors | None) -> tuple[Tensor, Factors]:
    """q `[*batch, nq]`, a constant that solves the objective, as a function of all that the objective depends on; and J's factors,
    which may be given."""
    balance = blurred(objective, blur).evaluate(q)
    if factors is None:
        with torch.no_grad():
            factors = Factors.of(balance.jacobian.detach(), balance.stiffness.detach())
    moved = objective.retract(q, -factors.solve(balance.residual))
    return q + (moved - moved.detach()), factors


def followed(
    stepper: EagerStepper[S],
    state: S,
    control: Tensor | None,
    way: Way,
    blur: Blur | None = None,
    included: Tensor | None = None,
    kept: list[Factors] | None = None,
) -> tuple[S, Tensor]:
    """The end of a step that was made like this, as a function of everything, and where it has no derivative `[*batch]`; worlds
    that are not `included` get zeros. kept: holds J's factors, or is to hold them, where the way has no detours."""
    batch = tuple(way.q.shape[:-1])
    pieces = []
    for worlds, detour, legs in way.groups(included):
        part, now, held = stepper, state, control
        if worlds is not None:
            part, now = stepper.take(worlds), state.take(worlds)
            held = None if control is None else worlds.pick(control, 1)
        before = part
        if detour is not None:
            solver, size = part.solver, part.step_size
            part = part.with_scheme(detour.scheme, solver, 0, size / len(legs) if len(legs) > 1 else size)
        end, singular = _along(part, before, now, held, legs, blur, kept if worlds is None else None)
        if worlds is None:
            return end, singular
        pieces.append((worlds, end, singular))
    return _joined(batch, pieces, state, way)


def _along(
    stepper: EagerStepper[S],
    whole: EagerStepper[S],
    state: S,
    control: Tensor | None,
    legs: tuple[Way, ...],
    blur: Blur | None,
    kept: list[Factors] | None,
) -> tuple[S, Tensor]:
    """One step, or several shorter ones in place of it."""
    integrator, a = stepper.integrator, stepper.articulation
    if len(legs) == 1 and not legs[0].detours:
        objective = stepper.objective(state, control)
        if legs[0].explicit and isinstance(integrator, Leaping):
            return integrator.leap(stepper.scene.terms, objective, state).end, torch.zeros_like(state.time, dtype=torch.bool)
        q, factors = attached(objective, _resolved(objective, legs[0].q), blur, kept[0] if kept else None)
        if kept is not None and not kept:
            kept.append(factors.plain())
        return integrator.advance(objective, state, q)[0], factors.singular
    now = integrator.resized(a, state, whole.step_size, stepper.step_size)
    lost = torch.zeros_like(state.time, dtype=torch.bool)
    for leg in legs:
        now, singular = followed(stepper, now, control, leg, blur)
        lost = lost | singular
    return integrator.resized(a, now, stepper.step_size, whole.step_size), lost


def _resolved(objective: BalanceObjective, q: Tensor) -> Tensor:
    """The root that was found, and where that was in float32, what one of Newton's steps in float64 makes of it."""
    if q.dtype == objective.scale.dtype:
        return q
    q = q.to(objective.scale.dtype)
    with torch.no_grad():
        balance = objective.evaluate(q)
        step = Factors.of(balance.jacobian, balance.stiffness).solve(balance.residual)
        return objective.retract(q, -step).detach()


def _joined(batch: tuple[int, ...], pieces: list[tuple[Worlds, S, Tensor]], state: S, way: Way) -> tuple[S, Tensor]:
    """The ends of some worlds each, as those of the whole batch; zero where there is none."""
    count = way.q[..., 0].numel()

    def gathered(values: list[Tensor]) -> Tensor:
        own = values[0].shape[1:] if batch else values[0].shape
        whole = values[0].new_zeros((count, *own))
        for (worlds, *_), value in zip(pieces, values, strict=True):
            whole = whole.index_copy(0, worlds.index, value.reshape((len(worlds.index), *own)))
        return whole.reshape((*batch, *own))

    if not pieces:
        return mapped_tensors(state, torch.zeros_like), torch.zeros_like(state.time, dtype=torch.bool)
    ends = iter([gathered(list(values)) for values in zip(*(tensors_of(end) for _, end, _ in pieces), strict=True)])
    end: S = mapped_tensors(pieces[0][1], lambda _: next(ends))
    return end, gathered([singular for *_, singular in pieces])
