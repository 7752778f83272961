"""Cylinders and ellipsoids that touch other bodies, in the compiled core: the reference's contact points, forces and steps."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Scene, Simulator
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES
from pbfd_torch.native.calls import Calls
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.tree.kinematics import retract
from tests.curved_piles import CURVED, share_points
from tests.native_parity import DT, compared, gaps, resting
from tests.native_piles import pile, thrown_together
from tests.test_native_records import recorded, require_same

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

# of worlds, at most: where a face that only stands for a curved one is nearest, rounding chooses among its edges
TIES = {"cylinders on boxes": 0.1, "all": 0.05}


@pytest.fixture
def shared(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference has the core's contact points of polytopes."""
    share_points(monkeypatch)


def off(scene: Scene, q: Tensor, size: float) -> Tensor:
    random = torch.Generator().manual_seed(1)
    step = torch.randn(len(q), scene.articulation.nv, dtype=torch.float64, generator=random)
    return retract(scene.articulation, q, size * step.to(q.dtype))


@pytest.mark.parametrize("name", CURVED)
@pytest.mark.usefixtures("shared")
def test_balance(name: str) -> None:
    """r and J at the guess, and where bodies have moved by millimetres and by centimetres."""
    scene, worlds = pile(CURVED[name]), 48
    q, v = thrown_together(scene, worlds)
    state = resting(q, v)
    guess = Simulator(scene, DT).eager.objective(state, None).guess
    for size in (0.0, 0.003, 0.05):
        residual, jacobian = gaps(scene, state, off(scene, guess, size))
        differ = (residual > 1e-9) | (jacobian > 1e-9)
        assert int(differ.sum()) <= TIES.get(name, 0.0) * worlds, differ.nonzero().flatten()


@pytest.mark.parametrize("name", ["cylinders", "ellipsoids on boxes"])
def test_balance_by_fcl(name: str) -> None:
    """The reference as it is: FCL is not always exact where bodies overlap deeply, and ties are chosen in another way."""
    scene, worlds = pile(CURVED[name]), 48
    q, v = thrown_together(scene, worlds)
    state = resting(q, v)
    residual, jacobian = gaps(scene, state, Simulator(scene, DT).eager.objective(state, None).guess)
    assert int(((residual > 1e-9) | (jacobian > 1e-9)).sum()) <= 0.25 * worlds


@pytest.mark.parametrize("integrator", INTEGRATORS.values(), ids=INTEGRATORS)
@pytest.mark.parametrize("name", ["cylinders", "ellipsoids"])
@pytest.mark.usefixtures("shared")
def test_steps(name: str, integrator: type[Integrator[Any]]) -> None:
    """Steps that both solve directly end alike, with the same hazards."""
    simulator = Simulator(pile(CURVED[name]), DT, integrator())
    q, v = thrown_together(simulator.scene, 8)
    state, native = simulator.initial_state(q, v), NativeStepper(simulator.eager)
    pairs = compared(native, state, None, 2)
    pairs.require_same()
    pairs.require_alike(["hazards"], 0, 0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", ["cylinders on boxes", "all"])
def test_no_lane_knows_another(name: str, dtype: torch.dtype) -> None:
    """A world in a batch and by itself: the same to the bit."""
    simulator = Simulator(pile(CURVED[name], dtype=dtype), DT)
    q, v = thrown_together(simulator.scene, 19)
    native, state = NativeStepper(simulator.eager), simulator.initial_state(q, v)
    for _ in range(2):
        whole, solution, _ = native.made(state, None)
        for index in (torch.tensor([17]), torch.tensor([18, 0, 5])):
            part, solved, _ = native.made(state.take(Worlds((19,), index)), None)
            assert torch.equal(part.q, whole.q[index])
            assert torch.equal(part.v, whole.v[index])
            assert torch.equal(part.hazards, whole.hazards[index])
            assert torch.equal(solved.evaluations, solution.evaluations[index])
        state = whole


def arm(worlds: int) -> tuple[Simulator[Any], Any, Tensor]:
    setup = SCENES["robot-arm"](worlds=worlds)
    simulator = Simulator(setup.scene, setup.dt)
    random = torch.Generator().manual_seed(0)
    assert setup.control is not None
    controls = setup.control + 0.3 * torch.randn(10, worlds, setup.scene.nu, dtype=torch.float64, generator=random)
    return simulator, simulator.initial_state(setup.q, setup.v + 0.1 * torch.randn(setup.v.shape, generator=random)), controls


def test_robot_arm() -> None:
    """r, J and steps of a scene with a can on a table, and FCL in the reference."""
    simulator, state, controls = arm(8)
    assert simulator.engine == "native"
    native = NativeStepper(simulator.eager)
    pairs = compared(native, state, controls, len(controls))
    objective = pairs.stepper.objective(pairs.before, pairs.control)
    at = off(simulator.scene, objective.guess, 0.001)
    residual, jacobian = native._core.balance(pairs.before, pairs.control, at)
    expected = objective.evaluate(at)
    for ours, theirs in ((residual, expected.residual), (jacobian, expected.jacobian)):
        assert float(((ours - theirs).abs() / theirs.abs().max()).max()) < 1e-9
    pairs.require_roots()
    pairs.require_same()
    pairs.require_alike(["hazards"], 0, 0)


@pytest.mark.usefixtures("shared")
def test_records() -> None:
    """Of steps of ellipsoids; and of the arm but for contact points far from others, where there are ties."""
    simulator = Simulator(pile(CURVED["ellipsoids"]), DT)
    q, v = thrown_together(simulator.scene, 5)
    require_same(*recorded(simulator, simulator.initial_state(q, v), None, 3))
    simulator, state, controls = arm(5)
    found, expected = recorded(simulator, state, controls, 10)
    for ours, theirs in ((found.link_poses, expected.link_poses), (found.kinetic_energy, expected.kinetic_energy)):
        assert torch.allclose(ours, theirs, 0.0, 1e-12)
    assert torch.allclose(found.contact_force, expected.contact_force, 0.0, 1e-9 * float(expected.contact_force.abs().max()))
    same = (found.contact_point - expected.contact_point).abs().amax(-1) < 1e-12
    assert float(same.double().mean()) > 0.99
    assert bool(same[expected.contact_depth > 0].all())


def test_nothing_is_read_before_it_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps are the same bits after zeros, after ones and after NaNs (bytes 255) in the core's memory."""
    simulator = Simulator(pile(CURVED["all"]), DT)
    q, v = thrown_together(simulator.scene, 5)
    ends, room = [], Calls._room
    for byte in (0, 1, 255):

        def filled(calls: Calls, byte: int = byte) -> Any:
            found = room(calls)
            found._memory.fill_(byte)
            return found

        monkeypatch.setattr(Calls, "_room", filled)
        rollout = simulator.rollout(simulator.initial_state(q, v), steps=2)
        ends.append(torch.cat([x.flatten() for x in (rollout.q, rollout.contact_force, rollout.contact_point)]))
    assert torch.equal(ends[0], ends[1])
    assert torch.equal(ends[0], ends[2])
