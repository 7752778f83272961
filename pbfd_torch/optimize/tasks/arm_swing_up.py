"""`arm-swing-up`: an arm of two links with weak motors swings from hanging to upright and stops there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.optimize.costs import Cost, Weights, quadratic
from pbfd_torch.optimize.decision import Plan
from pbfd_torch.optimize.ilqr import Improved, Search, ilqr
from pbfd_torch.optimize.limits import Limits
from pbfd_torch.optimize.shooting import Progress
from pbfd_torch.optimize.tasks.task import Outcome, Task
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import JointDamping
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link

LENGTH, MASS = 0.5, 1.0  # of a link [m], [kg]
EFFORT = (8.0, 4.0)  # [N m]; the shoulder would need 9.8 N m to hold the arm level
SHOULDER, ELBOW = 1.5 * math.pi, 2.6  # joints turn as far as this to both sides [rad]
UPRIGHT = (math.pi, 0.0)
NEAR, SLOW = 0.1, 0.5  # [rad], [rad/s] at the end
DAMPING = 0.2  # of the joints [N m s/rad]
DT, STEPS = 0.07, 40
HELD = 4  # steps that a random control of the start is held for


def _scene(dtype: torch.dtype, device: torch.device | str) -> Scene:
    across = MASS * LENGTH * LENGTH / 12
    rows = ((across, 0.0, 0.0), (0.0, across, 0.0), (0.0, 0.0, 1e-3))

    def link(name: str, parent: str, position: tuple[float, float, float], joint: str, most: float) -> Link:
        hinge = Joint(joint, JointKind.HINGE, (0.0, 1.0, 0.0), lower=-most, upper=most)
        return Link(name, parent, position, joints=(hinge,), mass=MASS, com=(0.0, 0.0, -LENGTH / 2), inertia=rows)

    links = [
        link("upper", "", (0.0, 0.0, 0.0), "shoulder", SHOULDER),
        link("fore", "upper", (0.0, 0.0, -LENGTH), "elbow", ELBOW),
    ]
    articulation = Articulation.from_links(links, dtype, device)
    motors = [Actuator.motor(name, name, effort=effort) for name, effort in zip(articulation.joint_names, EFFORT, strict=True)]
    limits = JointLimits.for_articulation(articulation, violation=0.02)
    damping = JointDamping(articulation.rest.new_full((2,), DAMPING))
    terms = (Inertia(), limits, damping, Actuators.from_list(articulation, motors))
    gravity = torch.tensor([0.0, 0.0, -9.81], dtype=dtype, device=device)
    return Scene(articulation, terms, gravity, name="arm-swing-up")


@dataclass(frozen=True)
class ArmSwingUp(Task):
    """iLQR from random controls, about a tenth of the limits, and from nearly hanging."""

    iterations: ClassVar[int] = 30

    @property
    def criterion(self) -> str:
        """See `Task`."""
        return f"both joints within {NEAR:g} rad of upright after {STEPS * DT:g} s, slower than {SLOW:g} rad/s"

    @property
    def simulator(self) -> Simulator[Velocities]:
        """Of 2.8 s at steps of 70 ms."""
        return self.simulated(_scene(self.dtype, self.device), DT)

    @property
    def limits(self) -> Limits:
        """Of the motors."""
        return Limits.within(self.tensor(EFFORT))

    def plan(self, simulator: Simulator[Velocities]) -> Plan[Velocities]:
        """The random starts."""
        generator = self.generator()
        q = 0.05 * torch.randn(self.worlds, 2, dtype=torch.float64, generator=generator)
        controls = 0.1 * torch.randn(-(-STEPS // HELD), self.worlds, 2, dtype=torch.float64, generator=generator)
        rows = self.limits.upper * controls.to(self.device, self.dtype).repeat_interleave(HELD, 0)[:STEPS]
        return Plan(simulator.initial_state(q.to(self.device, self.dtype)), self.limits.clamped(rows), STEPS)

    def cost(self, simulator: Simulator[Velocities]) -> Cost[Velocities]:
        """Little for torque, much for not standing upright at the end."""
        return quadratic(simulator, self.tensor(UPRIGHT), Weights(control=3e-3), Weights(q=50.0, v=5.0))

    def reached(self, simulator: Simulator[Velocities], improved: Improved[Velocities]) -> Tensor:
        """`[worlds]` bool."""
        end = improved.motion.end
        v = simulator.integrator.velocity(simulator.articulation, end, simulator.step_size)
        away = (end.q - end.q.new_tensor(UPRIGHT)).abs()
        return (away < NEAR).all(-1) & (v.abs() < SLOW).all(-1) & (improved.unsolved == 0)

    def solve(self, iterations: int, progress: Progress | None = None) -> Outcome[Velocities]:
        """See `Task`."""
        simulator = self.simulator
        before = self.plan(simulator)
        assert before.controls is not None
        improved = ilqr(simulator, before.start, before.controls, self.cost(simulator), self.limits, Search(iterations), progress)
        after = Plan(before.start, improved.controls, STEPS)
        reached = self.reached(simulator, improved)
        return Outcome(simulator, before, after, improved.history, reached, improved.unsolved, improved.doubtful)
