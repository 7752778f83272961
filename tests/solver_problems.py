"""Small problems with known answers for the solvers, and the solvers by name. A new problem: append it to `PROBLEMS`; a new solver:
to `ROOT_METHODS`, or to `VALUE_METHODS` if it minimises a value. It gets every problem in both dtypes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.directions import GaussNewtonLm, Lm, Newton, ProjectedNewton
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.named import OnLagged, OnSquares, energy_jtj_lm, jtj_lm, lbfgs, lm
from pbfd_torch.solvers.objective import Evaluation, Relaxable, Solution, weighted_error
from pbfd_torch.solvers.searches import Backtracking, Secant, WorkSearch

T = TypeVar("T", bound="FunctionObjective")


class Ease(NamedTuple):
    """By how much a problem was made easier: its share of the full stiffness, its friction's width, whether friction is lagged."""

    share: float = 1.0
    width: float = 1.0
    lagged: bool = False


FULL = Ease()


class Values:
    """Residual, Jacobian and stiffness at one point; every row is computed alone, so that its numbers depend on nothing else."""

    def __init__(self, objective: FunctionObjective, q: Tensor) -> None:
        self._objective = objective
        self._q = q

    def _rows(self, function: Callable[[Tensor], Tensor]) -> Tensor:
        rows = self._q.reshape(-1, self._q.shape[-1])
        values = torch.stack([function(row) for row in rows])
        return values.view((*self._q.shape[:-1], *values.shape[1:]))

    @cached_property
    def residual(self) -> Tensor:
        return self._rows(self._objective.residual)

    @cached_property
    def jacobian(self) -> Tensor:
        return self._rows(self._objective.jacobian)

    @cached_property
    def stiffness(self) -> Tensor:
        return self.jacobian if self._objective.stiffness is None else self._rows(self._objective.stiffness)


class EnergyValues(Values):
    """The same with a value."""

    @cached_property
    def value(self) -> Tensor:
        return self._rows(lambda row: self._objective.function(row, self._objective.ease))


@dataclass(eq=False)
class FunctionObjective:
    """r(q) of each row of q `[*batch, n]`, with its derivatives by automatic differentiation. Notes its evaluations in `calls`.

    function: (q `[n]`, ease) → r `[n]`; of an energy → E `[]`, whose gradient is r. scale: `[n]`, or `[*batch, n]` one per world.
    stiffness: q → `[n, n]`; None takes the Jacobian."""

    function: Callable[[Tensor, Ease], Tensor]
    scale: Tensor
    stiffness: Callable[[Tensor], Tensor] | None = None
    energy: bool = False
    ease: Ease = FULL
    calls: list[Ease] = field(default_factory=list)

    @property
    def rounding(self) -> Tensor:
        return torch.zeros_like(self.scale)

    def residual(self, row: Tensor) -> Tensor:
        """r at one point `[n]`."""
        if not self.energy:
            return self.function(row, self.ease)
        graph = torch.is_grad_enabled() and row.requires_grad
        with torch.enable_grad():
            x = row if graph else row.detach().requires_grad_()
            return torch.autograd.grad(self.function(x, self.ease), x, create_graph=graph)[0]

    def jacobian(self, row: Tensor) -> Tensor:
        """∂r/∂q at one point `[n, n]`."""
        with torch.enable_grad():
            x = row.detach().requires_grad_()
            entries = self.residual(x).unbind()
            rows = [torch.autograd.grad(r, x, retain_graph=True, materialize_grads=True)[0] for r in entries]
        return torch.stack(rows)

    def evaluate(self, q: Tensor) -> Values:
        self.calls.append(self.ease)
        return EnergyValues(self, q) if self.energy else Values(self, q)

    def error(self, evaluation: Evaluation, tolerance: float) -> Tensor:
        return weighted_error(evaluation.residual, self.scale, self.rounding, tolerance)

    def retract(self, q: Tensor, step: Tensor) -> Tensor:
        return q + step

    def turn(self, step: Tensor) -> Tensor:
        return step.new_zeros(step.shape[:-1])

    def take(self: T, index: Tensor) -> T:
        scale = self.scale if self.scale.ndim == 1 else self.scale.reshape(-1, self.scale.shape[-1])[index]
        return dataclasses.replace(self, scale=scale)

    def softened(self: T, factor: float) -> T:
        return dataclasses.replace(self, ease=self.ease._replace(share=self.ease.share * factor))

    def widened(self: T, factor: float) -> T:
        return dataclasses.replace(self, ease=self.ease._replace(width=self.ease.width * factor))

    def shortened(self: T, share: float) -> T:
        return self

    def strayed(self, q: Tensor) -> Tensor:
        return torch.zeros_like(q[..., 0], dtype=torch.bool)

    def lagged(self: T, q: Tensor) -> T:
        return dataclasses.replace(self, ease=self.ease._replace(lagged=True))


