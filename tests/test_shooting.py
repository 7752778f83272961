"""Shooting: torch's optimisers and Gauss–Newton on motions with a known answer, honesty about unsolved steps, and the throw."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.implicit import Doubtful, Gradients
from pbfd_torch.gradients.trajectory import Trajectory
from pbfd_torch.models import SCENES
from pbfd_torch.optimize import Bounds, Controls, Limits, Shooting, StartVelocity, Stopping
from pbfd_torch.optimize.tasks import BoxThrow, Hopper
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link

DT, STEPS, WORLDS, MASS = 0.1, 6, 3, 2.0


def slider(solver: Descent | None = None) -> Simulator[Any]:
    """A mass on a slide with a motor, without gravity."""
    rows = ((0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1))
    link = Link("cart", joints=(Joint("x", JointKind.SLIDE, (1.0, 0.0, 0.0)),), mass=MASS, inertia=rows)
    articulation = Articulation.from_links([link])
    motor = Actuators.from_list(articulation, [Actuator.motor("x", "x")])
    scene = Scene(articulation, (Inertia(), motor), torch.zeros(3, dtype=torch.float64))
    return Simulator(scene, DT, solver=solver, halvings=0, gradients=Gradients(doubtful=Doubtful.ZERO))


def pushed(most: float, held: int = 1) -> Shooting[Any]:
    """The slider from rest at three places, its control within ±most."""
    simulator = slider()
    start = simulator.initial_state(torch.tensor([[0.0], [0.5], [-1.0]], dtype=torch.float64))
    limit = torch.tensor([most], dtype=torch.float64)
    return Shooting(simulator, Controls(start, Limits.within(limit), STEPS, held))


def to_one(motion: Trajectory[Any], controls: Tensor | None) -> Tensor:
    """At x = 1, at rest, with little force: [*batch, 2 + T]."""
    assert controls is not None
    return torch.cat((motion.q[-1] - 1, motion.v[-1], 0.01 * controls.squeeze(-1).movedim(0, -1)), -1)


def squared(motion: Trajectory[Any], controls: Tensor | None) -> Tensor:
    return 0.5 * to_one(motion, controls).square().sum(-1)


def exact(x: float) -> Tensor:
    """The controls that `to_one` asks for from rest at x, by the normal equations: x_T = x + Σ Δt²/m (T − k − ½) u_k."""
    k = torch.arange(STEPS, dtype=torch.float64)
    rows = torch.stack((DT * DT / MASS * (STEPS - k - 0.5), torch.full_like(k, DT / MASS)))
    J = torch.cat((rows, 0.01 * torch.eye(STEPS, dtype=torch.float64)))
    wanted = torch.cat((torch.tensor([1 - x, 0.0], dtype=torch.float64), torch.zeros(STEPS, dtype=torch.float64)))
    return torch.linalg.solve(J.T @ J, J.T @ wanted)


def test_gauss_newton_solves_a_linear_problem() -> None:
    """The controls of the normal equations, for each world its own; it has converged, and no step is unsolved or doubtful."""
    shot = pushed(1e3).gauss_newton(to_one, torch.zeros(WORLDS, STEPS, dtype=torch.float64), Stopping(40, 1e-10, 1e-12))
    for world, x in enumerate((0.0, 0.5, -1.0)):
        torch.testing.assert_close(shot.x[world], exact(x), rtol=1e-4, atol=1e-4)
    assert bool(shot.converged.all())
    assert shot.unsolved.tolist() == shot.doubtful.tolist() == shot.skipped.tolist() == [0, 0, 0]
    torch.testing.assert_close(shot.cost, shot.history[-1])
    assert shot.plan.controls is not None
    torch.testing.assert_close(shot.plan.controls[..., 0].T, shot.x)


@pytest.mark.parametrize(
    ("optimiser", "iterations"),
    [(lambda x: torch.optim.Adam(x, lr=0.1), 30), (lambda x: torch.optim.LBFGS(x, max_iter=20), 2)],
    ids=["Adam", "L-BFGS"],
)
def test_optimisers_of_torch_come_near(optimiser: Callable[[Any], torch.optim.Optimizer], iterations: int) -> None:
    """To the least cost and a hundredth of that at the start; the history never rises, and its end is the cost of the result."""
    shooting = pushed(30.0)
    shot = shooting.descend(squared, torch.zeros(WORLDS, STEPS, dtype=torch.float64), optimiser, iterations)
    assert bool((shot.history[1:] <= shot.history[:-1]).all())
    least = shooting.gauss_newton(to_one, torch.zeros(WORLDS, STEPS, dtype=torch.float64), Stopping(15)).cost
    assert bool((shot.cost <= least + 0.01 * shot.history[0]).all())
    torch.testing.assert_close(shot.cost, shot.history[-1])
    assert not bool(shot.converged.any())


def test_limits_and_held_controls() -> None:
    """Controls stay within their limits, some at them, and change every third step only."""
    shot = pushed(4.0, held=3).gauss_newton(to_one, torch.zeros(WORLDS, 2, dtype=torch.float64))
    controls = shot.plan.controls
    assert controls is not None
    assert controls.shape == (STEPS, WORLDS, 1)
    assert bool((controls.abs() <= 4.0).all())
    assert bool((controls.abs() == 4.0).any())
    assert bool((controls.unflatten(0, (2, 3)) == controls[::3, None]).all())


def test_a_start_velocity_is_found() -> None:
    """A sliding box, μ = .1, .2, .3, is to come to rest after .4 m: v² = 2 μ g d, but for what the last step takes."""
    setup = SCENES["box-slide"](worlds=3)
    simulator = Simulator(setup.scene, 0.05)
    most = torch.tensor([5.0], dtype=torch.float64)
    decision = StartVelocity(simulator, 20, setup.q, torch.zeros_like(setup.v), (0,), Bounds(-most, most, most))
    shot = Shooting(simulator, decision).gauss_newton(
        lambda motion, _: motion.q[-1, ..., :1] - motion.q[0, ..., :1] - 0.4, torch.ones(3, 1, dtype=torch.float64), Stopping(6)
    )
    wanted = [math.sqrt(2 * mu * 9.81 * 0.4) for mu in (0.1, 0.2, 0.3)]
    assert bool((shot.cost < 1e-8).all())
    assert shot.x[:, 0].tolist() == pytest.approx(wanted, rel=0.05)


def test_unsolved_steps_are_not_silent() -> None:
    """With a solver that may evaluate once only, motions with unsolved steps are counted and never the best."""
    simulator = slider(Descent(max_evaluations=1))
    start = simulator.initial_state(torch.zeros(2, 1, dtype=torch.float64))
    shooting = Shooting(simulator, Controls(start, Limits.within(torch.tensor([9.0], dtype=torch.float64)), STEPS))
    x = torch.stack((torch.zeros(STEPS), torch.full((STEPS,), 3.0))).double()  # without force a guess is the solution
    shot = shooting.descend(squared, x, lambda x: torch.optim.SGD(x, lr=0.0), 2)
    assert torch.isinf(shot.cost).tolist() == [False, True]
    assert shot.skipped.tolist() == [0, 3]
    assert int(shot.unsolved[0]) == int(shot.doubtful[0]) == 0
    assert int(shot.unsolved[1]) == int(shot.doubtful[1]) > 0
    fitted = shooting.gauss_newton(to_one, x, Stopping(2))
    assert torch.isinf(fitted.cost).tolist()[1]
    assert int(fitted.skipped[1]) > 0


def test_the_box_is_thrown_onto_its_target() -> None:
    """From 20 random throws, at least 19 end within 1 cm of the target and at rest, without unsolved steps."""
    outcome = BoxThrow(20).solve(6)
    assert int(outcome.reached.sum()) >= 19
    assert bool((outcome.history[0] > 1).all())  # none is within 1 cm, at rest
    assert outcome.unsolved.sum() == 0


def test_the_hopper_jumps() -> None:
    """Gradients through the foot's contact find a jump to a height that no start comes near."""
    outcome = Hopper(2).solve(6)
    assert bool(outcome.reached.all())
    assert bool((outcome.history[0] > 10).all())


