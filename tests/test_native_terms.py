"""What acts besides contacts in the compiled core: limits that drives press on, pushes, springs and damping of free bodies."""

from __future__ import annotations

import pytest
import torch

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.native.library import library
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import JointDamping, JointSprings
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.tree.kinematics import retract
from tests.bodies import diagonal
from tests.native_parity import DT, require_balance, require_starts, require_steps, resting

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")


def arm() -> Articulation:
    """A free body with a hinge and a slide, both with limits."""
    inertia = diagonal(0.01, 0.02, 0.015)
    free, hinge = Joint("free", JointKind.FREE), Joint("hinge", JointKind.HINGE, (0.6, 0.0, 0.8), lower=-0.3, upper=0.3)
    slide = Joint("slide", JointKind.SLIDE, (0.0, 1.0, 0.0), lower=-0.1, upper=0.2)
    links = [Link("base", joints=(free,), mass=1.0, com=(0.01, 0.0, 0.02), inertia=inertia)]
    links.append(Link("upper", "base", (0.3, 0.0, 0.1), joints=(hinge,), mass=0.5, inertia=inertia))
    links.append(Link("lower", "upper", (0.0, 0.2, 0.0), joints=(slide,), mass=0.4, inertia=inertia))
    return Articulation.from_links(links)


def test_limits_that_drives_press_on() -> None:
    """Servos without a largest force, two of them on one joint, pressing weakly and strongly."""
    a = arm()
    servos = [
        Actuator.position("turn", "hinge", 200.0, 3.0),
        Actuator.motor("twist", "hinge", 2.0),
        Actuator.motor("push", "slide"),
    ]
    actuators = Actuators.from_list(a, servos)
    limits = JointLimits.for_articulation(a, actuators=actuators)
    assert limits.drives is not None
    scene = Scene(a, (Inertia(), actuators, limits), torch.tensor([0.3, 0.0, -9.81], dtype=torch.float64))
    random = torch.Generator().manual_seed(2)
    worlds = 60
    v, moved = 0.3 * torch.randn(2, worlds, a.nv, dtype=torch.float64, generator=random)
    moved[:, -2:] = torch.where(torch.arange(worlds) % 2 > 0, 1.0, -1.0)[:, None] * torch.tensor([0.3, 0.15]) + 2e-3 * v[:, -2:]
    control = 100 * torch.rand(worlds, 3, dtype=torch.float64, generator=random) ** 4
    q = retract(a, a.rest.expand(worlds, -1), moved)
    require_balance(scene, resting(retract(a, q, -DT * v), v), q, control)
    require_steps(scene, resting(q[:12], 0.1 * v[:12]), control[:12])
    require_starts(scene, q[:12], 0.1 * v[:12], control[:12])


def test_pushes() -> None:
    """On links of a tree, and none on the others."""
    a = arm()
    random = torch.Generator().manual_seed(3)
    force, point = torch.randn(2, 3, 3, dtype=torch.float64, generator=random)
    force[1] = 0.0
    scene = Scene(a, (Inertia(), Pushes(5 * force, 0.1 * point), Pushes.at_centers(a, force)), torch.zeros(3, dtype=torch.float64))
    v, moved = 0.3 * torch.randn(2, 20, a.nv, dtype=torch.float64, generator=random)
    q = retract(a, a.rest.expand(20, -1), moved)
    require_balance(scene, resting(retract(a, q, -DT * v), v), q)
    require_steps(scene, resting(q, v))
    require_starts(scene, q, v)


def test_springs_and_damping_of_a_free_body() -> None:
    """Where coordinates add up each has its own share of the step, so also where a free joint moves straight."""
    a = arm()
    random = torch.Generator().manual_seed(4)
    stiffness, damping = 0.5 + torch.rand(2, a.nv, dtype=torch.float64, generator=random)
    stiffness[3:6], damping[3:6] = 2.0, 0.4  # the same about all axes
    v, moved = 0.3 * torch.randn(2, 20, a.nv, dtype=torch.float64, generator=random)
    rest, q = a.rest, retract(a, a.rest.expand(20, -1), moved)
    terms = (Inertia(), JointSprings(200.0 * stiffness, retract(a, rest, 0.1 * moved[0])), JointDamping(5.0 * damping))
    scene = Scene(a, terms, torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64))
    require_balance(scene, resting(retract(a, q, -DT * v), v), q)
    require_steps(scene, resting(q, v))
    require_starts(scene, q, v)


@pytest.mark.parametrize("tolerance", [1e-6, 1e-12])
def test_other_tolerances(tolerance: float) -> None:
    """The core solves as well as it is asked to, and no better."""
    scene = Scene(arm(), (Inertia(),), torch.zeros(3, dtype=torch.float64))
    v = 3 * torch.randn(50, scene.articulation.nv, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    simulator = Simulator(scene, 0.05, solver=Fallbacks.within(tolerance))
    assert simulator.engine == "native"
    rollout = simulator.rollout(simulator.initial_state(scene.articulation.rest, v), steps=5)
    assert bool(rollout.solved.all())
    assert 1e-3 * tolerance < float(rollout.residual_norm.max()) <= tolerance
