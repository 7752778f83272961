"""Hazards of a step that was solved all the same: contacts and limits that are too deep, links that have turned far, and names."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch

from pbfd_torch import Articulation, Joint, JointKind, Link, Rollout, Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.hazards import Hazard
from pbfd_torch.contact.shapes import Collider, Sphere
from pbfd_torch.errors import InputError
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.firmness import DEEPEST_BALL, TOO_DEEP
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_limits import TOO_FAR, JointLimits
from pbfd_torch.terms.pushes import Pushes
from tests.bodies import GRAVITY, diagonal, down

R, MASS = 0.1, 1.0


def balls(push: float = 0.0) -> Scene:
    """Two balls of 1 kg on a smooth floor, the second one pushed down by `push` [N]."""
    inertia = diagonal(*(0.4 * MASS * R * R,) * 3)
    links = [Link(name, joints=(Joint(f"free {name}", JointKind.FREE),), mass=MASS, inertia=inertia) for name in ("one", "other")]
    a = Articulation.from_links(links)
    colliders = [Collider("light", "one", Sphere(R)), Collider("pressed", "other", Sphere(R))]
    force = torch.tensor([[0.0, 0, 0], [0.0, 0, -push]], dtype=torch.float64)
    terms = contact_terms(a, colliders, [HalfSpace("floor")], ContactRules(friction=None))
    return Scene(a, (Inertia(), *terms, Pushes(force, torch.zeros(2, 3, dtype=torch.float64))), down())


def standing(scene: Scene, dt: float = 0.01, steps: int = 30, spin: float = 0.0) -> Rollout:
    """Both balls on the floor, a metre apart; the second one spins about y with `spin` [rad/s]."""
    q = scene.articulation.rest[None].clone()
    q[0, 2] = q[0, 9] = R
    q[0, 7] = 1.0
    v = torch.zeros(1, 12, dtype=torch.float64)
    v[0, 10] = spin
    simulator = Simulator(scene, dt)
    return simulator.rollout(simulator.initial_state(q, v), steps=steps)


def test_too_deep() -> None:
    """At rest nothing is; pressed with more than a hundred times what the contact is for it says so, and who it is."""
    quiet = standing(balls())
    assert not bool(quiet.hazards.any())
    assert quiet.hazardous() == {}
    weight = 2 * MASS * GRAVITY  # of both: C⊥ is for all of it on one point
    pressed = standing(balls(1.2 * TOO_DEEP**2 * weight))
    assert bool(pressed.solved.all())
    assert bool((pressed.hazards[-10:] == int(Hazard.TOO_DEEP)).all())
    assert float(pressed.penetration[-1]) > TOO_DEEP * DEEPEST_BALL
    (name, count), *others = pressed.hazardous().items()
    assert (name, others) == ("pressed – floor", [])
    assert count == int((pressed.hazards != 0).sum())


def test_past_a_limit() -> None:
    """A limit that gives way by more than it should is named."""
    joint = Joint("knee", JointKind.HINGE, (0, 1, 0), lower=-0.5, upper=0.5)
    a = Articulation.from_links([Link("shin", joints=(joint,), mass=1.0, com=(0, 0, -0.3), inertia=diagonal(0.01, 0.01, 0.001))])
    simulator = Simulator(Scene(a, (Inertia(), JointLimits.for_articulation(a)), torch.zeros(3).double()), 0.01)
    inside, thrown = (torch.tensor([[x]], dtype=torch.float64) for x in (0.0, 60.0))
    assert not bool(simulator.rollout(simulator.initial_state(inside, inside), steps=5).hazards.any())
    rollout = simulator.rollout(simulator.initial_state(inside, thrown), steps=5)
    past = rollout.q[1:, 0, 0] > 0.5 + TOO_FAR
    assert bool(past.any())
    assert torch.equal(rollout.hazards[:, 0] == int(Hazard.TOO_DEEP), past)
    assert rollout.hazardous() == {"limit of knee": int(past.sum())}


def test_turned_far() -> None:
    """A ball that spins by more than a quarter turn a step while it touches the floor says so; one that spins more slowly does not.
    (The scheme turns it by 2 atan(ω Δt/2).)"""
    dt = 0.02
    slow, fast = (standing(balls(), dt, 10, spin=2 * math.tan(x * math.pi / 2) / dt) for x in (0.49, 0.51))
    assert not bool(slow.hazards.any())
    assert bool((fast.hazards == int(Hazard.TURNED_FAR)).all())
    assert fast.hazardous() == {"pressed – floor": 10}


def test_files_keep_them(tmp_path: Path) -> None:
    """Names and steps survive a file; a number without a name is refused."""
    rollout = standing(balls(1e5), steps=4)
    assert rollout.hazardous()
    rollout.save(tmp_path / "rollout.npz")
    loaded = Rollout.load(tmp_path / "rollout.npz")
    assert loaded.hazardous() == rollout.hazardous()
    assert loaded.dangers == rollout.dangers
    foreign = dataclasses.replace(rollout, dangers=rollout.dangers[:1])
    with pytest.raises(InputError, match=r"suspect holds .* from -1 to 0"):
        foreign.require_consistent()
