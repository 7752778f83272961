"""Derivatives of the compiled core's steps by the core itself, against those that PyTorch retraces along the same steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from pbfd_torch import EventSimulator, Gradients, RungeKutta, Simulator, parameters, with_parameters
from pbfd_torch.gradients.implicit import Blur
from pbfd_torch.gradients.linked import Linked
from pbfd_torch.gradients.trajectory import Trajectory
from pbfd_torch.gradients.walks import Walk, Walker
from pbfd_torch.integrators.bdf2 import Bdf2
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.integrators.variational import Variational
from pbfd_torch.models import SCENES
from pbfd_torch.native import stepper as native_stepper
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.objective import Status
from pbfd_torch.tensors.structures import mapped_tensors, tensors_of
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.tree.kinematics import retract
from tests.random_trees import generator

WORLDS = 9  # more than one register, not full ones
SCHEMES = [EnergyMomentum(), ImplicitEuler(), Variational(), Bdf2()]
NAMES = ("box-slide", "chain-free", "chain-ground", "chain-slope", "dzhanibekov", "hopper", "walker", "quadruped")
each_scheme = pytest.mark.parametrize("scheme", SCHEMES, ids=lambda x: type(x).__name__)


def under_way(
    name: str, scheme: Integrator[Any] | None = None, dt: float = 0.01, steps: int = 12
) -> tuple[Simulator[Any], Any, Tensor]:
    """Worlds of a scene pushed and driven at random, some steps after their starts, and their next control."""
    setup = SCENES[name](worlds=WORLDS)
    simulator = Simulator(setup.scene, dt, scheme, Fallbacks.within(1e-12))
    random, nv, nu = generator(3), simulator.articulation.nv, setup.scene.nu
    v = setup.v.expand(WORLDS, -1) + 0.5 * torch.randn(WORLDS, nv, dtype=setup.v.dtype, generator=random)
    controls = torch.randn(steps + 1, WORLDS, nu, dtype=v.dtype, generator=random)
    state = simulator.initial_state(setup.q.expand(WORLDS, -1), v)
    for k in range(steps):
        state, _ = simulator.step(state, controls[k])
    return simulator, state, controls[-1]


def tilted(structure: Any, seed: int) -> Tensor:
    """A random linear function of all numbers of a state but its bookkeeping."""
    random = generator(seed)
    x = replaced(structure, time=structure.time.detach())
    kept = [y for y in tensors_of(x) if y.is_floating_point() and y.requires_grad]
    return torch.stack([(y * torch.randn(y.shape, dtype=y.dtype, generator=random)).sum() for y in kept]).sum()


def charted(simulator: Simulator[Any], state: Any) -> tuple[Any, list[Tensor]]:
    """A state as a function of tangents of its configurations and of its other numbers, and these."""
    moves: list[Tensor] = []

    def moved(x: Tensor) -> Tensor:
        if not x.is_floating_point() or not x.numel() or x is state.time:
            return x
        quaternions = x.shape[-1] == simulator.articulation.nq and x.ndim == 2
        shape = (*x.shape[:-1], simulator.articulation.nv) if quaternions else x.shape
        moves.append(torch.zeros(shape, dtype=x.dtype, requires_grad=True))
        return retract(simulator.articulation, x, moves[-1]) if quaternions else x + moves[-1]

    return mapped_tensors(state, moved), moves


def off(found: Sequence[Tensor | None], right: Sequence[Tensor | None]) -> float:
    """The largest difference, relative to the largest number of each."""
    worst = 0.0
    for x, y in zip(found, right, strict=True):
        if x is None or y is None:
            assert x is None or not bool(x.any())
            assert y is None or not bool(y.any())
            continue
        if x.shape[-2:] == (4, 4):  # the last row of a pose says nothing
            x, y = x[..., :3, :], y[..., :3, :]
        worst = max(worst, float((x - y).abs().max()) / max(float(y.abs().max()), 1e-6))
    return worst


# Single steps -----------------------------------------------------------------------------------------------------------------


@each_scheme
@pytest.mark.parametrize("name", NAMES)
def test_a_step_by_its_state_and_control(name: str, scheme: Integrator[Any]) -> None:
    """By the whole state and the control: as PyTorch along the same step, to 1e-10, and the values to the bit. J of ten balls on
    stiff ground is known to 3e-11."""
    simulator, state, control = under_way(name, scheme)
    found, ends = [], []
    for by_core in (True, False):
        start, moves = charted(simulator, state)
        held = control.clone().requires_grad_()
        linked = Linked(simulator.eager, simulator.gradients, simulator._maker)
        if by_core:
            walker = Walker.of(linked, start, held[None])
            assert walker is not None
            states, _ = walker.walk(start, held[None], 1)
            end = mapped_tensors(states, lambda x: x[0])
        else:
            end, _ = linked.step(start, held)
        ends.append(end)
        found.append(list(torch.autograd.grad(tilted(end, 1), [*moves, held], allow_unused=True)))
    assert all(torch.equal(x, y) for x, y in zip(*map(tensors_of, ends), strict=True))
    assert off(*found) <= (1e-9 if name == "chain-ground" else 1e-10)


@pytest.mark.parametrize("name", ["hopper", "walker"])
def test_detours(name: str) -> None:
    """Steps that were eased or halved are followed back as they were made."""
    simulator, state, control = under_way(name, dt=0.03)
    seen = set[int]()
    for seed in range(4):
        start, moves = charted(simulator, state)
        held = (control + torch.randn(control.shape, dtype=control.dtype, generator=generator(seed))).requires_grad_()
        linked = Linked(simulator.eager, simulator.gradients, simulator._maker)
        walker = Walker.of(linked, start, held[None])
        assert walker is not None
        states, walk = walker.walk(start, held[None], 1)
        by = [*moves, held]
        found = torch.autograd.grad(tilted(mapped_tensors(states, lambda x: x[0]), seed), by, retain_graph=True, allow_unused=True)
        end, _ = linked.step(start, held)
        assert off(list(found), list(torch.autograd.grad(tilted(end, seed), by, allow_unused=True))) <= 1e-10
        seen |= set(walk.solution.status.reshape(-1).tolist())
        state = mapped_tensors(end, torch.detach)
    assert {int(Status.EASED), int(Status.HALVED)} & seen


# Trajectories -----------------------------------------------------------------------------------------------------------------


def gradients(simulator: Simulator[Any], state: Any, controls: Tensor, checkpoint: int = 1) -> tuple[Any, list[Tensor]]:
    """Of a random function of a motion by its start's velocity and its controls."""
    random = generator(7)
    v, held = state.v.clone().requires_grad_(), controls.clone().requires_grad_()
    path = simulator.trajectory(replaced(state, v=v), held, checkpoint=checkpoint)
    tilt = [torch.randn(x.shape, dtype=x.dtype, generator=random) for x in (path.q, path.v)]
    (path.q * tilt[0] + 0).sum().add((path.v * tilt[1]).sum()).backward()
    assert v.grad is not None
    assert held.grad is not None
    return path, [v.grad, held.grad]