def test_bad_input_is_named() -> None:
    simulator = slider()
    start, limits = simulator.initial_state(), Limits.within(torch.ones(1, dtype=torch.float64))
    one = torch.ones(1, dtype=torch.float64)
    with pytest.raises(InputError, match="steps is 0: must be ≥ 1"):
        Controls(start, limits, 0)
    with pytest.raises(InputError, match="held is 0: must be ≥ 1"):
        Controls(start, limits, 3, held=0)
    with pytest.raises(InputError, match=r"limits have shape \(1, 1\): must be \[nu\]"):
        Controls(start, Limits.within(one[None]), 3)
    with pytest.raises(InputError, match=r"free is \(1,\): must be different numbers from 0 to 0"):
        StartVelocity(simulator, 3, start.q, start.v, (1,), Bounds(-one, one, one))
    with pytest.raises(InputError, match="bounds are of 1 velocities, 0 are free"):
        StartVelocity(simulator, 3, start.q, start.v, (), Bounds(-one, one, one))
    with pytest.raises(InputError, match="iterations is 0: must be ≥ 1"):
        pushed(1.0).descend(squared, torch.zeros(WORLDS, STEPS, dtype=torch.float64), torch.optim.SGD, 0)
    with pytest.raises(InputError, match="worlds is 0: must be ≥ 1"):
        BoxThrow(0)
