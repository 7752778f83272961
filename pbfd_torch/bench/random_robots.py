"""Random robots over the ground: trees with every kind of joint and links of every shape, to find what no chosen scene shows."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Capsule, Collider, ConvexHull, Cylinder, Ellipsoid, Shape, Sphere
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import JointDamping
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import place, retract
from pbfd_torch.tree.rotations import quaternion_exp

GRAVITY = 9.81
MOST_LINKS = 5
HANGING = 1.5  # [m] above the ground, of robots that do not float
ROOM = 0.2  # [m] around a link's origin: no shape goes farther
_ROOTS = (JointKind.FREE, JointKind.FREE, JointKind.HINGE, JointKind.BALL, JointKind.SLIDE)
_JOINTS: tuple[tuple[JointKind, ...], ...] = (
    (JointKind.HINGE,),
    (JointKind.HINGE,),
    (JointKind.BALL,),
    (JointKind.SLIDE,),
    (JointKind.HINGE, JointKind.SLIDE),
    (),
)


class RandomRobot:
    """A robot of 1 to 5 links, the same for the same seed; `random` goes on for its starts and pushes."""

    def __init__(self, seed: int) -> None:
        self.random = torch.Generator().manual_seed(seed)
        count = 1 + self._pick(MOST_LINKS)
        links = [self._link(k) for k in range(count)]
        self.articulation = a = Articulation.from_links(links)
        colliders = [Collider(f"shape{k}", f"link{k}", self._shape()) for k in range(count)]
        ground = HalfSpace()
        rules = ContactRules(friction=CoulombFriction(1.0))
        turns = a.topology.turns.to(a.dtype)
        self.scene = Scene(
            a,
            (
                Inertia(),
                JointLimits.for_articulation(a),
                JointDamping(0.02 * turns),
                *contact_terms(a, colliders, [ground], rules),
                Pushes.at_centers(a, torch.zeros(a.nlink, 3, dtype=a.dtype)),
            ),
            torch.tensor([0.0, 0.0, -GRAVITY], dtype=a.dtype),
            colliders,
            [ground],
            name=f"random-{seed}",
        )

    def _pick(self, count: int) -> int:
        return int(torch.randint(count, (), generator=self.random))

    def _uniform(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), dtype=torch.float64, generator=self.random))

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, dtype=torch.float64, generator=self.random)

    def _vector(self, size: float) -> tuple[float, float, float]:
        x, y, z = (size * self._normal(3)).tolist()
        return x, y, z

    def _link(self, number: int) -> Link:
        parent = f"link{self._pick(number)}" if number else ""
        kinds = _JOINTS[self._pick(len(_JOINTS))] if number else (_ROOTS[self._pick(len(_ROOTS))],)
        joints = tuple(self._joint(f"joint{number}_{k}", kind) for k, kind in enumerate(kinds))
        mass = math.exp(self._uniform(-3.0, 1.0))
        moments = [mass * self._uniform(0.02, 0.08) ** 2 for _ in range(3)]
        x, y, z = (sum(moments) - moment for moment in moments)
        return Link(
            f"link{number}",
            parent,
            position=self._vector(0.15) if number else (0.0, 0.0, HANGING),
            joints=joints,
            mass=mass,
            com=self._vector(0.02),
            inertia=((x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z)),
        )

    def _joint(self, name: str, kind: JointKind) -> Joint:
        """Slides have limits, and every other hinge."""
        limit = {JointKind.SLIDE: 0.1, JointKind.HINGE: 1.5 if self._pick(2) else math.inf}.get(kind, math.inf)
        return Joint(name, kind, axis=self._vector(1.0), lower=-limit, upper=limit)

    def _shape(self) -> Shape:
        a, b, c = (self._uniform(0.03, 0.09) for _ in range(3))
        shapes: tuple[Shape, ...] = (
            Sphere(a),
            Capsule(a, b),
            Box((a, b, c)),
            Cylinder(a, b),
            Ellipsoid((a, b, c)),
            ConvexHull(0.06 * np.asarray(self._normal(12, 3)).clip(-1.5, 1.5)),
        )
        return shapes[self._pick(len(shapes))]

    def start(self, worlds: int) -> tuple[Tensor, Tensor]:
        """Random configurations `[worlds, nq]` and velocities `[worlds, nv]`; what floats is dropped from up to 1 m, turned
        anyhow."""
        a, turns = self.articulation, self.articulation.topology.turns
        q = a.rest.repeat(worlds, 1)
        bend = self._normal(worlds, a.nv)
        q = retract(a, q, torch.where(turns, 0.5 * bend, 0.03 * bend))
        v = torch.where(turns, 2.0, 0.3) * self._normal(worlds, a.nv)
        if a.nv >= 6 and a.topology.joint_sizes[0] == (7, 6):
            q[:, 3:7] = quaternion_exp(2.0 * self._normal(worlds, 3))
            lowest = place(a, q).poses[..., 2, 3].amin(-1) - ROOM
            q[:, 2] += torch.rand(worlds, dtype=q.dtype, generator=self.random) - lowest
        return q, v

    def pushed(self, worlds: int) -> Scene:
        """The scene with another push on every link of every world, of up to three times its own weight."""
        a = self.articulation
        size = torch.rand(worlds, a.nlink, 1, dtype=a.dtype, generator=self.random)
        force = size * GRAVITY * a.mass[..., None] * self._normal(worlds, a.nlink, 3)
        return self._with(Pushes.at_centers(a, force))

    def _with(self, pushes: Pushes) -> Scene:
        s = self.scene
        return Scene(s.articulation, (*s.terms[:-1], pushes), s.gravity, s.colliders, s.obstacles, s.name)