def test_a_motion_in_one_call() -> None:
    """As step by step: the same values, and the same derivatives but for rounding; so with checkpoints, to the bit."""
    simulator, state, control = under_way("hopper")
    controls = control + torch.randn(24, *control.shape, dtype=control.dtype, generator=generator(5))
    path, found = gradients(simulator, state, controls)
    assert all(isinstance(x, Walk) for x in path._made)
    for checkpoint in (5, 24):
        other, same = gradients(simulator, state, controls, checkpoint)
        assert torch.equal(other.q, path.q)
        assert torch.equal(other.v, path.v)
        assert off(same, found) <= 1e-12
    plain = simulator.trajectory(state, controls)
    assert torch.equal(plain.q, path.q)
    v, held = state.v.clone().requires_grad_(), controls.clone().requires_grad_()
    now = replaced(state, v=v)
    q, speed = [now.q], [simulator.integrator.velocity(simulator.articulation, now, simulator.step_size)]
    for k in range(len(controls)):
        now, _ = Linked(simulator.eager, simulator.gradients, simulator._maker).step(now, held[k])
        q.append(now.q)
        speed.append(simulator.integrator.velocity(simulator.articulation, now, simulator.step_size))
    random = generator(7)
    tilt = [torch.randn(path.q.shape, dtype=v.dtype, generator=random) for _ in range(2)]
    ((torch.stack(q) * tilt[0]).sum() + (torch.stack(speed) * tilt[1]).sum()).backward()
    assert off([v.grad, held.grad], list(found)) <= 1e-8  # what 24 steps through contact make of rounding


