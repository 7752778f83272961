"""Worlds that differ in their parameters: each gets the same bits whoever is beside it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Scene, Simulator
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import State
from pbfd_torch.models import SCENES
from pbfd_torch.native.library import library
from pbfd_torch.native.plan import planned, planned_in_space
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.tensors.worlds import Worlds
from tests.native_parity import DT
from tests.test_native_worlds import (
    AXES,
    DIFFERENCES,
    SICK,
    WORLDS,
    Difference,
    control,
    differing,
    drawn,
    heavier,
    robot,
    state_of,
)

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")


def require_same(one: State, other: State) -> None:
    """Two states, to the bit."""
    for field in dataclasses.fields(one):
        ours, theirs = getattr(one, field.name), getattr(other, field.name)
        assert not isinstance(ours, Tensor) or torch.equal(ours, theirs), field.name


def scenes(dtype: torch.dtype) -> dict[str, Scene]:
    """In space and in a plane."""
    return {"robot": robot(dtype), "hopper": SCENES["hopper"](worlds=1, dtype=dtype).scene}


ALIKE = ("articulation.", "gravity", "friction.mu", "gear", "gain", "stiffness", "damping")


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", ["robot", "hopper"])
@pytest.mark.parametrize("scheme", [EnergyMomentum, ImplicitEuler])
def test_worlds_that_do_not_differ(scheme: Any, name: str, dtype: torch.dtype) -> None:
    """What all worlds have, given for each: the same bits, in space."""
    scene = scenes(dtype)[name]
    each = {
        key: (value if value.ndim else value[None]).expand(WORLDS, *(value.shape or (1,))).clone()
        for key, value in parameters(scene).items()
        if any(part in key for part in ALIKE) and key != "articulation.rest"
    }
    shared = Simulator(scene, DT, scheme())
    own = Simulator(with_parameters(scene, each), DT, scheme())
    assert len(planned(own.eager).which) > 50
    state, held = state_of(shared), control(scene)
    for _ in range(4):
        after, _, _ = NativeStepper(shared.eager, plan=planned_in_space(shared.eager)).made(state, held)
        other, _, _ = NativeStepper(own.eager).made(state, held)
        require_same(other, after)
        state = after


def differences_of(name: str) -> Mapping[str, Difference]:
    heavy: dict[str, Difference] = {
        "articulation.pseudo_inertia": heavier,
        "gravity": lambda value, random: value * (1 + 0.1 * drawn((1,), value, random)),
    }
    return DIFFERENCES if name == "robot" else heavy


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", ["robot", "hopper"])
def test_no_lane_knows_another(name: str, dtype: torch.dtype) -> None:
    """A world in any place of any batch, on several threads, and by itself."""
    scene = differing(scenes(dtype)[name], differences_of(name))
    simulator = Simulator(scene, DT, ImplicitEuler())
    native, held = NativeStepper(simulator.eager, 2), control(scene)
    assert held is not None
    state = state_of(simulator)
    for _ in range(3):
        state, _, _ = native.made(state, held)
    whole, _ = native.run(state, held[None], 4)
    order = torch.randperm(WORLDS, generator=torch.Generator().manual_seed(3))
    for index in (order, order[:5], order[7:8], order.repeat(40)):
        some = Worlds((WORLDS,), index)
        after, _ = native.take(some).run(state.take(some), held[None, index], 4)
        for field in ("q", "hazards"):
            assert torch.equal(getattr(after, field), getattr(whole, field)[:, index]), field


POISONED = {name: x for name, x in DIFFERENCES.items() if name not in AXES}  # a free joint's frame is looked at


@pytest.mark.parametrize("name", [*POISONED, "hopper"])
def test_no_world_is_poisoned_by_another(name: str) -> None:
    """NaN among the parameters of one: it stands still, and the others are as without it."""
    differences = differences_of("hopper") if name == "hopper" else {name: POISONED[name]}
    scene = differing(scenes(torch.float64)["hopper" if name == "hopper" else "robot"], differences)
    simulator = Simulator(scene, DT, ImplicitEuler())
    state, held = state_of(simulator), control(scene)
    healthy, solved, _ = NativeStepper(simulator.eager).made(state, held)
    for key in differences:
        parameters(scene)[key][SICK] = torch.nan
    after, solution, _ = NativeStepper(Simulator(scene, DT, ImplicitEuler()).eager).made(state, held)
    others = torch.tensor([i for i in range(WORLDS) if i != SICK])
    well = Worlds((WORLDS,), others)
    require_same(after.take(well), healthy.take(well))
    assert torch.equal(solution.status[others], solved.status[others])
