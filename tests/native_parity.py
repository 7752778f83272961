"""Is the compiled core the reference? Its r and J at any configuration, where its steps end, and what its starts make of theirs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch import Scene, Simulator
from pbfd_torch.balance.dynamics import mass_matrix
from pbfd_torch.integrators.energy_momentum import EnergyMomentum, Velocities
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator, S, State, fresh
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.tensors.shapes import spread
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.tree.kinematics import difference

DT = 0.01


class OwnScheme(EnergyMomentum):
    """A user's own, which the core cannot know."""


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


def at_once(eager: EagerStepper[S]) -> EagerStepper[S]:
    """The reference without fallbacks, which take it long: a step that is solved at its first attempt ends as it does with them,
    and other ends are compared with nothing."""
    return eager.changed(evaluations=1)


@dataclass(frozen=True, eq=False)
class Compared:
    """Steps of the core one after another, and the reference's from where each of them begins: as one batch `[steps · worlds]`,
    which takes PyTorch hardly longer than one of them.

    Attributes:
        stepper: the reference.
        before, control: where each step begins, and what it is given.
        after, solution: of the core.
        expected, found: of the reference.
        both: which both solve directly. near: which end at the same root. alike: both.
    """

    stepper: EagerStepper[Any]
    before: Any
    control: Tensor | None
    after: Any
    solution: Solution
    expected: Any
    found: Solution

    @property
    def both(self) -> Tensor:
        return (self.solution.status == int(Status.SOLVED)) & (self.found.status == int(Status.SOLVED))

    @property
    def alike(self) -> Tensor:
        return self.both & self.near

    @property
    def near(self) -> Tensor:
        return (self.after.q - self.expected.q).abs().amax(-1) < 1e-7

    def require_roots(self, tolerance: float = 1e-9) -> None:
        """What the core solves directly are roots by the reference's own error, but for rounding in single precision: what is just
        within the tolerance to one may be just beyond it to the other."""
        objective = self.stepper.objective(self.before, self.control)
        error = objective.error(objective.evaluate(self.after.q), tolerance)
        most = tolerance if error.dtype == torch.float64 else 1.02 * tolerance
        assert bool((error[self.solution.status == int(Status.SOLVED)] <= most).all())

    def require_alike(self, names: Sequence[str], rtol: float = 1e-5, atol: float = 1e-5, where: Tensor | None = None) -> None:
        """Fields of the states that follow, where they end at the same root."""
        where = self.alike if where is None else where
        for name in names:
            ours, theirs = (getattr(x, name)[where].double() for x in (self.after, self.expected))
            assert torch.allclose(ours, theirs, rtol, atol), name

    def require_same(self, share: float = 0.97) -> None:
        """So many that both solve directly, and there are some, end at the same root."""
        assert int(self.alike.sum()) >= share * int(self.both.sum()) > 0


def compared(native: NativeStepper[Any], state: Any, controls: Tensor | None, steps: int, fallbacks: bool = False) -> Compared:
    """Under controls `[steps, worlds, nu]`, or `[1, worlds, nu]` for all of them; the reference with its fallbacks or without."""
    states, solution = native.run(state, controls, steps)
    before = mapped(lambda first, others: torch.cat((first[None], others[:-1])).flatten(0, 1), native.complete(state), states)
    control = None if controls is None else controls.expand(steps, *controls.shape[1:]).flatten(0, 1)
    worlds = len(state.q)
    stepper = native.eager.take(Worlds((worlds,), torch.arange(worlds).repeat(steps)))
    expected, found, _ = (stepper if fallbacks else at_once(stepper)).made(before, control)
    after, solution = (mapped(lambda x: x.flatten(0, 1), x) for x in (states, solution))
    return Compared(stepper, before, control, after, solution, expected, found)


def require_steps(scene: Scene, start: Velocities, control: Tensor | None = None, steps: int = 5) -> None:
    """Steps end where the reference's do, and a world goes alone as in a batch."""
    simulator = Simulator(scene, DT)
    native = NativeStepper(simulator.eager)
    state = simulator.initial_state(start.q, start.v, control)
    worlds = len(start.q)
    pairs = compared(native, state, None if control is None else control[None], steps)
    pairs.require_roots()
    pairs.require_same()
    pairs.require_alike(("v", "push", "steady", "lag", "surplus", "hazards"))
    whole, _, _ = native.made(state, control)
    for index in (torch.tensor([3]), torch.tensor([worlds - 1, 0, 3])):
        held = None if control is None else control[index]
        some = Worlds((worlds,), index)
        part, _, _ = native.take(some).made(state.take(some), held)
        assert torch.equal(part.q, whole.q[index])
        assert torch.equal(part.v, whole.v[index])


SCHEMES: tuple[Integrator[Any], ...] = (EnergyMomentum(), ImplicitEuler())


@dataclass(frozen=True, eq=False)
class Begun:
    """The core's state at t = 0, where its trial step ended `[worlds, nq]` and with which status, and the reference's state that
    follows from the same end."""

    state: Any
    end: Tensor
    status: Tensor
    reference: Any


def begun(native: NativeStepper[Any], q: Tensor, v: Tensor, control: Tensor | None) -> Begun:
    """A start of the core, and what the reference makes of its trial."""
    held = q.new_zeros(1, native.scene.nu) if control is None else control[None]
    journey, end = native._core.start(q, v, spread(held, q.shape[:-1]))
    status = journey.counted["status"]

    def attempt(_: EagerStepper[Any], state: Any, __: Tensor | None) -> tuple[Any, Tensor]:
        return replaced(state, q=end), status <= int(Status.HALVED)

    reference = native.eager.with_attempt(attempt).initial_state(q, v, control)
    return Begun(native.initial_state(q, v, control), end, status, reference)


