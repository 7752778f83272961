"""Steps of a length of their own for each world by the compiled core: given ones, and those that frames choose for themselves."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from pbfd_torch import Bdf2, EnergyMomentum, ImplicitEuler, RungeKutta, Simulator, Variational
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Native, Torch
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.schedules.adaptive import AdaptiveStepper
from pbfd_torch.simulator import AdaptiveSimulator
from pbfd_torch.tensors.worlds import Worlds

FRAME, ACCURACY = 0.05, 1e-4
INTEGRATORS: tuple[Integrator[Any], ...] = (EnergyMomentum(), ImplicitEuler(), Variational(), Bdf2(), RungeKutta())


@pytest.mark.parametrize(
    ("name", "scheme"),
    [(name, EnergyMomentum()) for name in ("chain-fixed", "chain-slope-drop", "box-slide", "hopper", "stack")]
    + [(name, scheme) for name in ("chain-free", "chain-ground") for scheme in INTEGRATORS[1:]],
)
def test_frames_are_the_references(name: str, scheme: Integrator[Any]) -> None:
    """The same steps in each frame, taken and refused, the same motion and the same contacts at the end of the last of them."""
    setup = SCENES[name](worlds=2)
    controls = setup.controls(4)
    ours, theirs = (
        AdaptiveSimulator(setup.scene, FRAME, ACCURACY, scheme, shortest=FRAME / 64, engine=engine)
        for engine in (Native(), Torch())
    )
    assert isinstance(ours.stepper, NativeStepper)
    assert isinstance(theirs.stepper, AdaptiveStepper)
    state = theirs.initial_state(setup.q, setup.v, controls[0])
    found, expected = ours.rollout(state, controls), theirs.rollout(state, controls)
    assert torch.equal(found.substeps, expected.substeps)
    assert torch.equal(found.status, expected.status)
    assert torch.equal(found.hazards, expected.hazards)
    for what, tolerance in {"q": 1e-8, "v": 1e-6, "contact_depth": 1e-8, "contact_point": 1e-7}.items():
        values, others = getattr(found, what), getattr(expected, what)
        assert float((values - others).abs().amax()) < tolerance if values.numel() else True, what
    size = expected.contact_force.abs().amax() + 1 if expected.contact_force.numel() else 1
    assert float((found.contact_force - expected.contact_force).abs().sum()) < 1e-4 * size


@pytest.mark.parametrize("scheme", [EnergyMomentum(), RungeKutta()], ids=lambda x: type(x).__name__)
def test_frames_on_moving_obstacles(scheme: EnergyMomentum) -> None:
    """Where obstacles are is asked for at the times of each world's own steps, which the core makes one by one; one world falls."""
    setup = SCENES["turntable"](worlds=2)
    q = setup.q.clone()
    q[1, 2::7] += 0.003
    state = Simulator(setup.scene, FRAME, scheme).initial_state(q, setup.v)
    found, expected = (
        AdaptiveSimulator(setup.scene, FRAME, ACCURACY, scheme, engine=engine).rollout(state, steps=2)
        for engine in (Native(), Torch())
    )
    assert torch.equal(found.substeps, expected.substeps)
    assert float((found.q - expected.q).abs().max()) < 1e-9


@pytest.mark.parametrize("scheme", INTEGRATORS, ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("name", ["hopper", "turntable"])
def test_each_world_has_its_own_step(name: str, scheme: Integrator[Any]) -> None:
    """Worlds with steps of different lengths: each goes as among others of its own length, and as the reference goes."""
    setup, controls = SCENES[name](worlds=3), SCENES[name](worlds=3).controls(3)
    sizes = torch.tensor([0.004, 0.01, 0.02], dtype=torch.float64)
    native, eager = (Simulator(setup.scene, 0.01, scheme, engine=engine).sized(sizes) for engine in (Native(), Torch()))
    state = eager.initial_state(setup.q, setup.v, controls[0])
    start = native.initial_state(setup.q, setup.v, controls[0])
    assert float((start.q - state.q).abs().max()) < 1e-12
    stepper = native.stepper
    assert isinstance(stepper, NativeStepper)
    stretch = stepper.stretch(state, controls, 3)
    whole = eager.rollout(state, controls)
    assert float((stretch.end.q - whole.q[-1]).abs().max()) < 1e-8
    for k, dt in enumerate(sizes.tolist()):
        some = Worlds((3,), torch.tensor([k]))
        alike = Simulator(setup.scene, dt, scheme, engine=Native()).stepper.take(some)
        assert isinstance(alike, NativeStepper)
        alone, _ = alike.run(state.take(some), controls[:, k : k + 1], 3)
        assert torch.equal(alone.q[:, 0], stretch.states.q[:, k])
    assert float((native.rollout(state, controls).v - whole.v).abs().max()) < 1e-5


def test_worlds_choose_alone_as_in_a_batch() -> None:
    """Frames of many worlds, which share registers and are refused at different steps: to the bit what each does by itself."""
    setup = SCENES["hopper"](worlds=11)
    q = setup.q.clone()
    q[:, 1] += 0.05 * torch.arange(11, dtype=q.dtype)
    simulator: AdaptiveSimulator[Any] = AdaptiveSimulator(setup.scene, FRAME, 1e-3, engine=Native())
    state = simulator.initial_state(q, setup.v)
    together = simulator.rollout(state, steps=10)
    assert len(together.substeps.sum(0).unique()) > 2
    for k in (0, 7):
        alone = simulator.rollout(state.take(Worlds((11,), torch.tensor([k]))), steps=10)
        assert torch.equal(alone.q[:, 0], together.q[:, k])
        assert torch.equal(alone.contact_force[:, 0], together.contact_force[:, k])