@dataclass(frozen=True)
class Problem:
    """r(q) = 0 from `guess` at `root`; `precision`, `precision32`: how near the root a solution at the default tolerance must be in
    float64, float32; `energy`, `stiffness`: see `FunctionObjective`."""

    name: str
    function: Callable[[Tensor, Ease], Tensor]
    guess: tuple[float, ...]
    root: tuple[float, ...]
    precision: float = 1e-8
    energy: bool = False
    stiffness: Callable[[Tensor], Tensor] | None = None
    precision32: float = 5e-3

    def __str__(self) -> str:
        return self.name

    def objective(self, dtype: torch.dtype) -> FunctionObjective:
        return FunctionObjective(self.function, torch.ones(len(self.guess), dtype=dtype), self.stiffness, self.energy)

    def start(self, dtype: torch.dtype) -> Tensor:
        """The guess `[n]`."""
        return torch.tensor(self.guess, dtype=dtype)

    def residual(self, q: Tensor) -> Tensor:
        """r at one point `[n]`."""
        return self.objective(q.dtype).residual(q)


def _quadratic(q: Tensor, ease: Ease) -> Tensor:
    """Minimum at (1, −2)."""
    matrix = q.new_tensor([[4.0, 1.0], [1.0, 3.0]])
    away = q - q.new_tensor([1.0, -2.0])
    return 0.5 * away @ matrix @ away


def _skewed(q: Tensor, ease: Ease) -> Tensor:
    """Not the gradient of anything: the Jacobian has an antisymmetric part as large as the rest."""
    matrix = q.new_tensor([[1.0, 2.0], [-2.0, 1.0]])
    return matrix @ (q - q.new_tensor([0.5, 0.25]))


def _rosenbrock(q: Tensor, ease: Ease) -> Tensor:
    """(1 − x)² + 100 (y − x²)², a bent valley with its end at (1, 1)."""
    x, y = q.unbind(-1)
    return (1 - x) ** 2 + 100 * (y - x * x) ** 2


def _rosenbrock_squares(q: Tensor) -> Tensor:
    """2 AᵀA, A the Jacobian of the two terms that are squared."""
    x = float(q[0])
    rows = q.new_tensor([[-1.0, 0.0], [-20.0 * x, 10.0]])
    return 2 * rows.mT @ rows


def _quartic(q: Tensor, ease: Ease) -> Tensor:
    """x⁴/4 + y²/2: at the minimum the Hessian is singular."""
    return 0.25 * q[0] ** 4 + 0.5 * q[1] ** 2


def _wells(q: Tensor, ease: Ease) -> Tensor:
    """Minima at (±1, 0); at (0, 0) a saddle."""
    x, y = q.unbind(-1)
    return 0.25 * (x * x - 1) ** 2 + 0.5 * y * y


def _wells_convex(q: Tensor) -> Tensor:
    return torch.diag(torch.stack((2 * q[0] ** 2 + 1, torch.ones_like(q[1]))))


def _falling(q: Tensor, ease: Ease) -> Tensor:
    """A mass of 1 kg over a step of 10 ms, pulled to 10 cm below stiff ground: 1e4 (x + .1) = C max(−x, 0)², C = 1e8 N/m²."""
    return (5e3 * (q[0] + 0.1) ** 2 + ease.share * 1e8 / 3 * (-q[0]).clamp_min(0) ** 3) / 1e3


_STICKING_ROOT = 1e-5 * (1 - 0.5**0.5)


