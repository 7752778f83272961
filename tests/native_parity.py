"""Is the compiled core the reference? Its r and J at any configuration, and where its steps end."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch import Scene, Simulator
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.integrators.integrator import fresh
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.tensors.worlds import Worlds

DT = 0.01


def resting(q: Tensor, v: Tensor) -> Velocities:
    """A state that has felt nothing yet."""
    zero, nothing = torch.zeros_like(q[..., 0]), torch.zeros_like(v)
    return Velocities(**fresh(q), v=v, push=nothing, steady=nothing, lag=nothing, average=v, gained=zero, surplus=zero, peak=zero)


def gaps(scene: Scene, state: Velocities, q: Tensor, control: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """How far the core's r and J at q are from the reference's, `[worlds]` each: of the largest entry."""
    simulator = Simulator(scene, DT)
    native = NativeStepper(simulator.eager)
    residual, jacobian = native._core.balance(native.complete(state), control, q)
    balance = simulator.eager.objective(state, control).evaluate(q)
    pairs = ((residual, balance.residual), (jacobian.flatten(-2), balance.jacobian.flatten(-2)))
    first, second = ((ours - theirs).abs().amax(-1) / theirs.abs().amax(-1) for ours, theirs in pairs)
    return first, second


def require_balance(scene: Scene, state: Velocities, q: Tensor, control: Tensor | None = None) -> None:
    """Nothing but rounding is between the core's r and J and the reference's."""
    residual, jacobian = gaps(scene, state, q, control)
    assert float(residual.max()) < 1e-9, residual.argmax()
    assert float(jacobian.max()) < 1e-9, jacobian.argmax()


@dataclass(frozen=True, eq=False)
class Compared:
    """A step of both: where they end, how the core's was solved, which worlds both solve directly, and which of them alike."""

    after: Velocities
    reference: Velocities
    solution: Solution
    both: Tensor
    alike: Tensor


def compared(native: NativeStepper[Velocities], state: Velocities, control: Tensor | None) -> Compared:
    """The step of the core and of the reference. What the core solves directly are roots by the reference's own error."""
    after, solution, _ = native.made(state, control)
    objective = native.eager.objective(state, control)
    plain = solution.status == int(Status.SOLVED)
    error = objective.error(objective.evaluate(after.q), 1e-9)
    assert bool((error[plain] <= 1e-9).all())
    reference, eager, _ = native.eager.made(state, control)
    both = plain & (eager.status == int(Status.SOLVED))
    return Compared(after, reference, solution, both, both & ((after.q - reference.q).abs().amax(-1) < 1e-7))


def require_steps(scene: Scene, start: Velocities, control: Tensor | None = None, steps: int = 5) -> None:
    """Steps end where the reference's do, and a world goes alone as in a batch."""
    simulator = Simulator(scene, DT)
    native = NativeStepper(simulator.eager)
    state = simulator.initial_state(start.q, start.v, control)
    worlds = len(start.q)
    direct = same = 0
    for _ in range(steps):
        step = compared(native, state, control)
        direct, same = direct + int(step.both.sum()), same + int(step.alike.sum())
        for field in ("v", "push", "steady", "lag", "surplus", "hazards"):
            ours, theirs = (getattr(x, field)[step.alike] + 0.0 for x in (step.after, step.reference))
            assert torch.allclose(ours, theirs, 1e-5, 1e-5), field
        state = step.reference
    assert same >= 0.97 * direct > 0
    whole, _, _ = native.made(state, control)
    for index in (torch.tensor([3]), torch.tensor([worlds - 1, 0, 3])):
        held = None if control is None else control[index]
        some = Worlds((worlds,), index)
        part, _, _ = native.take(some).made(state.take(some), held)
        assert torch.equal(part.q, whole.q[index])
        assert torch.equal(part.v, whole.v[index])
