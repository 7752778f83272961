"""Is the compiled core the reference? Its r and J at any configuration, and where its steps end."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch import Articulation, Scene, Simulator
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.integrators.integrator import fresh
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.solvers.objective import Status
from pbfd_torch.tensors.worlds import Worlds

DT = 0.01


def resting(a: Articulation, q: Tensor, v: Tensor) -> Velocities:
    """A state that has felt nothing yet."""
    zero, nothing = torch.zeros_like(q[..., 0]), torch.zeros_like(v)
    return Velocities(**fresh(q), v=v, push=nothing, steady=nothing, lag=nothing, average=v, gained=zero, surplus=zero, peak=zero)


def gaps(scene: Scene, state: Velocities, q: Tensor, control: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """How far the core's r and J at q are from the reference's, `[worlds]` each: of the largest entry."""
    simulator = Simulator(scene, DT)
    native = NativeStepper(simulator.eager)
    residual, jacobian = native._core.balance(state, control, q)
    balance = simulator.eager.objective(state, control).evaluate(q)
    pairs = ((residual, balance.residual), (jacobian.flatten(-2), balance.jacobian.flatten(-2)))
    first, second = ((ours - theirs).abs().amax(-1) / theirs.abs().amax(-1) for ours, theirs in pairs)
    return first, second


def require_balance(scene: Scene, state: Velocities, q: Tensor, control: Tensor | None = None) -> None:
    """Nothing but rounding is between the core's r and J and the reference's."""
    residual, jacobian = gaps(scene, state, q, control)
    assert float(residual.max()) < 1e-9, residual.argmax()
    assert float(jacobian.max()) < 1e-9, jacobian.argmax()


def require_steps(scene: Scene, start: Velocities, control: Tensor | None = None, steps: int = 5) -> None:
    """Steps end where the reference's do, and a world goes alone as in a batch."""
    simulator = Simulator(scene, DT)
    native = NativeStepper(simulator.eager)
    state = simulator.initial_state(start.q, start.v, control)
    worlds = len(start.q)
    direct = same = 0
    for _ in range(steps):
        after, solution, _ = native.made(state, control)
        objective = simulator.eager.objective(state, control)
        plain = solution.status == int(Status.SOLVED)
        error = objective.error(objective.evaluate(after.q), 1e-9)
        assert bool((error[plain] <= 1e-9).all())
        reference, eager, _ = simulator.eager.made(state, control)
        both = plain & (eager.status == int(Status.SOLVED))
        alike = both & ((after.q - reference.q).abs().amax(-1) < 1e-7)
        direct, same = direct + int(both.sum()), same + int(alike.sum())
        for field in ("v", "push", "steady", "lag", "surplus", "hazards"):
            assert torch.allclose(getattr(after, field)[alike] + 0.0, getattr(reference, field)[alike] + 0.0, 1e-5, 1e-5), field
        state = reference
    assert same >= 0.97 * direct > 0
    whole, _, _ = native.made(state, control)
    for index in (torch.tensor([3]), torch.tensor([worlds - 1, 0, 3])):
        held = None if control is None else control[index]
        some = Worlds((worlds,), index)
        part, _, _ = native.take(some).made(state.take(some), held)
        assert torch.equal(part.q, whole.q[index])
        assert torch.equal(part.v, whole.v[index])
