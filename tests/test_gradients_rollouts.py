"""Derivatives of whole rollouts: closed forms, special points, the same values whatever is asked, checkpoints, memory."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from pbfd_torch import Simulator
from pbfd_torch.contact.shapes import Sphere
from pbfd_torch.gradients.implicit import Gradients
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Engine, Torch
from pbfd_torch.scene import Scene
from pbfd_torch.tensors.structures import mapped_tensors, tensors_of
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import difference
from tests.bodies import GRAVITY, diagonal
from tests.finite_differences import derivative
from tests.gradient_checks import PRECISE, SMOOTH
from tests.random_trees import generator
from tests.sliding_box import stopped
from tests.touching_bodies import free_bodies, posed

all_integrators = pytest.mark.parametrize("name", SMOOTH)


def number(value: float) -> Tensor:
    """A float64 scalar."""
    return torch.tensor(value, dtype=torch.float64)


def along(function: Callable[[Tensor], Tensor], largest: float, batch: tuple[int, ...] = ()) -> Tensor:
    """Central differences of functions of a number each, `[m, *batch]` → `[m, *batch]`, at 0, extrapolated."""
    with torch.no_grad():
        return derivative(lambda t: function(t.squeeze(-1)), 1, batch, largest, levels=7).squeeze(-1)


# Closed forms ---------------------------------------------------------------------------------------------------------


def test_stopping_box() -> None:
    """After .5 s at μ = .3 the box has stopped at v²/(2μg): v/(μg) = .3398 and −v²/(2μ²g) = −.5663 to 1 % at Δt .01, and 1e-6 of
    central differences."""
    v0, mu = torch.ones(1, dtype=torch.float64, requires_grad=True), torch.full((1,), 0.3, dtype=torch.float64, requires_grad=True)
    by_v, by_mu = torch.autograd.grad(stopped(v0, mu).sum(), (v0, mu))
    by_differences = (
        along(lambda t: stopped(1 + t, torch.full_like(t, 0.3)), 1e-3),
        along(lambda t: stopped(torch.ones_like(t), 0.3 + t), 1e-3),
    )
    assert float(by_v) == pytest.approx(1 / (0.3 * GRAVITY), rel=0.01)
    assert float(by_mu) == pytest.approx(-1 / (2 * 0.3**2 * GRAVITY), rel=0.01)
    assert float(by_v) == pytest.approx(float(by_differences[0]), rel=1e-6)
    assert float(by_mu) == pytest.approx(float(by_differences[1]), rel=1e-6)


def collided(start: Tensor, law: NormalForce, restitution: Restitution | None, dt: float) -> Tensor:
    """Where the second of two equal balls is 1 s after the first, at x1 with v0, has set out to hit it, at x2 with u0. start: x1,
    x2, v0, u0, `[m, 4]` → `[m]`. Radius .1 m, weightless."""
    scene = free_bodies((Sphere(0.1), Sphere(0.1)), (1.0, 1.0), (), mu=0.0, gravity=torch.zeros(3, dtype=torch.float64))
    terms = [replaced(t, restitution=restitution, normal_force=law) if isinstance(t, BodyContact) else t for t in scene.terms]
    simulator = Simulator(replaced(scene, terms=tuple(terms)), dt)
    q = posed((0, 0, 0), (0, 0, 0)).expand(len(start), -1).clone()
    v = torch.zeros(len(start), 12, dtype=torch.float64)
    x = torch.eye(14, dtype=torch.float64)
    q = q + start[:, :1] * x[0] + start[:, 1:2] * x[7]
    v = v + start[:, 2:3] * x[0, :12] + start[:, 3:] * x[6, :12]
    path = simulator.trajectory(simulator.initial_state(q, v), steps=round(1 / dt))
    assert bool(path.solved.all())
    return path.q[-1, :, 7]


# normal force, restitution, Δt; derivatives by x1, x2, v0, u0, and how far the simulation's are from them
BALLS = {
    "elastic, contact over 50 steps": (NormalForce(2e3, release=math.inf), None, 0.004, (1.0, 0.0, 1.0, 0.0), 0.25),
    "elastic, impact in one step": (NormalForce(1e8), Restitution(1.0), 0.01, (0.0, 1.0, 0.7, 0.3), 0.01),
    "inelastic, contact over 50 steps": (NormalForce(2e3), None, 0.004, (0.5, 0.5, 0.5, 0.5), 0.25),
}


@pytest.mark.parametrize("case", BALLS)
def test_two_equal_balls(case: str) -> None:
    """The second of two elastic balls ends where the first would have been without it, one diameter ahead: by (x1, x2, v0, u0) the
    derivatives are (1, 0, T, 0); inelastic balls share the speed, (1, 1, T, T)/2. Where steps resolve the contact the simulation's
    come near that. An impact within one step happens at the step's end whenever it should have: that is another function, whose
    derivatives, given exactly, are those of free flight up to there. All are those of central differences, to 1e-5."""
    law, restitution, dt, near, most = BALLS[case]
    start = torch.tensor([[0.0, 0.503, 1.0, 0.0]], dtype=torch.float64)
    given = start.clone().requires_grad_()
    (found,) = torch.autograd.grad(collided(given, law, restitution, dt).sum(), given)

    def moved(t: Tensor) -> Tensor:
        """`[m, 4]`, in each of four worlds along another one of the numbers."""
        return collided((start + torch.diag_embed(t)).flatten(0, 1), law, restitution, dt).view_as(t)

    torch.testing.assert_close(found[0], along(moved, 1e-4, (4,)), rtol=0, atol=1e-5)
    torch.testing.assert_close(found[0], torch.tensor(near, dtype=torch.float64), rtol=0, atol=most)


def test_long_horizon() -> None:
    """A thousand steps of a spinning body that touches nothing: the derivative of where it ends by its velocity grows with time as
    it should, linearly along the motion, and stays below a hundred times that."""
    setup = SCENES["dzhanibekov"]()
    simulator = Simulator(setup.scene, 0.01, SMOOTH["variational"]())
    v = setup.v.clone().requires_grad_()
    path = simulator.trajectory(simulator.initial_state(setup.q, v), steps=1000)
    (by_v,) = torch.autograd.grad(path.q[-1, 0, :3].sum(), v)
    seconds = 10.0
    assert bool(torch.isfinite(by_v).all())
    assert float(by_v[0, :3].mean()) == pytest.approx(seconds, rel=1e-6)
    assert float(by_v.norm()) <= 100 * seconds


# The same values, whatever is asked of them ---------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "engine"), [*((name, None) for name in SMOOTH), ("energy-momentum", Torch())])
def test_values_are_the_same_to_the_bit(name: str, engine: Engine | None) -> None:
    """With and without derivatives, from one state: a chain that lands on a slope, eased and halved steps among its own, by its
    start, its masses and its friction, with checkpoints and without."""
    setup = SCENES["chain-slope-drop"](worlds=2)
    v = setup.v + torch.tensor([[0.0], [0.3]], dtype=torch.float64)
    plain = Simulator(setup.scene, 0.05, SMOOTH[name](), engine=engine)
    names = ("articulation.pseudo_inertia", "terms.1.friction.mu")
    values = {n: x.clone().requires_grad_() for n, x in parameters(setup.scene).items() if n in names}
    simulator = Simulator(with_parameters(setup.scene, values), 0.05, SMOOTH[name](), engine=engine)
    given = v.clone().requires_grad_()
    start = simulator.initial_state(setup.q, given)
    expected = plain.trajectory(mapped_tensors(start, Tensor.detach), steps=9)
    gradients = []
    for checkpoint in (1, 4):
        path = simulator.trajectory(start, steps=9, checkpoint=checkpoint)
        assert torch.equal(path.q, expected.q)
        assert torch.equal(path.v, expected.v)
        assert torch.equal(path.status, expected.status)
        end = (path.q[-1] ** 2).sum() + path.v[3].sum()
        gradients.append(torch.autograd.grad(end, (given, *values.values()), retain_graph=True))
    for once, again in zip(*gradients, strict=True):
        torch.testing.assert_close(once, again, rtol=1e-12, atol=1e-12 * float(once.abs().max()))
    record = simulator.rollout(start, steps=9)
    assert torch.equal(record.q, expected.q)


@all_integrators
def test_starts_have_the_same_values(name: str) -> None:
    """With and without derivatives, to the bit, by both engines."""
    setup = SCENES["chain-slope-drop"](worlds=2)
    for engine in (Torch(), None):
        simulator = Simulator(setup.scene, 0.05, SMOOTH[name](), engine=engine)
        starts = [simulator.initial_state(setup.q, v) for v in (setup.v, setup.v.clone().requires_grad_())]
        for without, carrying in zip(*map(tensors_of, starts), strict=True):
            torch.testing.assert_close(carrying, without, rtol=0, atol=0, equal_nan=True)


def test_the_same_twice() -> None:
    """Derivatives are bitwise repeatable in one process."""
    v0 = torch.tensor([1.0, 0.8], dtype=torch.float64)
    found = []
    for _ in range(2):
        given, mu = v0.clone().requires_grad_(), torch.tensor([0.3, 0.4], dtype=torch.float64, requires_grad=True)
        found.append(torch.autograd.grad(stopped(given, mu, seconds=0.2).sum(), (given, mu)))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


@all_integrators
def test_forward_and_backward_agree(name: str) -> None:
    """torch.func.jvp, dual numbers and backward give the same derivative along a direction, to 1e-10; through a start, eased steps
    and contact."""
    setup = SCENES["chain-slope-drop"]()
    direction = torch.randn(setup.v.shape, dtype=torch.float64, generator=generator(1))

    def end(v: Tensor, mu: Tensor) -> Tensor:
        scene = with_parameters(setup.scene, {"terms.1.friction.mu": mu})
        simulator = Simulator(scene, 0.05, SMOOTH[name]())
        return simulator.trajectory(simulator.initial_state(setup.q, v), steps=6).q[-1].square().sum()

    mu, step = number(0.3), number(0.7)
    forward = torch.func.jvp(end, (setup.v, mu), (direction, step))[1]
    given = setup.v.clone().requires_grad_(), mu.clone().requires_grad_()
    by_v, by_mu = torch.autograd.grad(end(*given), given)
    expected = float((by_v * direction).sum() + by_mu * step)
    assert float(forward) == pytest.approx(expected, rel=1e-10)
    with forward_ad.dual_level():
        dual = end(forward_ad.make_dual(setup.v, direction), forward_ad.make_dual(mu, step))
        assert float(forward_ad.unpack_dual(dual).tangent) == pytest.approx(expected, rel=1e-10)


def test_nothing_but_states_is_kept() -> None:
    """What the graph of a trajectory saves, a step and world: the state's numbers; with checkpoints every ten steps a fifth of that
    at most. Worlds of chain-ground, whose state is 744 bytes."""
    setup = SCENES["chain-ground"](worlds=16)
    simulator = Simulator(setup.scene, 0.02, SMOOTH["energy-momentum"]())
    start = simulator.initial_state(setup.q, setup.v)
    state = sum(x.numel() * x.element_size() for x in tensors_of(start)) / 16
    kept = {}
    for checkpoint in (1, 10):
        seen: dict[int, int] = {}

        def note(x: Tensor) -> Tensor:
            seen[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()  # noqa: B023
            return x

        v = start.v.clone().requires_grad_()
        with torch.autograd.graph.saved_tensors_hooks(note, lambda x: x):
            path = simulator.trajectory(replaced(start, v=v), steps=20, checkpoint=checkpoint)
        kept[checkpoint] = sum(seen.values()) / 20 / 16
        assert path.q.requires_grad
    assert kept[1] <= 1.1 * state
    assert kept[10] <= 0.2 * state


def test_kept_factors_give_the_same() -> None:
    """Factors that are kept serve further derivatives of the same trajectory, to the bit."""
    setup = SCENES["chain-slope-drop"]()
    found = []
    for keep in (False, True):
        simulator = Simulator(setup.scene, 0.05, SMOOTH["implicit-euler"](), gradients=Gradients(keep_factors=keep))
        v = setup.v.clone().requires_grad_()
        path = simulator.trajectory(simulator.initial_state(setup.q, v), steps=4)
        found += [torch.autograd.grad(path.q[-1, 0, k], v, retain_graph=True)[0] for k in (0, 2, 0)]
    assert torch.equal(found[0], found[2])
    assert all(torch.equal(a, b) for a, b in zip(found[:3], found[3:], strict=True))


# Special points -------------------------------------------------------------------------------------------------------


def one_sided(function: Callable[[float], float], h: float = 1e-6) -> tuple[float, float]:
    """Differences to the right and to the left, of second order."""
    right = (-3 * function(0) + 4 * function(h) - function(2 * h)) / (2 * h)
    left = (3 * function(0) - 4 * function(-h) + function(-2 * h)) / (2 * h)
    return right, left


@pytest.mark.parametrize("point", ["at rest in contact", "just touching", "no slip", "joint at its limit", "no rotation"])
def test_special_points(point: str) -> None:
    """At v = 0 in contact, at depth 0, slip 0, a joint at its limit and the identity rotation: finite, and equal to a one-sided
    difference to 1e-4."""
    scene = free_bodies((Sphere(0.1),), (1.0,))
    depth = math.sqrt(GRAVITY / 1e8)
    heights = {"just touching": 0.1, "no rotation": 0.5}
    coordinate = {"at rest in contact": 2, "just touching": 2, "no slip": 0, "no rotation": 4}.get(point, 0)
    if point == "joint at its limit":
        joint = Joint("hinge", JointKind.HINGE, axis=(0.0, 1.0, 0.0), lower=0.0, upper=1.0)
        links = [Link("arm", joints=(joint,), mass=1.0, com=(0.2, 0.0, 0.0), inertia=diagonal(0.01, 0.01, 0.01))]
        a = Articulation.from_links(links)
        scene = Scene(a, (Inertia(), JointLimits.for_articulation(a)), torch.tensor([0.0, 0.0, GRAVITY], dtype=torch.float64))
        q = torch.zeros(1, 1, dtype=torch.float64)
    else:
        q = posed((0.0, 0.0, heights.get(point, 0.1 - depth)))
    nv = scene.articulation.nv

    def end(v: Tensor) -> Tensor:
        simulator = Simulator(scene, 0.01, solver=PRECISE)
        path = simulator.trajectory(simulator.initial_state(q, v), steps=2)
        return difference(scene.articulation, q, path.q[-1]).sum()

    v = torch.zeros(1, nv, dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(end(v), v)
    unit = torch.eye(nv, dtype=torch.float64)[coordinate][None]
    sides = one_sided(lambda h: float(end(h * unit)))
    assert bool(torch.isfinite(found).all())
    assert min(abs(float(found[0, coordinate]) - side) for side in sides) <= 1e-4 * max(1e-2, *map(abs, sides))
