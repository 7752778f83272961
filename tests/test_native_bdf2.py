"""BDF2 by the compiled core is the reference's: starts, steps, what they remember, refusals, and records."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Simulator
from pbfd_torch.bench.starts import scattered
from pbfd_torch.integrators.bdf2 import Bdf2
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Torch
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.solvers.objective import FALLBACKS, Status
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.tensors.worlds import Worlds
from tests.native_parity import compared

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

COVERED = ("box-slide", "chain-fixed", "chain-ground", "dzhanibekov", "hopper", "walker")
WORLDS = 11


@functools.cache
def begun(name: str, dt: float, dtype: torch.dtype = torch.float64) -> tuple[Simulator[Any], NativeStepper[Any], Any, Tensor]:
    """Scattered worlds, and random controls of 20 steps."""
    setup = SCENES[name](worlds=WORLDS, dtype=dtype)
    simulator = Simulator(setup.scene, dt, Bdf2())
    native = simulator.stepper
    assert isinstance(native, NativeStepper)
    random = torch.Generator().manual_seed(1)
    controls = 2 * torch.rand(20, WORLDS, setup.scene.nu, dtype=torch.float64, generator=random) - 1
    return simulator, native, simulator.initial_state(*scattered(setup, 0, 0.3, 1.0)), controls.to(dtype)


def gap(one: Any, other: Any, of: Tensor) -> float:
    """How far two states are apart in some worlds: the poses, moves and pushes that they remember."""
    pairs = [*zip(one.history, other.history, strict=True), *zip(one.moves, other.moves, strict=True)]
    differences = [(a - b)[of].abs() for a, b in pairs]
    return max(float(x.max()) if x.numel() else 0.0 for x in differences)


@pytest.mark.parametrize("name", COVERED)
def test_starts(name: str) -> None:
    """A past of constant acceleration; two trial steps are solved to the tolerance."""
    simulator, _, state, _ = begun(name, 0.01)
    velocity = simulator.integrator.velocity(simulator.articulation, state, simulator.step_size)
    expected = simulator.eager.initial_state(state.q, scattered(SCENES[name](worlds=WORLDS), 0, 0.3, 1.0)[1], None)
    assert torch.equal(state.q, expected.q)
    assert gap(state, expected, torch.ones(WORLDS, dtype=torch.bool)) < 1e-7
    assert torch.allclose(velocity, simulator.integrator.velocity(simulator.articulation, expected, simulator.step_size), atol=1e-6)
    assert bool(state.push.isnan().all())


@pytest.mark.parametrize("dt", [0.005, 0.02])
@pytest.mark.parametrize("name", COVERED)
def test_steps(name: str, dt: float) -> None:
    """The same root from the same state, refused alike where a contact force jumps, and what is remembered is the same."""
    _, native, state, controls = begun(name, dt)
    pairs = compared(native, state, controls[:10], 10, fallbacks=True)
    kinds = [int(Status.SOLVED), int(Status.EASED)]
    both = (pairs.solution.status == pairs.found.status) & torch.isin(pairs.solution.status, torch.tensor(kinds, dtype=torch.int32))
    alike = both & pairs.near
    assert gap(pairs.after, pairs.expected, alike) < 1e-6
    pairs.require_alike(["push"], 1e-4, 1e-6, alike)
    assert int(alike.sum()) >= 0.97 * int(both.sum()) > 0


def test_jumps_of_a_contact_force_are_refused() -> None:
    """These steps are of implicit Euler, which leaves a past of constant velocity; others are not."""
    _, native, state, controls = begun("hopper", 0.008)
    states, solution = native.run(state, controls, 20)
    eased = solution.status == int(Status.EASED)
    assert 10 <= int(eased.sum()) < 0.5 * eased.numel()
    assert torch.equal(eased, solution.fallbacks[..., FALLBACKS.index("easier step")] > 0)
    last, middle, oldest = (x[eased] for x in states.moves)
    assert torch.equal(last, middle)
    assert torch.equal(last, oldest)
    plain = solution.status == int(Status.SOLVED)
    assert bool((states.moves[0] != states.moves[1])[plain].any(-1).all())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_no_lane_knows_another(dtype: torch.dtype) -> None:
    """To the bit: in a batch, in another place of it, by itself, beside a world that is not finite."""
    _, native, state, controls = begun("walker", 0.02, dtype)
    states, solution = native.run(state, controls, 20)
    assert int((solution.fallbacks.sum(-1) > 0).sum()) > 5
    sick = dataclasses.replace(state, q=state.q.clone())
    sick.q[4] = torch.nan
    beside, _ = native.run(sick, controls, 20)
    others = torch.tensor([i for i in range(WORLDS) if i != 4])
    require_equal(mapped(lambda x: x[:, others], beside), states, others)
    for index in (torch.randperm(WORLDS, generator=torch.Generator().manual_seed(3)), torch.tensor([7])):
        some, _ = native.run(state.take(Worlds((WORLDS,), index)), controls[:, index], 20)
        require_equal(some, states, index)


def require_equal(some: Any, whole: Any, index: Tensor) -> None:
    """The same states, of some worlds."""
    for one, other in zip((some.q, *some.history, *some.moves), (whole.q, *whole.history, *whole.moves), strict=True):
        assert torch.equal(one, other[:, index])


def test_records() -> None:
    """As PyTorch's of the same motion."""
    simulator, _, state, controls = begun("chain-ground", 0.01)
    ours = simulator.rollout(state, controls)
    theirs = Simulator(simulator.scene, 0.01, Bdf2(), engine=Torch()).rollout(state, controls)
    assert torch.equal(ours.status, theirs.status)
    for name in ("q", "v", "link_poses", "kinetic_energy", "potential_energy", "linear_momentum", "contact_depth", "contact_force"):
        a, b = getattr(ours, name), getattr(theirs, name)
        assert torch.allclose(a, b, rtol=1e-6, atol=1e-6 * max(1.0, float(b.abs().max()))), name
