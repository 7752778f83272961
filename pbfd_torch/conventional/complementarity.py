"""Unilateral contact with Coulomb friction as complementarity conditions on the velocity at the end of a step (Eq. 7).

A constraint has a normal and two tangents. Its impulse λ [N s] and its velocity u [m/s] obey Signorini's and Coulomb's laws,
    0 ≤ λ_n ⟂ u_n ≥ 0,    ‖λ_t‖ ≤ R = μ λ_n + R₀,    λ_t = −R u_t/‖u_t‖ where u_t ≠ 0,
with a circular cone: no creep, no dilation. They are λ = Π(λ − ρu) for any ρ > 0 (Alart and Curnier 1991), with
    Π_n(z) = max(z_n, 0),    Π_t(z) = z_t cut to the length μ Π_n(z) + R₀;
for R₀ = 0 they are De Saxcé's K ∋ λ ⟂ u + μ‖u_t‖n ∈ K*, K the cone ‖λ_t‖ ≤ μ λ_n.

With A(v − v̂) = Jᵀλ, u = Jv + b, A = LLᵀ, y = Lᵀ(v − v̂) and G = JL⁻ᵀ, what is solved is y = Gᵀλ, u = Gy + û. The impulses need
not be unique (GGᵀ is singular where a body stands on more points than hold it), but y has as many entries as there are degrees of
freedom: it is what is iterated. The method is the augmented Lagrangian one. Outer iterations are λ ← Π(λ − ρu(y)) and converge at
a rate of about 1/(1 + ρσ), σ the smallest non-zero eigenvalue of GGᵀ. Inner ones are semi-smooth Newton for
y = GᵀΠ(λ − ρ(Gy + û)), whose matrix 1 + ρGᵀΠ'G is never singular without friction. ρ starts large, falls where Newton does not
come through, and rises with every outer iteration.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.solvers.objective import Status
from pbfd_torch.solvers.per_world import chosen
from pbfd_torch.tensors.vectors import outer

SOFTEST = 1e-2  # ρ, in units of 1/w, w the constraint's own entry of GGᵀ
LENGTHS = (1.0, 0.7, 0.5, 0.3, 0.15, 0.07, 0.03, 0.01, 0.003, 0.001)  # of steps along a Newton direction, all of them tried
PATIENCE = 15  # Newton steps until ρ falls
CACHE_LINE = 16  # numbers


@dataclass(frozen=True, eq=False)
class FrictionProblem:
    """One problem per world, every world with the same number of constraints.

    Attributes:
        rows: G `[*batch, n, 3, nv]` (normal, tangent, tangent).
        velocity: û `[*batch, n, 3]`, what there is without impulses.
        mu: μ `[*batch, n]` ≥ 0. hold: R₀ `[*batch, n]` ≥ 0 [N s].
        scale: `[*batch]` > 0 [√J] the size of ‖y‖ that counts as one beside the solution's own.
    """

    rows: Tensor
    velocity: Tensor
    mu: Tensor
    hold: Tensor
    scale: Tensor

    def relative(self, impulse: Tensor) -> Tensor:
        """u for impulses λ `[*batch, n, 3]`."""
        return self.along(self.kick(impulse)) + self.velocity

    def along(self, kick: Tensor) -> Tensor:
        """Gy, `[*, *batch, nv] → [*, *batch, n, 3]`."""
        return (self.rows * kick[..., None, None, :]).sum(-1)

    def kick(self, impulse: Tensor) -> Tensor:
        """Gᵀλ, `[*, *batch, n, 3] → [*, *batch, nv]`."""
        return (self.rows * impulse[..., None]).sum((-3, -2))


@dataclass(frozen=True, eq=False)
class Impulses:
    """What solves a problem, or the best that was found.

    Attributes:
        impulse: λ `[*batch, n, 3]`.
        residual_norm: `[*batch]` ‖√w (λ − Π(λ − u/w))‖ over (scale + ‖Gᵀλ‖), w of each constraint the largest of its three
            entries on the diagonal of GGᵀ. Constraints that nothing can move are left out.
        status: `[*batch]` int, values of `Status`.
        iterations: `[*batch]` int, Newton steps.
    """

    impulse: Tensor
    residual_norm: Tensor
    status: Tensor
    iterations: Tensor

    @staticmethod
    def none(free: Tensor) -> Impulses:
        """Those of worlds without any constraint, which end a step with velocities `free` `[*batch, nv]`."""
        finite = torch.isfinite(free).all(-1)
        status = torch.where(finite, int(Status.SOLVED), int(Status.NON_FINITE))
        zero = torch.zeros_like(free[..., 0])
        return Impulses(free.new_zeros((*zero.shape, 0, 3)), zero, status, zero.to(torch.int32))


def projected(z: Tensor, mu: Tensor, hold: Tensor) -> Tensor:
    """Π(z) `[*, n, 3]`."""
    normal, share, _ = _parts(z, mu, hold)
    return torch.cat((normal[..., None], share[..., None] * z[..., 1:]), -1)


def _parts(z: Tensor, mu: Tensor, hold: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Π_n and what is left of each length of z_t, `[*, n]`; and the direction of z_t where it is cut, else 0, `[*, n, 2]`."""
    normal = z[..., 0].clamp_min(0)
    radius = mu * normal + hold
    square = (z[..., 1:] * z[..., 1:]).sum(-1)
    slips = square > radius * radius
    size = torch.where(slips, square, 1.0).sqrt()
    return normal, torch.where(slips, radius / size, 1.0), torch.where(slips, 1 / size, 0.0)[..., None] * z[..., 1:]


