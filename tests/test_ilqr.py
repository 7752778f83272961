"""iLQR: box programmes, the exact Riccati solution of a linear problem, limits, and the swing-up from random starts."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.optimize import Cost, Limits, Search, Weights, ilqr, quadratic
from pbfd_torch.optimize.box_qp import box_minimum
from pbfd_torch.optimize.costs import convex, expanded
from pbfd_torch.optimize.tasks import ArmSwingUp
from pbfd_torch.optimize.tasks.arm_swing_up import EFFORT, LENGTH
from pbfd_torch.optimize.tasks.arm_swing_up import MASS as MASS_OF_ARM
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link

MASS, DT, STEPS, WORLDS = 2.0, 0.1, 15, 3
RUNNING, FINAL = Weights(1.0, 0.1, 0.01), Weights(10.0, 1.0)


@pytest.fixture(scope="module")
def cart() -> Simulator[Any]:
    """A mass on two slides with a motor each: linear, and exactly so in the scheme."""
    slides = (Joint("x", JointKind.SLIDE, (1.0, 0.0, 0.0)), Joint("y", JointKind.SLIDE, (0.0, 1.0, 0.0)))
    rows = ((0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1))
    articulation = Articulation.from_links([Link("cart", joints=slides, mass=MASS, inertia=rows)])
    motors = Actuators.from_list(articulation, [Actuator.motor(name, name) for name in ("x", "y")])
    return Simulator(Scene(articulation, (Inertia(), motors), torch.zeros(3, dtype=torch.float64)), DT)


@pytest.fixture
def start(cart: Simulator[Any]) -> Any:
    torch.manual_seed(0)
    return cart.initial_state(*torch.randn(2, WORLDS, 2, dtype=torch.float64))


def target(cart: Simulator[Any]) -> Cost[Any]:
    """At rest at the origin."""
    return quadratic(cart, torch.zeros(2, dtype=torch.float64), RUNNING, FINAL)


def zeros() -> Tensor:
    return torch.zeros(STEPS, WORLDS, 2, dtype=torch.float64)


# the box programme --------------------------------------------------------------------------------------------------------


def test_box_minimum_is_the_best_of_all_faces() -> None:
    """Against an enumeration of which components stand at which bound, for 200 random convex programmes of three variables."""
    torch.manual_seed(1)
    root = torch.randn(200, 3, 3, dtype=torch.float64)
    H = root @ root.mT + 0.01 * torch.eye(3, dtype=torch.float64)
    g = 3 * torch.randn(200, 3, dtype=torch.float64)
    lower, upper = -torch.rand(200, 3, dtype=torch.float64), torch.rand(200, 3, dtype=torch.float64)
    found = box_minimum(H, g, lower, upper)
    assert bool(((found.x >= lower) & (found.x <= upper)).all())

    def value(x: Tensor) -> Tensor:
        return (0.5 * x * (H @ x[..., None]).squeeze(-1) + g * x).sum(-1)

    best = torch.full((200,), torch.inf, dtype=torch.float64)
    for face in itertools.product((-1, 0, 1), repeat=3):
        side = torch.tensor(face)
        free = (side == 0).double()
        fixed = torch.where(side < 0, lower, torch.where(side > 0, upper, 0.0))
        matrix = free[:, None] * H * free + torch.diag(1 - free)
        inner = torch.linalg.solve(matrix, free * -(g + (H @ fixed[..., None]).squeeze(-1)))
        x = fixed + free * inner
        inside = ((x >= lower) & (x <= upper)).all(-1)
        best = torch.where(inside, torch.minimum(best, value(x)), best)
    torch.testing.assert_close(value(found.x), best, rtol=0, atol=1e-10)


def test_box_minimum_without_bounds_is_newton() -> None:
    """Infinite bounds leave −H⁻¹g, and every component free."""
    torch.manual_seed(2)
    root = torch.randn(4, 3, 3, dtype=torch.float64)
    H, g = root @ root.mT + torch.eye(3, dtype=torch.float64), torch.randn(4, 3, dtype=torch.float64)
    free = torch.full((3,), torch.inf, dtype=torch.float64)
    found = box_minimum(H, g, -free, free)
    torch.testing.assert_close(found.x, -torch.linalg.solve(H, g))
    assert bool(found.free.all())


# expansions of costs --------------------------------------------------------------------------------------------------------


def test_expansion_of_a_cost_is_exact(cart: Simulator[Any], start: Any) -> None:
    """The gradient and Hessian of the quadratic cost are its weights; negative curvature is taken out of others."""
    control = torch.ones(WORLDS, 2, dtype=torch.float64)
    found = expanded(cart, start, target(cart).running, control)
    wanted = torch.cat((1.0 * start.q, 0.1 * start.v, 0.01 * control), -1)
    torch.testing.assert_close(found.gradient, wanted)
    torch.testing.assert_close(found.hessian[0], torch.diag(torch.tensor([1, 1, 0.1, 0.1, 0.01, 0.01], dtype=torch.float64)))
    torch.testing.assert_close(convex(torch.diag(torch.tensor([2.0, -1.0]))), torch.diag(torch.tensor([2.0, 0.0])))


def test_a_linear_cost_has_no_curvature(cart: Simulator[Any], start: Any) -> None:
    found = expanded(cart, start, lambda state, u: state.q.sum(-1) + u.sum(-1), torch.zeros(WORLDS, 2, dtype=torch.float64))
    assert bool((found.hessian == 0).all())
    assert found.gradient[0].tolist() == [1, 1, 0, 0, 1, 1]


# the linear problem ---------------------------------------------------------------------------------------------------------


def riccati(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Controls, gains and cost of the exact solution for one axis, from x `[*, 2]`: x⁺ = x + Δt v + Δt² u/2m, v⁺ = v + Δt u/m."""
    A = torch.tensor([[1, DT], [0, 1]], dtype=torch.float64)
    B = torch.tensor([[DT * DT / 2 / MASS], [DT / MASS]], dtype=torch.float64)
    Q, R = torch.diag(torch.tensor([1.0, 0.1], dtype=torch.float64)), 0.01
    P = torch.diag(torch.tensor([10.0, 1.0], dtype=torch.float64))
    gains = []
    for _ in range(STEPS):
        K = -(B.T @ P @ A) / (R + B.T @ P @ B)
        P = Q + A.T @ P @ A + A.T @ P @ B @ K
        gains.append(K)
    cost = 0.5 * (x * (x @ P)).sum(-1)
    controls = []
    for K in reversed(gains):
        u = x @ K.T
        x = x @ A.T + u @ B.T
        controls.append(u)
    return torch.cat(controls, -1).movedim(-1, 0), torch.stack(gains[::-1]), cost


