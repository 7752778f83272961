"""Small root-finding problems with known answers, and a wrapper that counts evaluations. A new problem: append it to `PROBLEMS`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Values:
    """Residual, Jacobian and stiffness at one point."""

    residual: Tensor
    jacobian: Tensor
    stiffness: Tensor


@dataclass(eq=False)
class FunctionObjective:
    """r(q) of each row of q `[*batch, n]`, with its Jacobian by automatic differentiation. Counts its evaluations in `calls`.

    function: `[n] → [n]`; softened_function: the same for a share ≤ 1 of the stiff part; stiffness: None takes the Jacobian."""

    function: Callable[[Tensor, float], Tensor]
    scale: Tensor
    stiffness: Callable[[Tensor], Tensor] | None = None
    share: float = 1.0
    calls: list[float] = field(default_factory=list)

    @property
    def rounding(self) -> Tensor:
        return torch.zeros_like(self.scale)

    def evaluate(self, q: Tensor) -> Values:
        self.calls.append(self.share)
        rows = q.reshape(-1, q.shape[-1])
        residual = torch.stack([self.function(row, self.share) for row in rows])
        jacobian = torch.stack([torch.func.jacrev(lambda x: self.function(x, self.share))(row) for row in rows])
        stiffness = jacobian if self.stiffness is None else torch.stack([self.stiffness(row) for row in rows])
        return Values(residual.view_as(q), jacobian.view(*q.shape, -1), stiffness.view(*q.shape, -1))

    def retract(self, q: Tensor, step: Tensor) -> Tensor:
        return q + step

    def turn(self, step: Tensor) -> Tensor:
        return step.new_zeros(step.shape[:-1])

    def softened(self, factor: float) -> FunctionObjective:
        return FunctionObjective(self.function, self.scale, self.stiffness, self.share * factor, self.calls)


@dataclass(frozen=True)
class Problem:
    """r(q) = 0 from `guess` at `root`; `precision`: how near the root a solution at the float64 tolerance must be."""

    name: str
    function: Callable[[Tensor, float], Tensor]
    guess: tuple[float, ...]
    root: tuple[float, ...]
    precision: float = 1e-8

    def __str__(self) -> str:
        return self.name

    def objective(self, dtype: torch.dtype) -> FunctionObjective:
        return FunctionObjective(self.function, torch.ones(len(self.guess), dtype=dtype))


def _linear(q: Tensor, share: float) -> Tensor:
    """SPD: the gradient of a quadratic with minimum at (1, −2)."""
    matrix = q.new_tensor([[4.0, 1.0], [1.0, 3.0]])
    return matrix @ (q - q.new_tensor([1.0, -2.0]))


def _skewed(q: Tensor, share: float) -> Tensor:
    """Not the gradient of anything: the Jacobian has an antisymmetric part as large as the rest."""
    matrix = q.new_tensor([[1.0, 2.0], [-2.0, 1.0]])
    return matrix @ (q - q.new_tensor([0.5, 0.25]))


def _rosenbrock(q: Tensor, share: float) -> Tensor:
    """Gradient of (1 − x)² + 100 (y − x²)², a bent valley with its end at (1, 1)."""
    x, y = q.unbind(-1)
    return torch.stack((-2 * (1 - x) - 400 * x * (y - x * x), 200 * (y - x * x)))


def _falling(q: Tensor, share: float) -> Tensor:
    """A mass of 1 kg over a step of 10 ms, pulled to 10 cm below stiff ground: 1e4 (x + .1) = C max(−x, 0)², C = 1e8 N/m²."""
    return 1e4 * (q + 0.1) / 1e3 - share * 1e8 * (-q).clamp_min(0) ** 2 / 1e3


_STICKING_ROOT = 1e-5 * (1 - 0.5**0.5)


def _sticking(q: Tensor, share: float) -> Tensor:
    """A load of half the cone on a contact that slips at |u| < 1e-5: (2 − y) y = ½ at y = u/1e-5; some inertia goes with it."""
    y = q.abs() / 1e-5
    return torch.where(y < 1, (2 - y) * q / 1e-5, torch.sign(q)) - 0.5 + (q - _STICKING_ROOT)


def _falling_root() -> float:
    """Root of 1e4 (x + .1) = 1e8 x² with x < 0."""
    return float((1e4 - (1e8 + 4e8 * 1e4 * 0.1) ** 0.5) / 2e8)


PROBLEMS = (
    Problem("linear", _linear, (5.0, 7.0), (1.0, -2.0)),
    Problem("not a gradient", _skewed, (-3.0, 4.0), (0.5, 0.25)),
    Problem("cubic", lambda q, share: q**3 - 8, (10.0,), (2.0,)),
    Problem("arc tangent: full Newton steps diverge", lambda q, share: torch.atan(q - 1), (5.0,), (1.0,)),
    Problem("logarithm: NaN beyond zero", lambda q, share: torch.log(q), (20.0,), (1.0,)),
    Problem("Rosenbrock's valley", _rosenbrock, (-1.2, 1.0), (1.0, 1.0), 1e-6),
    Problem("singular, many roots", lambda q, share: q.sum().expand(2) - 2.0, (3.0, 1.0), (2.0, 0.0)),
    Problem("stiff contact", _falling, (0.05,), (_falling_root(),)),
    Problem("sticking friction", _sticking, (0.01,), (_STICKING_ROOT,), 1e-8),
)