def projection_slope(z: Tensor, mu: Tensor, hold: Tensor) -> Tensor:
    """Π'(z) `[*, n, 3, 3]`; not symmetric, because the cut follows the normal."""
    normal, share, along = _parts(z, mu, hold)
    pressed = (normal > 0).to(z.dtype)
    eye = torch.eye(2, dtype=z.dtype, device=z.device)
    by_tangent = share[..., None, None] * (eye - outer(along, along))
    by_normal = torch.cat((pressed[..., None], (mu * pressed)[..., None] * along), -1)
    return torch.cat((by_normal[..., None], torch.cat((torch.zeros_like(by_tangent[..., :1, :]), by_tangent), -2)), -1)


def natural_residual(problem: FrictionProblem, impulse: Tensor) -> Tensor:
    """`Impulses.residual_norm` of any impulses, of a problem in which every constraint can be moved."""
    weight = _own(problem)[..., None]
    free = impulse - problem.relative(impulse) / weight
    error = weight.sqrt() * (impulse - projected(free, problem.mu, problem.hold))
    size = problem.scale + torch.linalg.vector_norm(problem.kick(impulse), dim=-1)
    return torch.linalg.vector_norm(error.flatten(-2), dim=-1) / size


def _own(problem: FrictionProblem) -> Tensor:
    """w `[*batch, n]`."""
    return (problem.rows * problem.rows).sum(-1).amax(-1)


def _regular(problem: FrictionProblem) -> FrictionProblem:
    """The problem with constraints that no impulse can move replaced by ones that hold by themselves. And y is given zeros at its
    end: products of matrices round by where these lie in memory, and ones of whole cache lines lie alike in every batch."""
    own = _own(problem)
    moves = own > 1e-12 * own.amax(-1, keepdim=True)
    unit = torch.zeros_like(problem.rows)
    unit[..., 0, 0] = 1.0
    apart = torch.full_like(problem.velocity, torch.inf)
    apart[..., 1:] = 0
    rows = torch.where(moves[..., None, None], problem.rows, unit)
    return dataclasses.replace(
        problem,
        rows=torch.nn.functional.pad(rows, (0, -rows.shape[-1] % CACHE_LINE)),
        velocity=torch.where(moves[..., None], problem.velocity, apart),
        mu=torch.where(moves, problem.mu, 0.0),
        hold=torch.where(moves, problem.hold, 0.0),
    )


@dataclass(frozen=True, eq=False)
class _Iterate:
    base: Tensor  # λ of the outer iteration
    kick: Tensor  # y
    stiffness: Tensor  # ρ in units of 1/w
    steps: Tensor  # Newton steps since the last outer iteration or change of ρ


