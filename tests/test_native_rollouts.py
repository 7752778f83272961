"""Many compiled steps in one call, on any number of threads, are the steps one by one; and which engine makes them is a choice."""

from __future__ import annotations

import pickle

import pytest
import torch
from torch import Tensor

from pbfd_torch import InputError, Simulator
from pbfd_torch.bench.starts import scattered
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Native, Torch
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import NativeStepper
from tests.native_parity import OwnScheme

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

FIELDS = ("q", "v", "push", "steady", "lag", "average", "gained", "surplus", "peak", "time", "hazards")


def started(
    name: str, dt: float, worlds: int, steps: int, native: Native | None = None
) -> tuple[NativeStepper, Velocities, Tensor]:
    setup = SCENES[name](worlds=worlds)
    simulator = Simulator(setup.scene, dt, engine=native or Native())
    q, v = scattered(setup, 0, 0.3, 1.0)
    random = torch.Generator().manual_seed(1)
    controls = 2 * torch.rand(steps, worlds, setup.scene.nu, dtype=torch.float64, generator=random) - 1
    stepper = simulator.stepper
    assert isinstance(stepper, NativeStepper)
    return stepper, simulator.initial_state(q, v), controls


def test_many_steps_are_the_steps_one_by_one() -> None:
    """To the bit, also where steps are made easier or halved on the way, and where one stands still."""
    stepper, state, controls = started("walker", 0.02, 9, 12)
    controls[:, 4] = torch.nan
    states, solution = stepper.run(state, controls, 12)
    for k, control in enumerate(controls):
        state, one, _ = stepper.made(state, control)
        for field in FIELDS:
            assert torch.allclose(getattr(states, field)[k].double(), getattr(state, field).double(), 1e-6, 1e-8), (k, field)
        for field in ("status", "fallbacks"):
            assert torch.equal(getattr(solution, field)[k], getattr(one, field)), (k, field)
    assert bool((solution.status[:, 4] == 7).all())
    assert bool((solution.fallbacks.sum(-1) > 0).any())


def test_threads_change_nothing() -> None:
    """Not a bit of it."""
    one, state, controls = started("hopper", 0.008, 70, 30, Native(threads=1))
    three = NativeStepper(one.eager, threads=3)
    expected, solution = one.run(state, controls, 30)
    found, other = three.run(state, controls, 30)
    for field in FIELDS:
        assert torch.equal(getattr(found, field), getattr(expected, field)), field
    assert torch.equal(other.evaluations, solution.evaluations)


def test_rollouts_record_what_the_engine_in_pytorch_records() -> None:
    """Every array, to what the solvers' tolerance leaves open; in one piece, in several, and with one world."""
    setup = SCENES["hopper"](worlds=2)
    q, v = scattered(setup, 0, 0.1, 0.5)
    random = torch.Generator().manual_seed(1)
    controls = 2 * torch.rand(40, 2, setup.scene.nu, dtype=torch.float64, generator=random) - 1
    compiled, defined = (Simulator(setup.scene, 0.008, engine=engine) for engine in (Native(), Torch()))
    told: list[int] = []
    record = compiled.rollout(compiled.initial_state(q, v), controls, progress=told.append)
    expected = defined.rollout(defined.initial_state(q, v), controls)
    assert told == list(range(1, 41))
    for name, values in vars(expected).items():
        if isinstance(values, Tensor) and name not in ("iterations", "evaluations", "residual_norm", "lanes"):
            found = getattr(record, name)
            assert found.dtype == values.dtype, name
            assert torch.allclose(found.double(), values.double(), rtol=1e-4, atol=1e-3), name
    alone = compiled.rollout(compiled.initial_state(q[1], v[1]), controls[:, 1])
    assert torch.equal(alone.q, record.q[:, 1])


def test_an_interrupted_rollout_keeps_what_was_computed() -> None:
    """At least the steps that were told of."""
    setup = SCENES["hopper"](worlds=2)
    simulator = Simulator(setup.scene, 0.008, engine=Native())

    def interrupted(done: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    record = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=20, progress=interrupted)
    assert len(record.status) >= 5
    assert bool(torch.isfinite(record.q).all())


def test_the_engine_is_a_choice_that_can_be_read() -> None:
    """Compiled where the core covers the steps; else in PyTorch, and why."""
    scene = SCENES["hopper"]().scene
    compiled, uncovered = Simulator(scene, 0.008), Simulator(scene, 0.008, OwnScheme())
    assert (compiled.engine, compiled.engine_reason) == ("native", "")
    assert uncovered.engine == "torch"
    assert "integrator OwnScheme" in uncovered.engine_reason
    asked = Simulator(scene, 0.008, engine=Torch())
    assert (asked.engine, asked.engine_reason, asked.stepper) == ("torch", "", asked.eager)
    with pytest.raises(InputError, match="OwnScheme"):
        Simulator(scene, 0.008, OwnScheme(), engine=Native())
    with pytest.raises(InputError, match="threads is 0: must be ≥ 1"):
        Native(threads=0)
    assert compiled.sized(torch.tensor(0.004, dtype=torch.float64)).engine == "native"


def test_a_stepper_goes_to_another_process() -> None:
    """Which loads the core itself."""
    stepper, state, controls = started("hopper", 0.008, 3, 1)
    copy = pickle.loads(pickle.dumps(stepper))
    expected, _, _ = stepper.made(state, controls[0])
    found, _, _ = copy.made(state, controls[0])
    assert torch.equal(found.q, expected.q)
