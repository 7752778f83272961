"""States, controls, parameters and pushes from ordinary to absurd: an error of the library's own, or an honest status in every
world and healthy worlds that notice nothing."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator, parameters, with_parameters
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Sphere
from pbfd_torch.errors import PbfdError
from pbfd_torch.solvers.objective import Status, is_solved
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact_terms import contact_terms
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_springs import JointDamping
from pbfd_torch.terms.pushes import Pushes

WORLDS, SICK, STEPS = 3, 1, 2
BALL = ((1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0), (0.0, 0.0, 1e-3))


@functools.cache
def scene(name: str, dtype: torch.dtype) -> Scene:
    """A driven pendulum over a ball on the ground; or a capsule and a box that lie on each other; with pushes of nothing."""
    if name == "pendulum":
        links = [
            Link(
                "arm", position=(0.0, 0.0, 1.0), joints=(Joint("h", JointKind.HINGE),), mass=1.0, com=(0.3, 0.0, 0.0), inertia=BALL
            ),
            Link("ball", position=(1.0, 0.0, 0.1), joints=(Joint("f", JointKind.FREE),), mass=1.0, inertia=BALL),
        ]
        colliders = [Collider("sphere", "ball", Sphere(0.1))]
    else:
        free = (JointKind.FREE, JointKind.FREE)
        links = [
            Link(body, position=(0.0, 0.0, z), joints=(Joint(body, kind),), mass=1.0, inertia=BALL)
            for body, z, kind in zip(("box", "capsule"), (0.05, 0.14), free, strict=True)
        ]
        colliders = [
            Collider("b", "box", Box((0.1, 0.1, 0.05))),
            Collider("c", "capsule", Capsule(0.04, 0.05), quaternion=(1, 1, 0, 0)),
        ]
    a = Articulation.from_links(links, dtype=dtype)
    ground = HalfSpace()
    motors = (Actuators.from_list(a, [Actuator.motor("m", "h")]),) if name == "pendulum" else ()
    terms = (Inertia(), JointDamping(a.rest.new_full((a.nv,), 0.01)), *motors, *contact_terms(a, colliders, [ground]))
    push = Pushes.at_centers(a, a.rest.new_zeros(WORLDS, a.nlink, 3))
    return Scene(a, (*terms, push), a.rest.new_tensor([0.0, 0.0, -9.81]), colliders, [ground], name)


def zeros(of: Scene) -> dict[str, Any]:
    """The start and the control of all worlds, healthy ones."""
    a = of.articulation
    q, v = a.rest.repeat(WORLDS, 1), a.rest.new_full((WORLDS, a.nv), 0.1)
    return {"q": q, "v": v, "control": a.rest.new_full((WORLDS, of.nu), 0.5), "push": a.rest.new_zeros(WORLDS, a.nlink, 3)}


@dataclasses.dataclass
class Run:
    """Where all worlds were after every step, and with which statuses."""

    q: list[Tensor]
    status: list[Tensor]


def run(of: Scene, dt: float, given: dict[str, Any]) -> Run:
    """A few steps."""
    push = Pushes.at_centers(of.articulation, given["push"])
    simulator = Simulator(dataclasses.replace(of, terms=(*of.terms[:-1], push)), dt, halvings=1, evaluations=200)
    state = simulator.initial_state(given["q"], given["v"])
    found = Run([], [])
    for _ in range(STEPS):
        state, solution = simulator.step(state, given["control"])
        found.q.append(state.q)
        found.status.append(solution.status)
        assert bool(torch.isfinite(state.q).all())
        assert bool(torch.isfinite(simulator.integrator.velocity(of.articulation, state, simulator.step_size)).all())
        assert bool(((solution.status >= 0) & (solution.status <= int(Status.NON_FINITE))).all())
        assert bool((is_solved(solution.status) <= torch.isfinite(solution.residual_norm)).all())
    return found


@functools.cache
def healthy(name: str, dtype: torch.dtype, dt: float) -> Run:
    """The batch that nothing is wrong with."""
    return run(scene(name, dtype), dt, zeros(scene(name, dtype)))


ABSURD = st.sampled_from([math.nan, math.inf, -math.inf, 1e-300, -1e-300, 1e300, -1e300, 1e160, 1e30, 1e9, 1e6, -1e3, 0.0])
NUMBERS = ABSURD | st.floats(width=32) | st.floats(-10.0, 10.0)
NAMES = st.sampled_from(["pendulum", "pile"])
DTYPES = st.sampled_from([torch.float64, torch.float32])
STEP_SIZES = st.sampled_from([0.01, 0.01, 0.002, 1e-5, 101.0, 0.0, -1.0, 1e-300, 1e300, math.nan, math.inf])
FORMS: dict[str, Callable[[Tensor], Any]] = {
    "tensor": lambda x: x,
    "numpy": lambda x: x.numpy(),
    "list": lambda x: x.tolist(),
    "half": lambda x: x.half(),
    "whole numbers": lambda x: x.nan_to_num(0, 0, 0).clamp(-9, 9).long().numpy(),
    "one short": lambda x: x[..., :-1],
    "too many worlds": lambda x: torch.cat((x, x, x[:1])),
    "one more dimension": lambda x: x[None],
    "text": lambda x: [str(y) for y in x.flatten().tolist()],
    "nothing": lambda x: [],
    "ragged": lambda x: [[1.0], [1.0, 2.0]],
    "complex": lambda x: x.numpy().astype(np.complex128),
}


def tried(of: Callable[[], Scene], dt: float, values: dict[str, Any]) -> Run | None:
    """The run, or None where it was refused with a message that says what must be."""
    try:
        return run(of(), dt, values)
    except PbfdError as error:
        refusal = str(error)
    assert ":" in refusal
    return None


@given(
    name=NAMES,
    dtype=DTYPES,
    dt=STEP_SIZES,
    what=st.sampled_from(["q", "v", "control", "push"]),
    place=st.integers(0, 12),
    value=NUMBERS,
    form=st.sampled_from(["tensor", "tensor", "tensor", "tensor", *FORMS]),
)
def test_states(name: str, dtype: torch.dtype, dt: float, what: str, place: int, value: float, form: str) -> None:
    """One number of one world is anything, and all may come in any form."""
    of = scene(name, dtype)
    values = zeros(of)
    rows = values[what]
    if rows.numel():
        rows[SICK].view(-1)[place % rows[SICK].numel()] = value
    if what != "push":
        values[what] = FORMS[form](rows)
    found = tried(lambda: of, dt, values)
    if found is None or form not in ("tensor", "numpy", "list"):
        return
    expected = healthy(name, dtype, dt)
    others = [k for k in range(WORLDS) if k != SICK]
    for k in range(STEPS):
        assert torch.equal(found.q[k][others], expected.q[k][others])
        assert torch.equal(found.status[k][others], expected.status[k][others])


@given(
    name=NAMES,
    dtype=DTYPES,
    number=st.integers(0, 1000),
    place=st.integers(0, 1000),
    value=NUMBERS,
    change=st.sampled_from(["one", "all", "times", "worlds", *FORMS]),
)
def test_parameters(name: str, dtype: torch.dtype, number: int, place: int, value: float, change: str) -> None:
    """A parameter has any value in one place or in all, or any form."""
    of = scene(name, dtype)
    known = sorted(parameters(of).items())
    key, present = known[number % len(known)]
    new: Any = present.clone()
    if change == "one" and new.numel():
        new.view(-1)[place % new.numel()] = value
    elif change == "all":
        new = torch.full_like(new, value)
    elif change == "times":
        new = new * value
    elif change == "worlds":
        new = new.repeat(7, *(1 for _ in new.shape)) if new.ndim else new.repeat(7, 1)
    elif change in FORMS:
        new = FORMS[change](new if new.ndim else new[None])
    tried(lambda: with_parameters(of, {key: new}), 0.01, zeros(of))
