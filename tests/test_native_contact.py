"""Contact in the compiled core: the reference's forces and derivatives wherever bodies touch, and its roots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Point, Shape, Sphere
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.integrators.integrator import fresh
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.solvers.objective import Status
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.kinematics import place, retract

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

DT = 0.01
GROUND, WALL = HalfSpace(), HalfSpace("wall", (-0.8, 0.0, 0.6), -0.1)
Solid = HalfSpace | Obstacle


def two_links() -> Articulation:
    """A free body that carries another one on a hinge."""
    eye = ((0.01, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.015))
    free, hinge = Joint("free", JointKind.FREE), Joint("hinge", JointKind.HINGE, (0.6, 0.0, 0.8))
    first = Link("first", joints=(free,), mass=1.0, inertia=eye, com=(0.01, 0.0, 0.02))
    return Articulation.from_links([first, Link("second", "first", (0.3, 0.0, 0.1), joints=(hinge,), mass=0.5, inertia=eye)])


def touching(shapes: Sequence[Shape], solids: Sequence[Solid], kind: Any = Contact, dtype: torch.dtype = torch.float64) -> Scene:
    """The two links, with these shapes on the second, against these solids, each with other speeds."""
    a = two_links().to(dtype)
    colliders = [
        Collider(f"c{k}", "second", shape, (0.05 * k, 0.02, 0.0), (0.9, 0.3, 0.1, 0.3), margin=1e-3 * k)
        for k, shape in enumerate(shapes)
    ]
    terms: list[Term] = [Inertia()]
    for k, solid in enumerate(solids):
        law = NormalForce(1e5, release=0.1 * (k + 1))
        terms.append(kind.between(a, colliders, solid, law, CoulombFriction(0.7, slip_speed=1e-3 * (1 + 2 * k))))
    return Scene(a, tuple(terms), torch.tensor([0.3, 0.0, -9.81], dtype=dtype))


def beside(scene: Scene, worlds: int, seed: int = 0) -> tuple[Velocities, Tensor]:
    """Random states, and configurations at which a step of theirs may end, with one candidate at the surface of one solid: up to
    a centimetre deeper or less."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=random).to(a.dtype)

    a = scene.articulation
    contacts = [term for term in scene.terms if isinstance(term, Contact)]
    q = retract(a, a.rest.expand(worlds, -1), normal(worlds, a.nv))
    depth = 0.003 * normal(worlds)
    every = torch.arange(worlds)
    for _ in range(4):  # along the normals until the depths fit
        still = resting(a, q, torch.zeros_like(q[..., 1:]))
        step = Simulator(scene, DT).eager.objective(still).step
        for k, contact in enumerate(contacts):
            mine = every % len(contacts) == k
            found = contact.points(contact.prepare(step), place(a, q))
            i = (every // len(contacts)) % len(contact.link)
            shift = (found.depth[every, i] - depth)[:, None] * found.normal[every, i]
            q[:, :3] += torch.where(mine[:, None], shift, 0.0)
    v = 0.3 * normal(worlds, a.nv)
    return resting(a, retract(a, q, -DT * v + 1e-4 * normal(worlds, a.nv)), v), q


def resting(a: Articulation, q: Tensor, v: Tensor) -> Velocities:
    """A state that has felt nothing yet."""
    zero, nothing = torch.zeros_like(q[..., 0]), torch.zeros_like(v)
    return Velocities(**fresh(q), v=v, push=nothing, steady=nothing, lag=nothing, average=v, gained=zero, surplus=zero, peak=zero)


def require_balance(scene: Scene, state: Velocities, q: Tensor, exact: float = 1e-9) -> None:
    """The core's r and J are the reference's, each world's by its own largest entry; and something touches in many worlds."""
    simulator = Simulator(scene, DT)
    native = NativeStepper(simulator.eager)
    residual, jacobian = native._core.balance(state, None, q)
    objective = simulator.eager.objective(state)
    balance = objective.evaluate(q)
    for ours, theirs in ((residual, balance.residual), (jacobian.flatten(-2), balance.jacobian.flatten(-2))):
        gap = (ours - theirs).abs().amax(-1) / theirs.abs().amax(-1)
        assert float(gap.max()) < exact, (gap.argmax(), gap.max())
    assert float((objective.push(q) > 0).double().mean()) > 0.3


def require_steps(scene: Scene, worlds: int = 12, steps: int = 5) -> None:
    """Steps end where the reference's do, and a world goes alone as in a batch."""
    simulator = Simulator(scene, DT)
    native = NativeStepper(simulator.eager)
    state, _ = beside(scene, worlds, 5)
    state = simulator.initial_state(state.q, state.v)
    direct = same = 0
    for _ in range(steps):
        after, solution, _ = native.made(state, None)
        objective = simulator.eager.objective(state)
        plain = solution.status == int(Status.SOLVED)
        error = objective.error(objective.evaluate(after.q), 1e-9)
        assert bool((error[plain] <= 1e-9).all())
        reference, eager, _ = simulator.eager.made(state, None)
        both = plain & (eager.status == int(Status.SOLVED))
        alike = both & ((after.q - reference.q).abs().amax(-1) < 1e-7)
        direct, same = direct + int(both.sum()), same + int(alike.sum())
        for field in ("v", "push", "steady", "lag", "surplus", "hazards"):
            assert torch.allclose(getattr(after, field)[alike] + 0.0, getattr(reference, field)[alike] + 0.0, 1e-5, 1e-5), field
        state = reference
    assert same >= 0.97 * direct > 0
    whole, _, _ = native.made(state, None)
    for index in (torch.tensor([3]), torch.tensor([worlds - 1, 0, 3])):
        part, _, _ = native.made(state.take(Worlds((worlds,), index)), None)
        assert torch.equal(part.q, whole.q[index])
        assert torch.equal(part.v, whole.v[index])


@pytest.mark.parametrize(
    "shapes", [(Point(), Box((0.05, 0.04, 0.03))), (Sphere(0.05), Capsule(0.03, 0.1)), (Point(), Sphere(0.05))]
)
def test_half_spaces(shapes: Sequence[Shape]) -> None:
    """Contacts with different release and slip speeds too."""
    scene = touching(shapes, (GROUND, WALL))
    require_balance(scene, *beside(scene, 45))
    require_steps(scene)
