"""Scenes with obstacles that move, for the compiled core to be compared on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.motion import Conveyor, Lift, Motion, Turntable
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Collider, Shape, Solid
from pbfd_torch.integrators.bdf2 import Bdf2
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.variational import Variational
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.rotations import quaternion_exp


class Rocking:
    """A user's own: it turns to and fro, sinks, and its surface runs."""

    moves = True
    belt = (0.3, -0.2, 0.1)

    def pose(self, time: Tensor) -> Tensor:
        sway = Turntable(1.0, (0.2, 1.0, 0.1), (0.1, 0.0, -0.2)).pose(0.2 * torch.sin(4 * time))
        return Lift(lambda t: 0.05 * torch.sin(7 * t)).pose(time) @ sway


MOTIONS: dict[str, Motion] = {
    "conveyor": Conveyor((1.5, -0.3, 0.1)),
    "turntable": Turntable(3.0),
    "tilted": Turntable(-2.0, (0.2, -0.1, 1.0), (0.3, 0.1, -0.4)),
    "lift": Lift(lambda time: 0.1 * torch.sin(3 * time), (0.5, 0.2, 1.0)),
    "rocking": Rocking(),
}
SCHEMES: tuple[Any, ...] = (EnergyMomentum(), ImplicitEuler(), Variational(), Bdf2())
TABLE = Box((0.6, 0.5, 0.1))
TURNED = (0.98, 0.1, -0.12, 0.1)


def over(
    shapes: Sequence[Shape],
    obstacles: Sequence[HalfSpace | Obstacle],
    friction: FrictionLaw | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    """Free bodies, the first of which holds another one on a hinge, and obstacles."""
    inertia = ((0.01, 0.0, 0.0), (0.0, 0.012, 0.0), (0.0, 0.0, 0.009))
    links = [Link(f"free{k}", joints=(Joint(f"f{k}", JointKind.FREE),), mass=1.0 + k, inertia=inertia) for k in range(len(shapes))]
    hinge = Joint("hinge", JointKind.HINGE, axis=(0.0, 1.0, 0.0))
    links.append(Link("arm", "free0", (0.0, 0.25, 0.02), joints=(hinge,), mass=0.5, inertia=inertia))
    a = Articulation.from_links(links, dtype)
    colliders = [Collider(f"c{k}", f"free{k}", x, (0.02, 0.0, 0.01), friction=0.5 + 0.1 * k) for k, x in enumerate(shapes)]
    colliders.append(Collider("c", "arm", shapes[-1], (0.01, 0.0, 0.0), (0.8, 0.0, 0.6, 0.0)))
    terms = contact_terms(a, colliders, obstacles, ContactRules(friction=friction or CoulombFriction(1.0)))
    return Scene(a, (Inertia(), *terms), torch.tensor([0.0, 0.0, -9.81], dtype=dtype), colliders, tuple(obstacles))


def drawn(*shape: int, seed: int = 0) -> Tensor:
    """Uniformly from −1 … 1."""
    return 2 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1


def thrown(scene: Scene, worlds: int, seed: int = 0, spread: float = 0.3, height: float = 0.1) -> tuple[Tensor, Tensor]:
    """Configurations of free bodies about the middle of an obstacle whose top is at z = 0, and velocities."""
    a = scene.articulation
    q, v = a.rest.repeat(worlds, 1), 0.5 * drawn(worlds, a.nv, seed=seed).to(a.dtype)
    for k, (first, size) in enumerate(zip(a.topology.q_start, a.topology.joint_sizes, strict=True)):
        part = drawn(worlds, 6, seed=seed + 10 * k + 1).to(a.dtype)
        if size == (7, 6):
            q[:, first : first + 2] = spread * part[:, :2]
            q[:, first + 2] = height + 0.06 * part[:, 2]
            q[:, first + 3 : first + 7] = quaternion_exp(part[:, 3:])
    return q, v


def timed(state: Any, time: Tensor) -> Any:
    """The same state at another time."""
    return replaced(state, time=time.to(state.time.dtype))


def table(motion: Motion, shape: Solid = TABLE, position: Any = (0.0, 0.0, -0.1), turn: Any = TURNED) -> Obstacle:
    """An obstacle that moves."""
    return Obstacle("table", shape, position, turn, motion)


def stepper(scene: Scene, dt: float = 0.01, scheme: Any = None) -> NativeStepper[Any]:
    """By the core."""
    return NativeStepper(Simulator(scene, dt, scheme).eager)


def crowd(motion: Motion, shapes: Sequence[Shape], worlds: int = 0, friction: FrictionLaw | None = None) -> Scene:
    """Bodies on a table that moves, beside obstacles that move in another way and one that does not. worlds: where the table begins
    elsewhere in each."""
    block = Obstacle("block", Box((0.2, 0.2, 0.1)), (0.3, 0.2, 0.0), motion=Lift.steady((-0.5, 0.3, 0.2)))
    wheel = Obstacle("wheel", Box((0.15, 0.2, 0.1)), (-0.3, -0.1, 0.0), motion=Turntable(2.0, (0.0, 1.0, 0.3), (-0.3, 0.0, 0.0)))
    still = Obstacle("still", Box((0.1, 0.1, 0.1)), (0.0, 0.3, 0.0))
    own = (0.1 * drawn(worlds, 3, seed=8) + torch.tensor([0.0, 0.0, -0.1]),) if worlds else ()
    return over(shapes, (table(motion, Box((0.6, 0.5, 0.1)), *own), block, wheel, still), friction)


def riding(
    motion: Motion,
    shapes: Sequence[Shape],
    friction: FrictionLaw | None = None,
    dtype: torch.dtype = torch.float64,
    height: float = 0.0,
) -> Scene:
    """Bodies side by side on a table that moves, some of them beside a block that pushes them. height: of the table's top [m]."""
    pushes = Lift(lambda time: 0.05 * torch.sin(5 * time), (1.0, 0.0, 0.0))
    block = Obstacle("block", Box((0.1, 0.6, 0.15)), (-0.85, 0.0, 0.15 + height), motion=pushes)
    still = Obstacle("still", Box((0.1, 0.1, 0.1)), (0.0, 0.6, 0.0))
    top = table(motion, Box((0.9, 0.9, 0.1)), (0.0, 0.0, height - 0.1), (1.0, 0.0, 0.0, 0.0))
    return over(shapes, (top, block, still), friction, dtype)


def laid(scene: Scene, time: Tensor, seed: int = 0, turn: float = 0.3, speed: float = 0.3) -> tuple[Tensor, Tensor]:
    """Configurations of free bodies above the first obstacle as it stands at times `[worlds]`, and velocities."""
    a, worlds = scene.articulation, len(time)
    pose = scene.obstacles[0].motion.pose(time)
    q, v = a.rest.repeat(worlds, 1), speed * drawn(worlds, a.nv, seed=seed).to(a.dtype)
    free = [first for first, size in zip(a.topology.q_start, a.topology.joint_sizes, strict=True) if size == (7, 6)]
    for k, first in enumerate(free):
        part = drawn(worlds, 6, seed=seed + 10 * k + 1).to(a.dtype)
        p = a.rest.new_tensor([0.5 * k - 0.5, -0.3, 0.17]) + a.rest.new_tensor([0.1, 0.1, 0.02]) * part[:, :3]
        q[:, first : first + 3] = (pose[:, :3, :3] @ p[..., None]).squeeze(-1) + pose[:, :3, 3]
        q[:, first + 3 : first + 7] = quaternion_exp(turn * part[:, 3:])
    return q, v