def solve(problem: FrictionProblem, guess: Tensor, tolerance: float, limit: int) -> Impulses:
    """Impulses of all worlds, from a guess `[*batch, n, 3]`; a world is solved where its `residual_norm` ≤ `tolerance`, and has at
    most `limit` Newton steps. Worlds iterate in lock step until the last one is done; none sees another."""
    problem = _regular(problem)
    weight = _own(problem)
    rounding = torch.finfo(guess.dtype).eps
    start, stiffest = rounding**-0.25, rounding**-0.4  # beyond, rounding errors of u count too much in λ
    base = projected(guess, problem.mu, problem.hold)
    now = _Iterate(base, problem.kick(base), torch.full_like(problem.scale, start), torch.zeros_like(problem.scale))
    best, error = base, natural_residual(problem, base)
    finite = torch.isfinite(error)
    iterations = torch.zeros_like(problem.scale, dtype=torch.int32)
    for _ in range(limit):
        running = (error > tolerance) & finite
        if not bool(running.any()):
            break
        impulse, following = _iterated(problem, weight, now, stiffest, tolerance)
        now = chosen(running, following, now)
        residual = natural_residual(problem, impulse)
        best, error = chosen(running & (residual < error), (impulse, residual), (best, error))
        iterations = iterations + running.to(torch.int32)
    status = torch.where(error <= tolerance, int(Status.SOLVED), int(Status.ITERATION_LIMIT))
    return Impulses(best, error, torch.where(finite, status, int(Status.NON_FINITE)), iterations)


def _iterated(
    problem: FrictionProblem, weight: Tensor, now: _Iterate, stiffest: float, tolerance: float
) -> tuple[Tensor, _Iterate]:
    """One Newton step, and the impulses that it leads to; an outer iteration follows where they balance it."""
    mu, hold = problem.mu, problem.hold
    stiffness = (now.stiffness[..., None] / weight)[..., None]
    z = now.base - stiffness * (problem.along(now.kick) + problem.velocity)
    residual = now.kick - problem.kick(projected(z, mu, hold))
    slope = stiffness[..., None] * projection_slope(z, mu, hold)
    rows = problem.rows.flatten(-3, -2)
    matrix = torch.eye(rows.shape[-1], dtype=rows.dtype, device=rows.device) + rows.mT @ (slope @ problem.rows).flatten(-3, -2)
    step = -torch.linalg.solve_ex(matrix, residual[..., None])[0].squeeze(-1)

    lengths = torch.tensor(LENGTHS, dtype=z.dtype, device=z.device).reshape(-1, *[1] * residual.ndim)
    tried = now.kick + lengths * step
    impulses = projected(z - lengths[..., None] * (stiffness * problem.along(step)), mu, hold)
    errors = torch.linalg.vector_norm(tried - problem.kick(impulses), dim=-1)
    found, which = errors.min(0)
    kick, impulse = _picked(tried, which), _picked(impulses, which)
    descends = found < torch.linalg.vector_norm(residual, dim=-1)
    kick = torch.where(descends[..., None], kick, now.kick)

    size = problem.scale + torch.linalg.vector_norm(problem.kick(impulse), dim=-1)
    share = 0.1 * natural_residual(problem, impulse)
    balanced = found <= share.clamp(0.1 * tolerance, 1e-2) * size
    softens = ~balanced & (~descends | (now.steps >= PATIENCE))
    harder = (3 * now.stiffness).clamp_max(stiffest)
    softer = (0.01 * now.stiffness).clamp_min(SOFTEST)
    return impulse, _Iterate(
        base=torch.where(balanced[..., None, None], impulse, now.base),
        kick=kick,
        stiffness=torch.where(balanced, harder, torch.where(softens, softer, now.stiffness)),
        steps=torch.where(balanced | softens, 0, now.steps + 1),
    )


def _picked(values: Tensor, which: Tensor) -> Tensor:
    """Of `[k, *batch, *event]` the entry of each world, `which` `[*batch]`."""
    index = which.reshape(1, *which.shape, *[1] * (values.ndim - 1 - which.ndim))
    return values.gather(0, index.expand(1, *values.shape[1:])).squeeze(0)
