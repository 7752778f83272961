"""Arrays from outside: numpy and lists where a tensor is asked for, and refusals that name the value and the range."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch import InputError, ModelError, Scene, Simulator, parameters, with_parameters
from pbfd_torch.models.boxes import box_slide
from pbfd_torch.models.chains import chain_ground
from pbfd_torch.models.stacks import stack
from pbfd_torch.simulator import AdaptiveSimulator
from pbfd_torch.terms.actuators import Actuator
from tests.bodies import at
from tests.small_scenes import arm, ball, doubles

FORMS: dict[str, Callable[[Tensor], Any]] = {
    "numpy": lambda x: x.numpy(),
    "numpy float32": lambda x: x.numpy().astype(np.float32),
    "list": lambda x: x.tolist(),
    "numpy whole numbers": lambda x: x.numpy().round().astype(np.int64),
}


@pytest.mark.parametrize("form", FORMS)
def test_arrays_and_lists(form: str) -> None:
    """q, v and the control may be what numpy or Python holds: the same state and step, to the bit, as from tensors."""
    simulator = Simulator(arm(Actuator.motor("a", "joint")), 0.01)
    q, v, control = doubles(1.0).repeat(2, 1), doubles(2.0).repeat(2, 1), doubles(3.0, 4.0)[:, None]
    expected, _ = simulator.step(simulator.initial_state(q, v, control), control)
    shape = FORMS[form]
    state, _ = simulator.step(simulator.initial_state(shape(q), shape(v), shape(control)), shape(control))
    assert torch.equal(state.q, expected.q)
    assert state.q.dtype == torch.float64


def test_adaptive_control_from_numpy() -> None:
    """The adaptive simulator takes the same forms."""
    simulator = AdaptiveSimulator(arm(Actuator.motor("a", "joint")), 0.01, 1e-3)
    state = simulator.initial_state()
    end, expected = (simulator.step(state, control)[0] for control in (np.array([2.0]), doubles(2.0)))
    assert torch.equal(end.q, expected.q)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("q", ["one"] * 7, "q is a list of <U3: must be a tensor, a numpy array or a list of real numbers"),
        ("q", [[1.0], [1.0, 2.0]], "q is no array"),
        ("q", np.zeros(7, dtype=complex), "q is a ndarray of complex128"),
        ("q", [0.0] * 6, r"q has shape \(6,\): must end in \(7,\)"),
        ("q", at(2e9), "q holds 2e[+]09: must be at most 1e[+]09 m or rad"),
        ("q", at(1e308), "q holds 1e[+]308: must be at most 1e[+]09 m or rad"),
        ("q", [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0], "q holds a quaternion of length 0: must be ≥ 1e-06"),
        ("q", [0.0, 0.0, 1.0, 1e-200, 0.0, 0.0, 0.0], "q holds a quaternion of length 0: must be ≥ 1e-06"),
        ("v", [2e6] + [0.0] * 5, "v holds 2e[+]06: must be at most 1e[+]06 m/s or rad/s"),
        ("v", [math.nan] + [0.0] * 5, "v holds NaN or infinity"),
        ("v", np.zeros((2, 6)), r"batch shapes do not go together: q: \(3,\), v: \(2,\)"),
    ],
    ids=lambda x: x[:30] if isinstance(x, str) else "",
)
def test_refused_starts(name: str, value: Any, words: str) -> None:
    """What cannot be a start is refused before anything is made of it."""
    given: dict[str, Any] = {"q": at(1.0).repeat(3, 1), name: value}
    with pytest.raises(InputError, match=words):
        Simulator(ball(), 0.01).initial_state(**given)


@pytest.mark.parametrize(
    ("control", "words"),
    [
        (["a"], "control is a list of <U1"),
        ([1.0, 2.0], r"control has shape \(2,\): must end in \(1,\)"),
        (np.zeros((7, 1)), r"batch shapes do not go together: control: \(7,\), the state: \(2,\)"),
        (torch.zeros(2, 1), "control is torch.float32 on cpu: must be torch.float64 on cpu"),
        (np.zeros((5, 2, 1)), r"control has shape \(5, 2, 1\): must be \(2, 1\), or \(1,\) for all worlds"),
    ],
    ids=["text", "too long", "worlds", "dtype", "steps"],
)
def test_refused_controls(control: Any, words: str) -> None:
    """A control of another length, number of worlds or dtype, in the start and in a step."""
    simulator = Simulator(arm(Actuator.motor("a", "joint")), 0.01)
    state = simulator.initial_state(doubles(0.0).repeat(2, 1))
    with pytest.raises(InputError, match=words):
        simulator.step(state, control)
    with pytest.raises(InputError, match=words):
        simulator.initial_state(doubles(0.0).repeat(2, 1), control=control)


@pytest.mark.parametrize("dt", [100.1, 1e6, 1e300])
def test_long_steps(dt: float) -> None:
    """Steps of more than 100 s are refused."""
    with pytest.raises(InputError, match=r"dt is .* ≥ 1e-5 and ≤ 100"):
        Simulator(ball(), dt)


def changed(scene: Scene, name: str, change: Callable[[Tensor], Any]) -> Scene:
    """The scene with one parameter changed."""
    return with_parameters(scene, {name: change(parameters(scene)[name])})


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("gravity", lambda x: x * math.nan, "gravity holds NaN or infinity: must be finite"),
        ("gravity", lambda x: x[:2], r"gravity has shape \(2,\): must end in \(3,\)"),
        ("articulation.lower", lambda x: x * math.nan, "articulation.lower holds NaN: must be numbers"),
        ("articulation.pseudo_inertia", lambda x: -x, "link 'link0': mass is .* must be ≥ 0"),
        ("articulation.pseudo_inertia", lambda x: 0 * x, "nothing that it moves has any inertia"),
        ("articulation.pseudo_inertia", lambda x: 1e-300 * x, "mass is .*e-30. kg: must be 0, or from 1e-12 to 1e[+]12 kg"),
        ("articulation.pseudo_inertia", lambda x: 1e30 * x, "mass is .* kg: must be 0, or from 1e-12 to 1e[+]12 kg"),
        ("terms.1.friction.mu", lambda x: -1 - x, "mu is .*: must be ≥ 0 and finite"),
        ("terms.1.friction.mu", lambda x: ["much"], "terms.1.friction.mu is a list"),
        ("terms.1.normal_force.stiffness", lambda x: 0 * x, "stiffness is 0.0 .*: must be > 0 and finite"),
        ("terms.1.position", lambda x: x[:1], r"terms.1.position has shape \(1, 3\): must end in \(.*, 3\), after the number"),
        ("mass", lambda x: 1.0, "no parameter named mass: the names are articulation.joint_frame"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_refused_parameters(name: str, change: Callable[[Any], Any], words: str) -> None:
    """Numbers that no scene can have are refused where they are given, by name."""
    scene = chain_ground(1).scene
    with pytest.raises((InputError, ModelError), match=words):
        with_parameters(scene, {name: change(parameters(scene).get(name))})


def test_parameters_of_other_worlds() -> None:
    """Parameters of seven worlds do not go with a start of two; numpy and lists are taken."""
    setup = box_slide(2)
    scene = changed(setup.scene, "terms.1.friction.mu", lambda x: np.full((7, 1), 0.5))
    with pytest.raises(InputError, match=r"batch shapes do not go together: q and v: \(2,\), the Contact: \(7,\)"):
        Simulator(scene, 0.01).initial_state(setup.q, setup.v)
    assert parameters(changed(setup.scene, "gravity", lambda x: [0, 0, -1]))["gravity"].tolist() == [0.0, 0.0, -1.0]


def test_parameters_that_all_worlds_share() -> None:
    """What is detected with has one value for all worlds, and says so."""
    scene = stack(2).scene
    name = next(x for x in parameters(scene) if x.endswith("table.vertices"))
    with pytest.raises(InputError, match=f"{name} has shape .*: must have shape .*, the same in all worlds"):
        changed(scene, name, lambda x: x.repeat(2, 1, 1, 1))
