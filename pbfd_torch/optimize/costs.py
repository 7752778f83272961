"""Costs of a motion as sums over its steps, and their second-order expansions in the coordinates of `Chart`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.linearization import Chart
from pbfd_torch.integrators.integrator import S, State
from pbfd_torch.simulator import Simulator
from pbfd_torch.tree.kinematics import difference


@dataclass(frozen=True, eq=False)
class Cost(Generic[S]):
    """What a motion costs: Σ running(x_k, u_k) + final(x_T).

    Attributes:
        running: (state, control `[*, nu]`) → `[*]`; final: state → `[*]`. Twice differentiable by torch, and each world and step by
            itself: `*` has the batch's dimensions last. `state.time` is there for costs that change.
    """

    running: Callable[[S, Tensor], Tensor]
    final: Callable[[S], Tensor]


@dataclass(frozen=True, eq=False)
class Weights:
    """Of squared errors: `q` `[nv]` and `v` `[nv]` (numbers: of all), and `control` `[nu]`; each ≥ 0."""

    q: float | Tensor = 0.0
    v: float | Tensor = 0.0
    control: float | Tensor = 0.0

    def __post_init__(self) -> None:
        for name in ("q", "v", "control"):
            if not bool((torch.as_tensor(getattr(self, name)) >= 0).all()):
                raise InputError(f"weight of {name} is {getattr(self, name)}: must be ≥ 0")


def quadratic(simulator: Simulator[S], q: Tensor, running: Weights, final: Weights) -> Cost[S]:
    """½ Σ w e², e the way from a target at rest at q `[nq]` or `[*batch, nq]`, the velocity and the control."""
    a, dt = simulator.articulation, simulator.step_size

    def of_state(state: S, weights: Weights) -> Tensor:
        away = difference(a, q.expand_as(state.q), state.q)
        v = simulator.integrator.velocity(a, state, dt)
        return 0.5 * ((weights.q * away.square()).sum(-1) + (weights.v * v.square()).sum(-1))

    return Cost(
        lambda state, control: of_state(state, running) + 0.5 * (running.control * control.square()).sum(-1),
        lambda state: of_state(state, final),
    )


@dataclass(frozen=True, eq=False)
class Expansion:
    """A cost near a point: gradient `[*, n]` and Hessian `[*, n, n]` by z = (x, u), or by x alone; made positive semi-definite."""

    gradient: Tensor
    hessian: Tensor


def expanded(simulator: Simulator[Any], state: State, function: Callable[[Any, Tensor], Tensor], control: Tensor) -> Expansion:
    """Of the function of states and controls at a batch of both; control `[*, nu]`, nu = 0 where there is none."""
    chart = Chart(simulator, state)
    n = chart.size + control.shape[-1]
    # one copy for each row of the Hessian
    z = control.new_zeros((n, *control.shape[:-1], n), requires_grad=True)
    with torch.enable_grad():
        x, u = z.split((chart.size, control.shape[-1]), -1)
        value = function(chart.at(x), control + u)
        (gradient,) = torch.autograd.grad(value.sum(), z, create_graph=True, materialize_grads=True)
        seed = torch.eye(n, dtype=z.dtype, device=z.device).reshape(n, *(1,) * (control.ndim - 1), n).expand_as(z)
        if gradient.requires_grad:
            (rows,) = torch.autograd.grad(gradient, z, seed, materialize_grads=True)
        else:
            rows = torch.zeros_like(z)  # linear
    hessian = rows.movedim(0, -2)
    return Expansion(gradient[0].detach(), convex(0.5 * (hessian + hessian.mT)))


def convex(matrix: Tensor) -> Tensor:
    """The symmetric matrix `[*, n, n]` without its negative curvature."""
    values, vectors = torch.linalg.eigh(matrix.nan_to_num(0.0, 0.0, 0.0))
    if bool((values >= 0).all()):
        return matrix
    return (vectors * values.clamp_min(0)[..., None, :]) @ vectors.mT