def _sticking(q: Tensor, ease: Ease) -> Tensor:
    """A load of half the cone on a contact that slips at |u| < 1e-5: (2 − y) y = ½ at y = u/1e-5; some inertia goes with it."""
    y = q.abs() / 1e-5
    return torch.where(y < 1, (2 - y) * q / 1e-5, torch.sign(q)) - 0.5 + (q - _STICKING_ROOT)


def _falling_root() -> float:
    """Root of 1e4 (x + .1) = 1e8 x² with x < 0."""
    return float((1e4 - (1e8 + 4e8 * 1e4 * 0.1) ** 0.5) / 2e8)


PROBLEMS = (
    Problem("quadratic", _quadratic, (5.0, 7.0), (1.0, -2.0), energy=True),
    Problem("not a gradient", _skewed, (-3.0, 4.0), (0.5, 0.25)),
    Problem("cubic", lambda q, ease: q**3 - 8, (10.0,), (2.0,)),
    Problem("arc tangent: full Newton steps diverge", lambda q, ease: torch.atan(q - 1), (5.0,), (1.0,)),
    Problem("logarithm: NaN beyond zero", lambda q, ease: torch.log(q), (20.0,), (1.0,)),
    Problem("Rosenbrock's valley", _rosenbrock, (-1.2, 1.0), (1.0, 1.0), 1e-6, True, _rosenbrock_squares),
    Problem("singular, many roots", lambda q, ease: q.sum().expand(2) - 2.0, (3.0, 1.0), (2.0, 0.0)),
    # |x³| ≤ 1e-9 leaves |x| ≤ 1e-3, and 1e-3 leaves 0.1
    Problem("singular at the root", _quartic, (2.0, 1.0), (0.0, 0.0), 1e-3, True, None, 0.1),
    Problem("beside a saddle", _wells, (0.01, 0.0), (1.0, 0.0), 1e-8, True, _wells_convex),
    Problem("stiff contact", _falling, (0.05,), (_falling_root(),), energy=True),
    Problem("sticking friction", _sticking, (0.01,), (_STICKING_ROOT,), 1e-8),
)


def problem(name: str) -> Problem:
    """The problem whose name starts so."""
    return next(p for p in PROBLEMS if p.name.startswith(name))


class Method(Protocol):
    """A solver."""

    def solve(self, objective: Relaxable, guess: Tensor, retreat: Tensor | None = None) -> Solution: ...


SECANT = WorkSearch(interpolation=Secant())
LBFGS = dataclasses.replace(lbfgs(), max_evaluations=400)
ROOT_METHODS: dict[str, Descent | OnSquares | Fallbacks] = {
    "Newton, work": Descent(Newton(), WorkSearch()),
    "Newton, secant": Descent(Newton(), SECANT),
    "Newton, backtracking": Descent(Newton(), Backtracking()),
    "projected, work": Descent(ProjectedNewton(), WorkSearch()),
    "projected, secant": Descent(ProjectedNewton(), SECANT),
    "projected, backtracking": Descent(ProjectedNewton(), Backtracking()),
    "JTJ-LM": jtj_lm(),
    "LM on GE": OnSquares(lm()),
    "L-BFGS on GE": OnSquares(LBFGS),
    "fallbacks": Fallbacks(),
}
VALUE_METHODS: dict[str, Descent] = {
    "LM": lm(),
    "LM, backtracking": Descent(Lm(), Backtracking()),
    "Gauss–Newton LM": energy_jtj_lm(),
    "Gauss–Newton, work": Descent(GaussNewtonLm(), WorkSearch()),
    "L-BFGS": LBFGS,
}


METHODS = ROOT_METHODS | VALUE_METHODS
PAIRS = [(name, p) for p in PROBLEMS for name in (METHODS if p.energy else ROOT_METHODS)]


def changed(method: Method, **changes: float) -> Method:
    """The method with other settings of the descent inside it."""
    if isinstance(method, Fallbacks):
        direct, last = dataclasses.replace(method.direct, **changes), dataclasses.replace(method.last, **changes)  # type: ignore[arg-type]
        return dataclasses.replace(method, direct=direct, last=last)
    if isinstance(method, OnSquares | OnLagged):
        return dataclasses.replace(method, solver=dataclasses.replace(method.solver, **changes))  # type: ignore[arg-type]
    assert isinstance(method, Descent)
    return dataclasses.replace(method, **changes)  # type: ignore[arg-type]