def test_a_long_motion_without_controls(monkeypatch: pytest.MonkeyPatch) -> None:
    """Made in several calls of the core and followed back in one: as under controls of zero, to the bit."""
    monkeypatch.setattr(native_stepper, "KEPT_AT_ONCE", 3 * WORLDS)
    simulator, state, control = under_way("hopper")
    found = []
    for controls in (None, torch.zeros(8, *control.shape, dtype=control.dtype)):
        v = state.v.clone().requires_grad_()
        path = simulator.trajectory(replaced(state, v=v), controls, None if controls is not None else 8)
        path.q.sum().backward()
        found.append(v.grad)
    assert found[0] is not None
    assert found[1] is not None
    assert torch.equal(found[0], found[1])


@pytest.mark.parametrize("own", [False, True])
def test_forward_derivatives(own: bool) -> None:
    """By the start, the controls and masses, along a random direction: as backward ones say, in one call for all steps."""
    simulator, state, control = under_way("hopper")
    controls = control + torch.randn(12, *control.shape, dtype=control.dtype, generator=generator(5))
    name, random = "articulation.pseudo_inertia", generator(6)
    inertia = parameters(simulator.scene)[name]
    inertia = inertia.expand(WORLDS, *inertia.shape).clone() if own else inertia
    values = [state.v, controls, inertia]
    along = [torch.randn(x.shape, dtype=x.dtype, generator=random) * x.abs().clamp_min(1e-3) for x in values]
    along[2] = along[2] + along[2].mT

    def motion(v: Tensor, held: Tensor, masses: Tensor) -> Trajectory[Any]:
        made = simulator.with_scene(with_parameters(simulator.scene, {name: masses}))
        return made.trajectory(replaced(state, v=v), held)

    back = [x.clone().requires_grad_() for x in values]
    path = motion(*back)
    tilt = torch.randn(path.q.shape, dtype=path.q.dtype, generator=random)
    (path.q * tilt).sum().backward()
    right = sum(float((x.grad * y).sum()) for x, y in zip(back, along, strict=True) if x.grad is not None)
    with forward_ad.dual_level():
        path = motion(*(forward_ad.make_dual(x, y) for x, y in zip(values, along, strict=True)))
        assert all(isinstance(x, Walk) for x in path._made)
        found = forward_ad.unpack_dual(path.q).tangent
    assert found is not None
    assert float((found * tilt).sum()) == pytest.approx(right, rel=1e-9)


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_any_batch(batch: tuple[int, ...]) -> None:
    """A single world, and batches of more dimensions, as each world alone; one control for all worlds gets the sum."""
    setup = SCENES["hopper"](worlds=1)
    simulator = Simulator(setup.scene, 0.01)
    count = max(1, torch.Size(batch).numel())
    v = 0.3 * torch.randn(count, simulator.articulation.nv, dtype=setup.v.dtype, generator=generator(2))
    controls = torch.randn(3, setup.scene.nu, dtype=v.dtype, generator=generator(4))

    def by(rows: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        held = controls.clone().requires_grad_()
        state = simulator.initial_state(setup.q[0].expand(*shape, -1), rows.reshape(*shape, -1))
        speed = state.v.clone().requires_grad_()
        each = held if not shape else held[:, *(None,) * len(shape), :].expand(-1, *shape, -1)
        path = simulator.trajectory(replaced(state, v=speed), each)
        path.q[-1].sum().backward()
        assert speed.grad is not None
        assert held.grad is not None
        return speed.grad, held.grad

    speed, held = by(v, batch)
    alone = [by(x[None], (1,)) for x in v]
    assert torch.equal(speed.reshape(count, -1), torch.cat([x for x, _ in alone]))
    torch.testing.assert_close(held, sum(x for _, x in alone), rtol=1e-12, atol=1e-12)


def test_single_precision() -> None:
    """Taken in double precision at the roots that one of Newton's steps makes of those found: as PyTorch does."""
    setup = SCENES["hopper"](worlds=WORLDS, dtype=torch.float32)
    simulator = Simulator(setup.scene, 0.01)
    state = simulator.initial_state(setup.q, setup.v)
    for _ in range(25):
        state, _ = simulator.step(state)
    control = torch.zeros(WORLDS, setup.scene.nu)
    found = []
    for by_core in (True, False):
        start, moves = charted(simulator, state)
        held = control.clone().requires_grad_()
        linked = Linked(simulator.eager, simulator.gradients, simulator._maker)
        walker = Walker.of(linked, start, held[None])
        assert walker is not None
        end = mapped_tensors(walker.walk(start, held[None], 1)[0], lambda x: x[0]) if by_core else linked.step(start, held)[0]
        found.append(list(torch.autograd.grad(tilted(end, 1), [*moves, held], allow_unused=True)))
    assert off(*found) <= 1e-5


# Numbers ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("own", [False, True])
def test_by_the_scenes_numbers(own: bool) -> None:
    """Masses, μ, C⊥, gains, damping, gravity and Δt, of all worlds or of each: as PyTorch along the same steps."""
    setup = SCENES["hopper"](worlds=WORLDS)
    names = (
        "articulation.pseudo_inertia",
        "terms.2.damping",
        "terms.4.gear",
        "terms.5.normal_force.stiffness",
        "terms.5.friction.mu",
        "gravity",
    )
    known = parameters(setup.scene)
    controls = torch.randn(6, WORLDS, setup.scene.nu, dtype=setup.q.dtype, generator=generator(1))
    found = []
    for by_core in (True, False):
        values = {
            name: (known[name].expand(WORLDS, *(known[name].shape or (1,))) if own else known[name]).clone().requires_grad_()
            for name in names
        }
        dt = torch.tensor(0.01, dtype=setup.q.dtype, requires_grad=True)
        simulator = Simulator(with_parameters(setup.scene, values), dt, gradients=None if by_core else Gradients(blur=Blur()))
        with torch.no_grad():
            state = simulator.initial_state(setup.q, setup.v)
            for _ in range(30):
                state, _ = simulator.step(state)
        path = simulator.trajectory(state, controls)
        assert isinstance(path._made[0], Walk) == by_core
        (path.q * torch.randn(path.q.shape, dtype=dt.dtype, generator=generator(2))).sum().backward()
        inertia = values.pop(names[0]).grad
        assert inertia is not None
        found.append([inertia + inertia.mT, *(x.grad for x in values.values()), dt.grad])
    assert off(*found) <= 1e-8


def test_what_the_core_does_not_follow_back() -> None:
    """Bodies that touch each other, explicit steps, blurred contact, cut steps: PyTorch retraces them."""
    for name, scheme in (("stack", None), ("hopper", RungeKutta())):
        simulator, state, control = under_way(name, scheme, steps=1)
        assert isinstance(simulator.stepper, NativeStepper)
        assert not simulator.stepper.descends
        path = simulator.trajectory(replaced(state, v=state.v.clone().requires_grad_()), control[None])
        assert not any(isinstance(x, Walk) for x in path._made)
        assert path.q.requires_grad
    blurred = Simulator(SCENES["hopper"](worlds=1).scene, 0.01, gradients=Gradients(blur=Blur(2.0)))
    start = blurred.initial_state()
    path = blurred.trajectory(replaced(start, v=start.v.clone().requires_grad_()), steps=2)
    assert not any(isinstance(x, Walk) for x in path._made)
    assert issubclass(EventSimulator, Simulator)
