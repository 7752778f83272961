"""Compiled steps are the reference's: roots that it calls solved, the same state after them, and no lane that knows another."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import InputError, Simulator
from pbfd_torch.bench.starts import scattered
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.models import SCENES, file_setup
from pbfd_torch.native.library import library
from pbfd_torch.native.plan import planned
from pbfd_torch.native.stepper import NativeStepper, uncovered
from pbfd_torch.solvers.objective import Status
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.tree.rotations import skew
from tests.native_parity import OwnScheme, compared

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

COVERED = ("box-slide", "chain-fixed", "chain-ground", "chain-slope", "dzhanibekov", "hopper", "walker")
FIELDS = ("q", "v", "push", "steady", "lag", "average", "gained", "surplus", "peak", "time", "hazards")


def started(name: str, dt: float, worlds: int, dtype: torch.dtype = torch.float64) -> tuple[Simulator[Velocities], Velocities]:
    setup = SCENES[name](worlds=worlds, dtype=dtype)
    simulator = Simulator(setup.scene, dt)
    q, v = scattered(setup, 0, 0.3, 1.0)
    return simulator, simulator.initial_state(q, v)


def controls(simulator: Simulator[Velocities], steps: int, worlds: int) -> Tensor:
    random = torch.Generator().manual_seed(1)
    nu = simulator.scene.nu
    drawn = 2 * torch.rand(steps, worlds, nu, dtype=torch.float64, generator=random) - 1
    return drawn.to(simulator.articulation.dtype)


@pytest.mark.parametrize("dt", [0.005, 0.02, 0.05])
@pytest.mark.parametrize("name", COVERED)
def test_parity(name: str, dt: float) -> None:
    """From states of a rollout: the reference's own error of every end is within the tolerance, and where both solve the step
    directly they find the same root and go on from it alike."""
    worlds, steps = 11, 8
    simulator, state = started(name, dt, worlds)
    native = NativeStepper(simulator.eager)
    pairs = compared(native, state, controls(simulator, steps, worlds), steps)
    assert bool(pairs.solution.solved.all())
    pairs.require_roots()
    pairs.require_same()
    pairs.require_alike(FIELDS, 1e-5, 1e-6)


@pytest.mark.parametrize("name", ["hopper", "chain-ground"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_no_lane_knows_another(name: str, dtype: torch.dtype) -> None:
    """A world in a batch, in another place of it, and by itself: the same to the bit; and twice the same."""
    worlds = 37
    simulator, state = started(name, 0.01, worlds, dtype)
    native = NativeStepper(simulator.eager)
    for control in controls(simulator, 12, worlds):
        state, _, _ = native.made(state, control)
    control = controls(simulator, 13, worlds)[-1]
    whole, solution, _ = native.made(state, control)
    again, _, _ = native.made(state, control)
    order = torch.randperm(worlds, generator=torch.Generator().manual_seed(3))
    for index in (order, order[:5], order[7:8]):
        part = Worlds((worlds,), index)
        some, solved, _ = native.made(state.take(part), control[index])
        assert torch.equal(solved.evaluations, solution.evaluations[index])
        for field in FIELDS:
            assert torch.equal(getattr(some, field), getattr(whole, field)[index]), field
    for field in FIELDS:
        assert torch.equal(getattr(again, field), getattr(whole, field)), field


def test_a_world_that_is_not_finite_stands_still() -> None:
    """With its state and its status; the others are as without it."""
    simulator, state = started("hopper", 0.008, 9)
    native = NativeStepper(simulator.eager)
    control = controls(simulator, 1, 9)[0]
    healthy, _, _ = native.made(state, control)
    sick = dataclasses.replace(state, v=state.v.clone())
    sick.v[4] = torch.nan
    after, solution, _ = native.made(sick, control)
    assert int(solution.status[4]) == int(Status.NON_FINITE)
    assert torch.equal(after.q[4], state.q[4])
    others = torch.tensor([i for i in range(9) if i != 4])
    for field in FIELDS:
        assert torch.equal(getattr(after, field)[others], getattr(healthy, field)[others]), field


def test_batches_of_any_shape() -> None:
    """Also without a control, and without a batch."""
    simulator, state = started("hopper", 0.008, 6)
    native = NativeStepper(simulator.eager)
    flat, _, _ = native.made(state, None)
    folded = dataclasses.replace(
        state, **{name: getattr(state, name).reshape(2, 3, *getattr(state, name).shape[1:]) for name in FIELDS}
    )
    shaped, solution, _ = native.made(dataclasses.replace(folded, memory=()), None)
    assert solution.status.shape == (2, 3)
    assert torch.equal(shaped.q.reshape(6, -1), flat.q)


OBLIQUE = """<mujoco><compiler angle="radian"/><worldbody><geom type="plane" size="5 5 1"/>
  <body pos="1 2 0.5"><joint type="slide" axis="0.8 -0.6 0"/><joint type="slide" axis="0 0 1"/>
    <joint type="hinge" axis="0.6 0.8 0" pos="0.1 0 0.1"/><geom type="capsule" fromto="0 0 0 0.4 -0.3 0.1" size="0.05"/>
    <body pos="0.4 -0.3 0.1" euler="0.3 0.2 0.1"><joint type="hinge" axis="%s" range="-0.5 0.8" limited="true" armature="0.01"/>
      <geom type="box" size="0.05 0.1 0.2" pos="0.02 0.03 0.2"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("name", ["chain-fixed", "hopper", "walker", "oblique"])
def test_a_plane_is_space_with_less(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes that move in a plane step in it as they do in space, in any plane, with hinges that turn ahead and back."""
    if name == "oblique":  # −(0.6, 0.8, 0) in a frame that is turned
        turn = torch.linalg.matrix_exp(skew(torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64)))
        for axis in ([0.0, 0.2, 0.0], [0.0, 0.0, 0.1]):
            turn = turn @ torch.linalg.matrix_exp(skew(torch.tensor(axis, dtype=torch.float64)))
        axis = -turn.mT @ torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
        file = tmp_path / "oblique.xml"
        file.write_text(OBLIQUE % " ".join(f"{x:.17g}" for x in axis.tolist()))
        setup = file_setup(file, worlds=11)
    else:
        setup = SCENES[name](worlds=11)
    simulator = Simulator(setup.scene, 0.01)
    state = simulator.initial_state(*scattered(setup, 0, 0.3, 1.0))
    flat = NativeStepper(simulator.eager)
    assert planned(simulator.eager).dimension == 2
    monkeypatch.setattr("pbfd_torch.native.plan.plane_of", lambda *_: None)
    assert planned(simulator.eager).dimension == 3
    spatial, solved = NativeStepper(simulator.eager), 0
    for control in controls(simulator, 20, 11):
        after, solution, _ = flat.made(state, control)
        other, found, _ = spatial.made(state, control)
        both = (solution.status == int(Status.SOLVED)) & (found.status == int(Status.SOLVED))
        solved += int(both.sum())
        close = (after.q - other.q).abs().amax(-1) < 1e-9
        assert int((both & ~close).sum()) == 0
        state = other
    assert solved > 0.8 * 20 * 11


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("hopper", {"integrator": OwnScheme()}, "integrator OwnScheme"),
    ],
)
def test_what_is_not_covered_is_said(name: str, changes: dict[str, Any], words: str) -> None:
    """By name; nothing is stepped otherwise in silence."""
    simulator = Simulator(SCENES[name]().scene, 0.01, **changes)
    assert words in uncovered(simulator.eager)
    with pytest.raises(InputError, match="no compiled steps: the core does not know"):
        NativeStepper(simulator.eager)