def test_linear_problem_is_the_riccati_solution(cart: Simulator[Any], start: Any) -> None:
    """After one iteration: controls, gains and cost, to rounding; then it has converged."""
    found = ilqr(cart, start, zeros(), target(cart))
    exact = [riccati(torch.stack((start.q[:, k], start.v[:, k]), -1)) for k in range(2)]
    torch.testing.assert_close(found.controls, torch.stack([e[0] for e in exact], -1), rtol=0, atol=1e-7)
    torch.testing.assert_close(found.motion.cost, exact[0][2] + exact[1][2], rtol=1e-9, atol=0)
    torch.testing.assert_close(found.history[1], found.motion.cost, rtol=1e-9, atol=0)
    for k in range(2):
        gains = found.policy.feedback[:, 0, k, [k, k + 2]]
        torch.testing.assert_close(gains, exact[k][1].squeeze(1), rtol=1e-6, atol=1e-6)
    assert bool(found.converged.all())
    assert not bool(found.stalled.any())
    assert len(found.history) <= 4
    assert found.unsolved.tolist() == found.doubtful.tolist() == [0, 0, 0]


def test_limits_hold_exactly_and_are_used(cart: Simulator[Any], start: Any) -> None:
    """Controls are within their limits to the bit, often at them, and no better than without; the gradient by those that are free
    vanishes."""
    most = torch.tensor([2.0, 3.0], dtype=torch.float64)
    found = ilqr(cart, start, 10 + zeros(), target(cart), Limits.within(most))
    free = ilqr(cart, start, zeros(), target(cart))
    assert bool((found.controls.abs() <= most).all())
    at = found.controls.abs() == most
    assert int(at.sum()) > 10
    assert bool(found.converged.all())
    assert bool((found.motion.cost >= free.motion.cost).all())
    controls = found.controls.clone().requires_grad_()
    motion = cart.trajectory(start, controls)
    q, v = motion.q, motion.v
    value = (0.5 * q[:-1].square() + 0.05 * v[:-1].square()).sum() + 0.005 * controls.square().sum()
    value = value + (5 * q[-1].square() + 0.5 * v[-1].square()).sum()
    torch.testing.assert_close(value.detach(), found.motion.cost.sum(), rtol=1e-9, atol=0)
    value.backward()
    assert controls.grad is not None
    assert float(controls.grad[~at].abs().max()) < 1e-4
    assert bool((controls.grad[at] * found.controls[at] <= 1e-9).all())