def require_starts(scene: Scene, q: Tensor, v: Tensor, control: Tensor | None = None) -> None:
    """By both schemes: where trial steps end are roots to the reference, and what is made of them is the reference's but for
    rounding."""
    for scheme in SCHEMES:
        native = NativeStepper(Simulator(scene, DT, scheme).eager)
        start = begun(native, q, v, control)
        objective = trial_of(native.eager, q, v, control)
        error = objective.error(objective.evaluate(start.end), 1e-9)
        assert bool((error[start.status == int(Status.SOLVED)] <= 1e-9).all())
        for name, ours, theirs in fields(start.state, start.reference):
            assert float((ours - theirs).abs().max()) <= 1e-8 * (1.0 + float(theirs.abs().max())), name


def fields(ours: State, theirs: State) -> list[tuple[str, Tensor, Tensor]]:
    """The tensors of two states, side by side."""
    pairs = [(name, x, getattr(theirs, name)) for name, x in vars(ours).items() if isinstance(x, Tensor)]
    assert all(x.dtype == y.dtype and x.shape == y.shape for _, x, y in pairs)
    return pairs


def trial_of(eager: EagerStepper[Any], q: Tensor, v: Tensor, control: Tensor | None) -> Any:
    """The balance of the trial step from q with v."""
    scheme = ImplicitEuler()
    stepper = eager.with_scheme(scheme, eager.solver, eager.halvings, eager.step_size)
    return stepper.objective(scheme.at_rate(eager.articulation, q, v, torch.zeros_like(v), eager.step_size), control)


def apart(eager: EagerStepper[Any], q: Tensor, v: Tensor, control: Tensor | None) -> Tensor:
    """How far the accelerations of two trials may be apart, ‖a − a'‖ by M, `[worlds]`, where both have solved the same root.

    Both have ‖r/s‖ ≤ τ, so J δq = δr with ‖δr/s‖ ≤ 2τ. What their forces differ by is δr less what inertia makes of δq, and where J
    is no less than inertia alone, that is no more than δr again, in the norm of M⁻¹: ‖δa‖ ≤ 2 · 2τ √λ, λ the largest eigenvalue of
    s M⁻¹ s."""
    tolerance, objective = 1e-9, trial_of(eager, q, v, control)
    size = objective.scale + objective.rounding / tolerance
    felt = torch.linalg.inv(mass_matrix(eager.articulation, q, eager.scene.terms)) * size[..., None] * size[..., None, :]
    return 4 * tolerance * torch.linalg.eigvalsh(felt)[..., -1].sqrt()


def largest_gap(eager: EagerStepper[Any], q: Tensor, ours: Any, theirs: Any) -> Tensor:
    """Of two states at t = 0, as an acceleration ‖a − a'‖ by M, `[worlds]`."""
    a, dt = eager.articulation, eager.dt
    inertia = mass_matrix(a, q, eager.scene.terms)
    gaps = []
    if isinstance(ours, Velocities):  # lag: of what two forces differ by
        shares = (("v", 1.5 * dt), ("push", dt), ("steady", dt), ("lag", 2 * dt))
        gaps += [(getattr(ours, name) - getattr(theirs, name)) / share for name, share in shares]
    else:
        gaps += [ours.acceleration - theirs.acceleration]
        gaps += [difference(a, ours.q_previous, theirs.q_previous) / (0.5 * dt * dt)]
    return torch.stack([(x[..., None, :] @ inertia @ x[..., None])[..., 0, 0].sqrt() for x in gaps]).amax(0)


def require_same_steps(native: NativeStepper[Any], state: Any, steps: int, least: int) -> None:
    """At least so many end in the same way as the reference's, 97 % of these in the same state."""
    pairs = compared(native, state, None, steps, fallbacks=True)
    both = (pairs.solution.status == pairs.found.status) & (pairs.found.status <= int(Status.EASED))
    alike = both & pairs.near
    assert torch.equal(pairs.after.time, pairs.expected.time)
    assert torch.equal(pairs.after.hazards[alike], pairs.expected.hazards[alike])
    for name, ours, theirs in fields(pairs.after, pairs.expected):
        if ours.dtype == torch.float64:
            assert torch.allclose(ours[alike], theirs[alike], rtol=1e-5, atol=1e-3, equal_nan=True), name
    assert int(both.sum()) >= least
    assert int(alike.sum()) >= 0.97 * int(both.sum())


def require_single_precision(scene: Callable[[torch.dtype], Scene], start: Callable[[Scene], Velocities]) -> None:
    """Three steps go on in float32 as in float64, where both solve them, in four worlds at least."""
    ends = []
    for dtype in (torch.float64, torch.float32):
        made = scene(dtype)
        state = start(made)
        native = NativeStepper(Simulator(made, DT).eager)
        states, solution = native.run(native.initial_state(state.q, state.v, None), None, 3)
        ends.append((states.q.double(), solution.status))
    solved = (ends[0][1] == 0).all(0) & (ends[1][1] == 0).all(0)
    assert int(solved.sum()) >= 4
    assert float((ends[0][0] - ends[1][0])[:, solved].abs().max()) < 1e-3
