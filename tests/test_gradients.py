"""Derivatives of steps by the implicit function theorem: every term and integrator, by everything that a step depends on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.scene import Scene
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.static_friction import StaticFriction
from pbfd_torch.tree.kinematics import difference
from tests.gradient_checks import SMOOTH, Experiment, compared
from tests.term_cases import ROUND, TERMS, Situation, TermCase, contact, dry_torque, situation

# differences need laws that are smooth over what they move by: the steep ones of TERMS over a centimetre a second
SLIDING = CoulombFriction(0.7, slip_speed=0.02)
GENTLE = (
    TermCase("Coulomb, sliding", lambda s: contact(s, SLIDING)),
    TermCase("Coulomb, sliding, rolling", lambda s: contact(s, SLIDING, shapes=ROUND)),
    TermCase("static, weakening", lambda s: contact(s, StaticFriction(0.7, 0.4, slip_speed=0.05, stribeck_speed=10.0))),
    TermCase("anchored, sliding, rolling", lambda s: contact(s, AnchoredFriction(0.7, stretch=1e-3), shapes=ROUND)),
    TermCase("joint dry friction, sliding", lambda s: JointDryFriction(dry_torque(s), slip_speed=0.02)),
    TermCase("actuators", lambda s: servos(s)),
)
STEEP = ("sliding", "weakening", "actuators")
CASES = (*(case for case in TERMS if not any(word in case.name for word in STEEP)), *GENTLE)
# the schemes that take the virtual work elsewhere get all terms, the others those that differ in kind
FEW = (
    "inertia",
    "contact, letting go",
    "Coulomb, sliding, rolling",
    "PBFD as printed",
    "joint damping",
    "joint springs",
    "armature",
)


def servos(s: Situation) -> Actuators:
    """A motor, a position servo and a velocity servo, none at its limit, and a motor that is."""
    names = [s.articulation.joint_names[int(j)] for j in s.articulation.topology.scalar_joint]
    return Actuators.from_list(
        s.articulation,
        [
            Actuator.motor("motor", names[0], gear=2.0),
            Actuator.position("position", names[2], kp=30.0, kv=2.0),
            Actuator.velocity("velocity", names[1], kv=4.0),
            Actuator.motor("weak motor", names[3], effort=1e-3),
        ],
    )


def experiment(case: TermCase, integrator: Callable[[], Integrator[Any]]) -> Experiment:
    """Two steps of a random tree under inertia, gravity and the term."""
    s = situation(0)
    term = case.build(s)
    terms = (term,) if isinstance(term, Inertia) else (Inertia(), term)
    scene = Scene(s.articulation, terms, s.gravity)
    v = 0.2 * difference(s.articulation, s.state.q_previous, s.state.q) / s.dt
    control = None if s.control is None else s.control[: scene.nu]
    return Experiment(scene, float(s.dt), integrator, s.state.q, v, control)


PAIRS = [
    pytest.param(case, name, id=f"{case}, {name}")
    for name in SMOOTH
    for case in CASES
    if name == "energy-momentum" or case.name in (*FEW, "armature", "actuators")
]


@pytest.mark.parametrize(("case", "name"), PAIRS)
def test_two_steps_from_a_start(case: TermCase, name: str) -> None:
    """Configuration, velocity, control, dt, gravity, and every number of the articulation and the term: ≤ 1e-7 of central
    differences, relative."""
    found = compared(experiment(case, SMOOTH[name]))
    assert {"q", "v", "dt", "gravity", "articulation.pseudo_inertia", "articulation.joint_frame"} <= set(found)
    wrong = {n: (f.implicit, f.differences) for n, f in found.items() if not (f.same and f.error <= 1e-7)}
    assert not wrong


def test_differences_shrink_with_the_square_of_their_step() -> None:
    """What central differences are off by falls by 4 as they halve, until rounding: the implicit derivative is their limit."""
    case = next(case for case in CASES if case.name == "Coulomb, sticking, rolling")
    given = experiment(case, SMOOTH["energy-momentum"])
    directions = given.directions()
    for name in ("q", "v", "articulation.pseudo_inertia", "terms.1.friction.mu", "dt"):
        exact = compared(given, names=(name,))[name].implicit
        t = 0.2 * 0.5 ** torch.arange(4, dtype=torch.float64)
        with torch.no_grad():
            ends = [
                torch.stack([given.end({name: given.moved(name, directions[name], sign * x)})[0] for x in t]) for sign in (1, -1)
            ]
        errors = ((ends[0] - ends[1]) / (2 * t) - exact).abs()
        ratios = errors[:-1] / errors[1:]
        assert bool(((ratios > 3.4) & (ratios < 4.6)).all()), (name, ratios)
