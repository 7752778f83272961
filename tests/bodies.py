"""Simple scenes for tests: one free body on a plane, one joint on the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Shape
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.native.engine import Engine
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.rotations import quaternion_exp

GRAVITY = 9.81


def down(slope: Tensor | float = 0.0) -> Tensor:
    """Gravity on a plane that falls off towards +x by `slope` [rad]: turned instead of the plane, `[*, 3]`."""
    angle = torch.as_tensor(slope, dtype=torch.float64)
    return GRAVITY * torch.stack((torch.sin(angle), torch.zeros_like(angle), -torch.cos(angle)), -1)


def diagonal(x: float, y: float, z: float) -> tuple[tuple[float, float, float], ...]:
    return (x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z)


def box_inertia(mass: float, half: tuple[float, float, float]) -> tuple[tuple[float, float, float], ...]:
    """Of a box of uniform density with half extents `half`."""
    x, y, z = (h * h for h in half)
    return diagonal(mass / 3 * (y + z), mass / 3 * (x + z), mass / 3 * (x + y))


def free_body(mass: float, inertia: tuple[tuple[float, float, float], ...]) -> Articulation:
    """One free link with its COM at its origin."""
    return Articulation.from_links([Link("body", joints=(Joint("free", JointKind.FREE),), mass=mass, inertia=inertia)])


def on_ground(
    articulation: Articulation,
    shape: Shape,
    law: NormalForce,
    friction: FrictionLaw | None,
    gravity: Tensor | None = None,
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> Scene:
    """The free body with one collider, over the plane z = 0."""
    colliders = [Collider("shape", "body", shape, quaternion=quaternion)]
    contact = Contact.between(articulation, colliders, HalfSpace(), law, friction)
    return Scene(articulation, (Inertia(), contact), down() if gravity is None else gravity, colliders)


def at(height: float, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tensor:
    """Configuration of a free body over the origin, turned by a rotation vector."""
    return torch.cat(
        (torch.tensor((0.0, 0.0, height), dtype=torch.float64), quaternion_exp(torch.tensor(turn, dtype=torch.float64)))
    )


def on_world(kind: JointKind, mass: float, terms: Sequence[Term] = (), gravity: Tensor | None = None, arm: float = 0.0) -> Scene:
    """A link on one hinge about y or slide along x: COM `arm` [m] below the axis, inertia .02 kg m² about the COM."""
    axis = (0.0, 1.0, 0.0) if kind is JointKind.HINGE else (1.0, 0.0, 0.0)
    link = Link("link", joints=(Joint("joint", kind, axis),), mass=mass, com=(0.0, 0.0, -arm), inertia=diagonal(0.02, 0.02, 0.02))
    articulation = Articulation.from_links([link])
    return Scene(articulation, (Inertia(), *terms), torch.zeros(3, dtype=torch.float64) if gravity is None else gravity)


def rolled_out(
    scene: Scene,
    dt: float,
    duration: float,
    q: Tensor | None = None,
    v: Tensor | None = None,
    integrator: Integrator[Any] | None = None,
    engine: Engine | None = None,
) -> Rollout:
    """A rollout from the second-order start, without control; by implicit Euler, of which most is known."""
    simulator: Simulator[Any] = Simulator(scene, dt, integrator or ImplicitEuler(), engine=engine)
    return simulator.rollout(simulator.initial_state(q, v), steps=math.ceil(duration / dt - 1e-9))


def rises(energy: Tensor) -> float:
    """Largest rise of the energy over one step [J], 0 where it only falls."""
    return float(energy.diff(dim=0).clamp_min(0).max())