def test_worlds_do_not_feel_each_other(cart: Simulator[Any], start: Any) -> None:
    """One world alone gives what it gives among others, with limits of its own."""
    most = torch.tensor([[2.0, 2.0], [3.0, 3.0], [9.0, 9.0]], dtype=torch.float64)
    together = ilqr(cart, start, zeros(), target(cart), Limits.within(most))
    alone = ilqr(cart, cart.initial_state(start.q[1:2], start.v[1:2]), zeros()[:, 1:2], target(cart), Limits.within(most[1:2]))
    torch.testing.assert_close(together.controls[:, 1], alone.controls[:, 0], rtol=0, atol=1e-6)


def test_a_world_without_finite_cost_is_left_alone(cart: Simulator[Any], start: Any) -> None:
    """Its cost is infinite and it has not converged; the others are as good as ever."""
    plain = target(cart)
    broken = Cost[Any](plain.running, lambda state: plain.final(state) + state.q.new_tensor([0.0, torch.nan, 0.0]))
    found = ilqr(cart, start, zeros(), broken)
    assert found.converged.tolist() == [True, False, True]
    assert torch.isinf(found.motion.cost).tolist() == [False, True, False]
    torch.testing.assert_close(found.motion.cost[::2], ilqr(cart, start, zeros(), plain).motion.cost[::2])


# bad input --------------------------------------------------------------------------------------------------------------------


def test_bad_input_is_named(cart: Simulator[Any], start: Any) -> None:
    with pytest.raises(InputError, match=r"controls have shape \(15, 3, 1\): must be \[T ≥ 1, 3, 2\]"):
        ilqr(cart, start, zeros()[..., :1], target(cart))
    with pytest.raises(InputError, match="iterations is 0: must be ≥ 1"):
        Search(iterations=0)
    with pytest.raises(InputError, match=r"shrink is 1\.0: must be > 0 and < 1"):
        Search(shrink=1.0)
    with pytest.raises(InputError, match="must be below"):
        Limits.within(torch.tensor([1.0, 0.0]))
    with pytest.raises(InputError, match=r"weight of v is -1\.0: must be ≥ 0"):
        Weights(v=-1.0)
    with pytest.raises(InputError, match="worlds is 0: must be ≥ 1"):
        ArmSwingUp(0)


# the swing-up -----------------------------------------------------------------------------------------------------------------


def test_the_arm_swings_up_from_random_starts() -> None:
    """Of 20 random starts, which all hang at the end, at least 19 stand upright, within the limits and without unsolved steps."""
    outcome = ArmSwingUp(20, seed=3).solve(26)
    assert int(outcome.reached.sum()) >= 19
    assert outcome.unsolved.sum() == 0
    controls = outcome.after.controls
    assert controls is not None
    effort = torch.tensor(EFFORT, dtype=torch.float64)
    assert bool((controls.abs() <= effort).all())
    assert bool((controls.abs() == effort).any())
    assert bool((outcome.history[0] > 100 * outcome.history[-1].median()).all())


def test_the_arm_is_too_weak_to_be_lifted_slowly() -> None:
    """Held out straight it needs more than the shoulder's motor has."""
    assert EFFORT[0] < 9.81 * MASS_OF_ARM * LENGTH * 2
