"""Explicit steps by the compiled core are the reference's, in a plane and in space, whoever is beside a world."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import RungeKutta, Scene, Simulator, Status, with_parameters
from pbfd_torch.cli.options import Friction, with_friction
from pbfd_torch.gradients.parameters import parameters
from pbfd_torch.models import SCENES
from pbfd_torch.models.setup import Setup
from pbfd_torch.native.engine import Native, Torch
from pbfd_torch.native.library import library
from pbfd_torch.native.plan import planned
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.tree.kinematics import retract
from tests.native_parity import compared
from tests.random_trees import generator

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")
EXPLICIT = int(Status.EXPLICIT)


def thrown(setup: Setup, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Worlds above where they start, some of them higher, on their way, joints within their limits; and controls."""
    random = generator(seed)
    v = 0.5 * torch.randn(setup.v.shape, dtype=torch.float64, generator=random)
    q = retract(setup.scene.articulation, setup.q, 0.2 * v)
    t = setup.scene.articulation.topology
    rise = t.free_q.flatten()[2::3] if len(t.free_q) else torch.tensor([1])
    low, high = (x[t.scalar_v] for x in (setup.scene.articulation.lower, setup.scene.articulation.upper))
    q[:, t.scalar_q] = q[:, t.scalar_q].clamp(low + 0.3, high - 0.3)
    q[:, rise] += torch.linspace(0.0, 0.4, len(q), dtype=torch.float64)[:, None]
    return q, v, 0.3 * torch.randn(len(q), setup.scene.nu, dtype=torch.float64, generator=random)


def simulators(scene: Scene, dt: float = 0.01) -> tuple[Simulator[Any], Simulator[Any]]:
    ours, theirs = (Simulator(scene, dt, RungeKutta(), engine=engine) for engine in (Native(), Torch()))
    return ours, theirs


def differing(scene: Scene, worlds: int) -> Scene:
    """The scene with other masses and inertias in each world."""
    name = "articulation.pseudo_inertia"
    share = torch.linspace(0.8, 1.2, worlds, dtype=torch.float64)[:, None, None, None]
    return with_parameters(scene, {name: share * parameters(scene)[name]})


@pytest.mark.parametrize("name", ["hopper", "walker", "chain-free", "chain-fixed", "box-slide", "stack", "dzhanibekov"])
def test_steps_are_the_references(name: str) -> None:
    """Each from where the core has led: the same worlds leap, to the same state and estimate; the others make the same steps."""
    setup = SCENES[name](worlds=6)
    ours, theirs = simulators(setup.scene)
    q, v, control = thrown(setup)
    pairs = compared(NativeStepper(ours.eager), theirs.initial_state(q, v, control), control[None], 8, fallbacks=True)
    leapt = pairs.solution.status == EXPLICIT
    assert torch.equal(leapt, pairs.found.status == EXPLICIT)
    assert int(leapt.sum()) > 0
    pairs.require_alike(("q", "v", "push", "steady", "lag", "average", "gained", "surplus", "peak"), 1e-9, 1e-11, leapt)
    for name, rtol, atol in (("estimate", 1e-3, 1e-15), ("strike", 0, 1e-6)):
        one, two = (getattr(x, name) for x in (pairs.solution, pairs.found))
        torch.testing.assert_close(one, two, rtol=rtol, atol=atol)


def test_a_plane_and_space() -> None:
    """Worlds that differ are seen in space, and alike ones in their plane."""
    setup = SCENES["hopper"](worlds=4)
    for scene, dimension in ((setup.scene, 2), (differing(setup.scene, 4), 3)):
        ours, theirs = simulators(scene)
        assert planned(ours.eager).dimension == dimension
        q, v, control = thrown(setup)
        state = theirs.initial_state(q, v, control)
        found, expected = ours.step(state, control), theirs.step(state, control)
        leapt = found[1].status == EXPLICIT
        assert int(leapt.sum()) >= 2
        assert torch.equal(leapt, expected[1].status == EXPLICIT)
        torch.testing.assert_close(found[0].q[leapt], expected[0].q[leapt], rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["chain-ground", "box-slide", "hopper"])
def test_a_world_gets_the_same_bits_by_itself(name: str) -> None:
    setup = SCENES[name](worlds=11)
    simulator = Simulator(setup.scene, 0.01, RungeKutta(), engine=Native())
    q, v, control = thrown(setup)
    start = simulator.initial_state(q, v, control)
    stepper = simulator.stepper
    together = stepper.made(start, control)[0]
    for k in (0, 7, 10):
        some = Worlds((11,), torch.tensor([k]))
        alone = stepper.take(some).made(start.take(some), control[k : k + 1])[0]
        for field in ("q", "v", "lag", "average"):
            assert torch.equal(getattr(alone, field)[0], getattr(together, field)[k]), field


def test_single_precision() -> None:
    setup = SCENES["chain-free"](worlds=5, dtype=torch.float32)
    simulator = Simulator(setup.scene, 0.01, RungeKutta(), engine=Native())
    double = SCENES["chain-free"](worlds=5)
    exact = Simulator(double.scene, 0.01, RungeKutta(), engine=Native())
    q, v, _ = thrown(double)
    ours = simulator.rollout(simulator.initial_state(q.float(), v.float()), steps=20)
    theirs = exact.rollout(exact.initial_state(q, v), steps=20)
    assert set(ours.status.unique().tolist()) == {EXPLICIT}
    assert float((ours.q - theirs.q).abs().max()) < 1e-4


def test_what_anchors_remember_is_gone_where_nothing_touches() -> None:
    setup = with_friction(SCENES["box-slide"](worlds=2), Friction.ANCHORED, 0.01)
    ours, theirs = simulators(setup.scene)
    state, _ = theirs.step(theirs.initial_state(setup.q, setup.v))
    assert bool(torch.isfinite(state.memory[0]).any())
    q = state.q.clone()
    q[1, 2] += 0.5
    found, expected = (simulator.step(type(state)(**vars(state) | {"q": q}))[0] for simulator in (ours, theirs))
    assert torch.equal(torch.isnan(found.memory[0]), torch.isnan(expected.memory[0]))
    torch.testing.assert_close(found.memory[0].nan_to_num(), expected.memory[0].nan_to_num(), rtol=0, atol=1e-12)


def test_derivatives_follow_what_the_core_has_made() -> None:
    """Of worlds some of which leap and some of which do not: the values to the bit, and the reference's derivatives."""
    setup = SCENES["box-slide"](worlds=4)
    q, v, _ = thrown(setup)
    found = []
    for simulator in simulators(setup.scene):
        speed = v.clone().requires_grad_()
        path = simulator.trajectory(simulator.initial_state(q, speed), steps=12)
        assert bool((path.status == EXPLICIT).any())
        assert bool((path.status != EXPLICIT).any())
        plain = simulator.rollout(simulator.initial_state(q, v), steps=12)
        assert torch.equal(plain.q[-1], path.q[-1].detach())
        (slope,) = torch.autograd.grad((path.q[-1] ** 2).sum(), speed)
        found.append(slope)
    torch.testing.assert_close(*found, rtol=1e-6, atol=1e-8)
