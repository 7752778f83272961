"""A ball over the ground and a driven slide, for tests of what a simulator takes and gives."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pbfd_torch import JointKind, Scene
from pbfd_torch.contact.shapes import Sphere
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from tests.bodies import diagonal, free_body, on_ground, on_world


def ball(friction: CoulombFriction | None = None) -> Scene:
    """A sphere over the ground."""
    return on_ground(free_body(1.0, diagonal(0.001, 0.001, 0.001)), Sphere(0.05), NormalForce(1e6), friction)


def arm(*actuators: Actuator, gravity: Tensor | None = None) -> Scene:
    """One slide along x, 2 kg, with actuators."""
    scene = on_world(JointKind.SLIDE, 2.0, gravity=gravity)
    return dataclasses.replace(scene, terms=(Inertia(), Actuators.from_list(scene.articulation, actuators)))


def doubles(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
