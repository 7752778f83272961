"""`box-throw`: a box is thrown so that it lands, slides and comes to rest at a target: how fast, and in what direction?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Sphere
from pbfd_torch.gradients.trajectory import Trajectory
from pbfd_torch.identify.levenberg_marquardt import Bounds, Stopping
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.optimize.decision import StartVelocity
from pbfd_torch.optimize.shooting import Progress, Shooting, Shot
from pbfd_torch.optimize.tasks.shooting_task import ShootingTask
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link

HALF = (0.1, 0.1, 0.05)  # half extents [m]
RADIUS = 0.01  # of the sphere at each corner [m]
FRICTION = 0.6
STIFFNESS = 1e6  # C⊥ [N/m²]
HEIGHT = 0.4  # of the centre at the start [m]
TARGET = (1.0, 0.4)  # [m]
NEAR, SLOW = 0.01, 0.01  # [m], [m/s or rad/s] at the end
FAST = 4.0  # bounds of the horizontal velocity [m/s]
LEAST, MOST = (0.5, -1.0, -1.0), (3.0, 1.0, 1.0)  # velocities of the random starts [m/s]
SPIN = 4.0  # about the vertical, to both sides, at most [rad/s]
DT, STEPS = 0.04, 30


def _scene(dtype: torch.dtype, device: torch.device | str) -> Scene:
    x, y, z = (h * h / 3 for h in HALF)
    rows = ((y + z, 0.0, 0.0), (0.0, x + z, 0.0), (0.0, 0.0, x + y))
    link = Link("box", joints=(Joint("free", JointKind.FREE),), mass=1.0, inertia=rows)
    articulation = Articulation.from_links([link], dtype, device)
    places = [(x, y, z) for x in (-HALF[0], HALF[0]) for y in (-HALF[1], HALF[1]) for z in (-HALF[2], HALF[2])]
    corners = [Collider(f"corner{k}", "box", Sphere(RADIUS), place) for k, place in enumerate(places)]
    ground = HalfSpace()
    contact = Contact.between(articulation, corners, ground, NormalForce(STIFFNESS), CoulombFriction(FRICTION))
    gravity = torch.tensor([0.0, 0.0, -9.81], dtype=dtype, device=device)
    return Scene(articulation, (Inertia(), contact), gravity, corners, (ground,), "box-throw")


@dataclass(frozen=True)
class BoxThrow(ShootingTask):
    """Gauss–Newton from random throws, whose upward velocity and spin stay as they are: where the box comes to rest jumps a little
    where the step in which it lands becomes another one, and a descent would stop there."""

    iterations: ClassVar[int] = 30

    @property
    def criterion(self) -> str:
        """See `Task`."""
        return f"the box within {100 * NEAR:g} cm of the target, at rest ({SLOW:g} m/s, {SLOW:g} rad/s)"

    @property
    def shooting(self) -> Shooting[Velocities]:
        """What moves: 1.2 s at steps of 40 ms."""
        simulator = self.simulated(_scene(self.dtype, self.device), DT)
        q = simulator.articulation.rest.clone()
        q[2] = HEIGHT
        v = q.new_zeros(self.worlds, 6)
        v[:, :3], v[:, 5] = self._throws, SPIN * (2 * self._random[:, 3] - 1)
        most = q.new_full((2,), FAST)
        return Shooting(simulator, StartVelocity(simulator, STEPS, q, v, (0, 1), Bounds(-most, most, 0.25 * most)))

    @property
    def _random(self) -> Tensor:
        """Of velocity and spin, `[worlds, 4]` in 0 … 1."""
        return self.uniform(self.worlds, 4)

    @property
    def starts(self) -> Tensor:
        """Horizontal velocities of the random throws `[worlds, 2]`."""
        return self._throws[:, :2]

    @property
    def _throws(self) -> Tensor:
        """Velocities `[worlds, 3]`."""
        least, most = self.tensor(LEAST), self.tensor(MOST)
        return least + (most - least) * self._random[:, :3]

    def residual(self, motion: Trajectory[Velocities], controls: Tensor | None) -> Tensor:
        """How far the box is from the target at the end, and how fast, in units of the criterion `[*batch, 4]`."""
        gap = motion.q[-1, ..., :2] - motion.q.new_tensor(TARGET)
        return torch.cat((gap / NEAR, motion.v[-1, ..., :2] / (10 * SLOW)), -1)

    def reached(self, motion: Trajectory[Velocities]) -> Tensor:
        """`[*batch]` bool."""
        gap = motion.q[-1, ..., :2] - motion.q.new_tensor(TARGET)
        still = (motion.v[-1].abs() < SLOW).all(-1)
        return (torch.linalg.vector_norm(gap, dim=-1) < NEAR) & still & motion.solved.all(0)

    def shot(self, shooting: Shooting[Velocities], x: Tensor, iterations: int, progress: Progress | None) -> Shot[Velocities]:
        """See `ShootingTask`."""
        return shooting.gauss_newton(self.residual, x, Stopping(iterations, step=1e-3), progress)
