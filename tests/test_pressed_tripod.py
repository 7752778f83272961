"""A light body that is pressed onto its feet by many times its weight: it stands, however hard and however long the steps."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Sphere
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import retract
from pbfd_torch.tree.rotations import quaternion_matrix
from tests.bodies import diagonal, down, rolled_out
from tests.finite_differences import jacobian, relative_error

HEIGHT = 0.04  # of the body's origin, where it is pushed, above the floor [m]


def tripod(load: float, arm: tuple[float, float] = (0.006, 0.004)) -> Scene:
    """5 g on three balls of 2 mm, 2 cm from the middle, pushed down by `load` [N] beside it, on ground that is stiff for it."""
    link = Link("body", joints=(Joint("free", JointKind.FREE),), mass=0.005, inertia=diagonal(5e-7, 5e-7, 1e-6))
    articulation = Articulation.from_links([link])
    angles = (0.0, 2 * math.pi / 3, -2 * math.pi / 3)
    feet = [(0.02 * math.cos(x), 0.02 * math.sin(x), 0.002 - HEIGHT) for x in angles]
    colliders = [Collider(f"foot{k}", "body", Sphere(0.002), position=at, friction=0.5) for k, at in enumerate(feet)]
    rules = ContactRules(NormalForce.for_weight(20.0, 1e-4))
    contacts = contact_terms(articulation, colliders, [HalfSpace(friction=0.5)], rules)
    push = Pushes(torch.tensor([[0.0, 0.0, -load]]).double(), torch.tensor([[*arm, 0.0]]).double())
    return Scene(articulation, (Inertia(), *contacts, push), down())


@pytest.mark.parametrize("integrator", [EnergyMomentum(), ImplicitEuler()], ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("dt", [0.005, 0.01, 0.02, 0.05])
@pytest.mark.parametrize("load", [20.0, 2.0, 0.5])
def test_it_stands(load: float, dt: float, integrator: Integrator[Any]) -> None:
    """From rest at the floor and a tenth of a millimetre above: all steps are solved, it never leans by more than a degree, and in
    the end it rests."""
    scene = tripod(load)
    q = scene.articulation.rest.repeat(2, 1)
    q[:, 2] = torch.tensor([HEIGHT, HEIGHT + 1e-4])
    rollout = rolled_out(scene, dt, max(0.1, 6 * dt), q, torch.zeros_like(q[:, :6]), integrator=integrator)
    assert bool(rollout.solved.all())
    up = quaternion_matrix(rollout.q[..., 3:])[..., 2, 2]
    assert float(up.min()) > math.cos(math.radians(1.0))
    assert float((rollout.q[-1, :, 2] - HEIGHT).abs().max()) < 1e-3
    assert float(rollout.v[-1].abs().max()) < 1e-3


@pytest.mark.parametrize("integrator", [EnergyMomentum(), ImplicitEuler()], ids=lambda x: type(x).__name__)
def test_it_falls_over(integrator: Integrator[Any]) -> None:
    """Pushed beside its feet it falls over as it must, with every step solved."""
    scene = tripod(0.5, (-0.03, 0.0))
    q = scene.articulation.rest[None].clone()
    q[:, 2] = HEIGHT
    rollout = rolled_out(scene, 0.05, 0.5, q, torch.zeros(1, 6, dtype=torch.float64), integrator=integrator)
    assert bool(rollout.solved.all())
    assert float(quaternion_matrix(rollout.q[-1, ..., 3:])[..., 2, 2].max()) < 0.5


@pytest.mark.parametrize("integrator", [EnergyMomentum(), ImplicitEuler()], ids=lambda x: type(x).__name__)
def test_no_world_sees_another(integrator: Integrator[Any]) -> None:
    """The first steps find a root that has strayed in some worlds and not in others: each ends bitwise where it does alone."""
    scene = tripod(2.0)
    q = scene.articulation.rest.repeat(12, 1)
    q[:, 2] = HEIGHT + torch.linspace(0.0, 1e-3, 12)
    simulator = Simulator(scene, 0.05, integrator)
    together = simulator.rollout(simulator.initial_state(q), steps=2)
    assert not torch.equal(together.status, torch.zeros_like(together.status))
    for k in (0, 5, 11):
        alone = simulator.rollout(simulator.initial_state(q[k : k + 1]), steps=2)
        assert torch.equal(alone.q[:, 0], together.q[:, k])


@pytest.mark.parametrize("share", [2**-4, 0.5, 1.0])
def test_a_shorter_motion_has_an_exact_jacobian(share: float) -> None:
    """What a step that has strayed is followed along: its Jacobian is the derivative, and all of the motion is the step itself."""
    scene = tripod(2.0)
    q = scene.articulation.rest[None].clone()
    q[:, 2] = HEIGHT
    stepper: EagerStepper[Any] = EagerStepper(scene, 0.02)
    v = torch.tensor([[0.3, -0.2, -0.5, 2.0, 1.0, -3.0]], dtype=torch.float64)
    whole = stepper.objective(stepper.initial_state(q, v, None))
    objective, there = whole.shortened(share), retract(scene.articulation, q, 1e-3 * v)
    exact = jacobian(scene.articulation, lambda x: objective.evaluate(x).residual, there, largest=1e-5)
    assert relative_error(objective.evaluate(there).jacobian, exact) <= 1e-7
    if share == 1:
        assert torch.equal(objective.evaluate(there).residual, whole.evaluate(there).residual)
