"""Jacobians of contact points against how depths change."""

from __future__ import annotations

import torch

from pbfd_torch import Simulator
from pbfd_torch.contact.shapes import Box, Sphere
from pbfd_torch.gradients.contact_jacobians import contact_jacobians
from pbfd_torch.models import SCENES
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.tree.kinematics import retract
from tests.finite_differences import derivative
from tests.touching_bodies import free_bodies, posed


def test_depths_of_points_on_the_ground() -> None:
    """−n·J is the derivative of every candidate's depth by the degrees of freedom, to 1e-8; two worlds at once."""
    setup = SCENES["chain-ground"](worlds=2)
    simulator = Simulator(setup.scene, 0.01)
    state = simulator.initial_state(setup.q, setup.v)
    (found,) = contact_jacobians(simulator, state)
    a = setup.scene.articulation
    (term,) = (term for term in simulator.objective(state).terms if isinstance(term, Contact))

    def depth(delta: torch.Tensor) -> torch.Tensor:
        moved = simulator.initial_state(retract(a, setup.q, delta).reshape(-1, a.nq))
        return contact_jacobians(simulator, moved)[0].points.depth.reshape(*delta.shape[:-1], -1)

    expected = derivative(depth, a.nv, (2,), largest=1e-3, levels=4)
    assert found.jacobian.shape == (2, len(term.link), 3, a.nv)
    torch.testing.assert_close(-(found.points.normal[..., None, :] @ found.jacobian).squeeze(-2), expected, rtol=0, atol=1e-8)


def test_relative_velocity_of_bodies() -> None:
    """Where a sphere lies on a box, J v is how its point moves against the box's: turning the box about its middle moves its top
    sideways, lifting both moves nothing."""
    scene = free_bodies((Box((0.1, 0.1, 0.05)), Sphere(0.1)), (1.0, 1.0))
    simulator = Simulator(scene, 0.01)
    state = simulator.initial_state(posed((0, 0, 0.05), (0, 0, 0.1999)))
    terms = [t for t in scene.terms if isinstance(t, Contact | BodyContact)]
    found = contact_jacobians(simulator, state)
    (k,) = (k for k, t in enumerate(terms) if isinstance(t, BodyContact))
    slots = found[k].points.depth[0] > 0
    assert int(slots.sum()) == 1
    jacobian = found[k].jacobian[0, slots].squeeze(0)
    both = torch.tensor([0.0, 0, 1, 0, 0, 0] * 2, dtype=torch.float64)
    torch.testing.assert_close(jacobian @ both, torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-12)
    turning = torch.zeros(12, dtype=torch.float64)
    turning[4] = 1.0  # the box, about y: its top at height .05 above the middle moves along x
    moved = (jacobian @ turning).abs()
    torch.testing.assert_close(moved, torch.tensor([0.05, 0, 0], dtype=torch.float64), rtol=0, atol=2e-4)
