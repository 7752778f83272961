"""Derivatives of whole rollouts: closed forms, hard cases, checkpoints, memory, and what has no derivative."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from pbfd_torch import Simulator
from pbfd_torch.contact.shapes import Sphere
from pbfd_torch.errors import GradientError, GradientWarning, InputError
from pbfd_torch.gradients.implicit import Blur, Doubt, Doubtful, Gradients
from pbfd_torch.gradients.linearization import Chart
from pbfd_torch.gradients.linked import Linked, Made, Step, doubts_of
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.integrators.integrator import State
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES
from pbfd_torch.scene import Scene
from pbfd_torch.schedules.adaptive import AdaptiveSimulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.objective import Status
from pbfd_torch.tensors.structures import in_dtype, mapped_tensors, tensors_of
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import difference
from tests.bodies import diagonal
from tests.finite_differences import derivative
from tests.gradient_checks import precise_solver
from tests.random_trees import generator
from tests.touching_bodies import free_bodies, posed

GRAVITY = 9.81
all_integrators = pytest.mark.parametrize("name", INTEGRATORS)


def number(value: float) -> Tensor:
    """A float64 scalar."""
    return torch.tensor(value, dtype=torch.float64)


def along(function: Callable[[Tensor], Tensor], largest: float) -> Tensor:
    """Central differences of a function of numbers `[m]` → `[m]` at 0, extrapolated."""
    with torch.no_grad():
        return derivative(lambda t: function(t.squeeze(-1)), 1, (), largest, levels=7).squeeze(-1)


# Closed forms ---------------------------------------------------------------------------------------------------------


def stopped(v0: Tensor, mu: Tensor, dt: float = 0.01, seconds: float = 0.5) -> Tensor:
    """How far the box slides from v0 `[m]` with μ `[m]`."""
    setup = SCENES["box-slide"](worlds=len(v0))
    scene = with_parameters(setup.scene, {"terms.1.friction.mu": mu[:, None]})
    simulator = Simulator(scene, dt, solver=precise_solver())
    v = torch.cat((v0[:, None], setup.v[:, 1:]), -1)
    path = simulator.trajectory(simulator.initial_state(setup.q, v), steps=round(seconds / dt))
    assert bool(path.solved.all())
    return path.q[-1, :, 0] - path.q[0, :, 0]


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
    simulator = Simulator(replaced(scene, terms=tuple(terms)), dt, solver=precise_solver())
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
    for k, direction in enumerate(torch.eye(4, dtype=torch.float64)):
        expected = along(lambda t: collided(start + t[:, None] * direction, law, restitution, dt), 1e-4)  # noqa: B023
        assert float(found[0, k]) == pytest.approx(float(expected), abs=1e-5)
    torch.testing.assert_close(found[0], torch.tensor(near, dtype=torch.float64), rtol=0, atol=most)


def test_long_horizon() -> None:
    """A thousand steps of a spinning body that touches nothing: the derivative of where it ends by its velocity grows with time as
    it should, linearly along the motion, and stays below a hundred times that."""
    setup = SCENES["dzhanibekov"]()
    simulator = Simulator(setup.scene, 0.01, INTEGRATORS["variational"]())
    v = setup.v.clone().requires_grad_()
    path = simulator.trajectory(simulator.initial_state(setup.q, v), steps=1000)
    (by_v,) = torch.autograd.grad(path.q[-1, 0, :3].sum(), v)
    seconds = 10.0
    assert bool(torch.isfinite(by_v).all())
    assert float(by_v[0, :3].mean()) == pytest.approx(seconds, rel=1e-6)
    assert float(by_v.norm()) <= 100 * seconds


# A hopper under control -----------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Hop:
    """A hopper that lands and pushes off: float64, and what the end of its motion comes to."""

    simulator: Simulator[Any]
    start: State
    controls: Tensor
    weights: Tensor

    def worth(self, end: State, simulator: Simulator[Any]) -> Tensor:
        """A number `[*batch]` of a last state."""
        v = simulator.integrator.velocity(simulator.articulation, end, simulator.step_size)
        return ((end.q + 0.1 * v) * self.weights.to(end.q.dtype)).sum(-1)

    def reward(self, controls: Tensor) -> Tensor:
        """What controls `[steps, m, nu]` come to, `[m]`."""
        many = controls.shape[1]
        wide = mapped_tensors(self.start, lambda x: x.expand(many, *x.shape[1:]).contiguous())
        path = self.simulator.trajectory(wide, controls)
        assert bool(path.solved.all())
        return self.worth(path.end, self.simulator)


@pytest.fixture(scope="module")
def hop() -> Hop:
    """32 steps of 8 ms from .16 s after a hopper was let go."""
    setup = SCENES["hopper"]()
    simulator = Simulator(setup.scene, 0.008, solver=precise_solver())
    start = simulator.initial_state(setup.q, setup.v)
    for _ in range(20):
        start, _ = simulator.step(start)
    random = generator(3)
    controls = 0.4 * torch.randn(32, 1, setup.scene.nu, dtype=torch.float64, generator=random)
    return Hop(simulator, start, controls, torch.randn(setup.scene.articulation.nv, dtype=torch.float64, generator=random))


def by_controls(hop: Hop) -> Tensor:
    """The exact derivative by all controls."""
    given = hop.controls.clone().requires_grad_()
    return torch.autograd.grad(hop.reward(given).sum(), given)[0]


def test_hopper_by_all_actions(hop: Hop) -> None:
    """32 steps with contact: by all 96 actions, each on its own, within 1e-6 of central differences, relative to the largest."""
    size = hop.controls.numel()
    steps = 1e-5 * torch.eye(size, dtype=torch.float64)
    probes = torch.cat((steps, -steps, 2 * steps, -2 * steps)).reshape(4 * size, len(hop.controls), -1).movedim(0, 1)
    with torch.no_grad():
        up, down, further_up, further_down = hop.reward(hop.controls + probes).reshape(4, size)
    expected = ((8 * (up - down) - (further_up - further_down)) / 12e-5).reshape(hop.controls.shape)
    assert float((by_controls(hop) - expected).abs().max()) <= 1e-6 * float(expected.abs().max())


def test_hopper_in_float32(hop: Hop) -> None:
    """Along the same motion, rounded to float32, the derivative of all 32 steps in a row is within 1e-4 of that in float64. (Two
    simulations in the two types do not stay together: stiff friction amplifies what is rounded.)"""
    simulator = Simulator(SCENES["hopper"](dtype=torch.float32).scene, 0.008)
    states, made = [hop.start], []
    for control in hop.controls:
        end, solution, _, way = hop.simulator.made(states[-1], control)
        states.append(end)
        made.append(Made(solution, in_dtype(way, torch.float32), doubts_of(solution.status)))
    states = in_dtype(states, torch.float32)
    found: list[Tensor] = []

    last, leaves = alive(states[-1])
    cotangents = list(torch.autograd.grad(hop.worth(last, simulator).sum(), leaves, allow_unused=True, materialize_grads=True))
    for state, control, step in zip(reversed(states[:-1]), reversed(hop.controls.float()), reversed(made), strict=True):
        begin, leaves = alive(state)
        u = control.clone().requires_grad_()
        end = retraced(simulator, begin, u, step)
        ends = [x for x in tensors_of(end) if x.is_floating_point()]
        pairs = [(x, c) for x, c in zip(ends, cotangents, strict=True) if x.requires_grad]
        given = (*leaves, u)
        *cotangents, by_u = torch.autograd.grad(
            [x for x, _ in pairs], given, [c for _, c in pairs], allow_unused=True, materialize_grads=True
        )
        found.append(by_u)
    expected = by_controls(hop)
    assert float((torch.stack(found[::-1]).double() - expected).abs().max()) <= 1e-4 * float(expected.abs().max())


def alive(state: State) -> tuple[State, list[Tensor]]:
    """The state with leaves of a graph as its numbers, and these."""
    leaves = [x.detach().clone().requires_grad_(x.is_floating_point()) for x in tensors_of(state)]
    order = iter(leaves)
    return mapped_tensors(state, lambda _: next(order)), [x for x in leaves if x.requires_grad]


def retraced(simulator: Simulator[Any], state: State, control: Tensor, made: Made) -> Any:
    """The end of a step that is known, as a function of its state and control."""
    play = Step(Linked(simulator), state, control)
    play.made = made
    return play.again(simulator, state, control)


# The same values, whatever is asked of them ---------------------------------------------------------------------------


@all_integrators
def test_values_are_the_same_to_the_bit(name: str) -> None:
    """With and without derivatives: a chain that lands on a slope, eased and halved steps among its own, by its start, its masses
    and its friction, with checkpoints and without."""
    setup = SCENES["chain-slope-drop"](worlds=2)
    v = setup.v + torch.tensor([[0.0], [0.3]], dtype=torch.float64)
    plain = Simulator(setup.scene, 0.05, INTEGRATORS[name]())
    expected = plain.trajectory(plain.initial_state(setup.q, v), steps=9)
    names = ("articulation.pseudo_inertia", "terms.1.friction.mu")
    values = {n: x.clone().requires_grad_() for n, x in parameters(setup.scene).items() if n in names}
    simulator = Simulator(with_parameters(setup.scene, values), 0.05, INTEGRATORS[name]())
    gradients = []
    for checkpoint in (1, 4):
        given = v.clone().requires_grad_()
        path = simulator.trajectory(simulator.initial_state(setup.q, given), steps=9, checkpoint=checkpoint)
        assert torch.equal(path.q, expected.q)
        assert torch.equal(path.v, expected.v)
        assert torch.equal(path.status, expected.status)
        gradients.append(torch.autograd.grad((path.q[-1] ** 2).sum() + path.v[3].sum(), (given, *values.values())))
    for once, again in zip(*gradients, strict=True):
        torch.testing.assert_close(once, again, rtol=1e-12, atol=1e-12 * float(once.abs().max()))
    record = simulator.rollout(simulator.initial_state(setup.q, v), steps=9)
    assert torch.equal(record.q, expected.q)


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
        simulator = Simulator(scene, 0.05, INTEGRATORS[name]())
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
    simulator = Simulator(setup.scene, 0.02)
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


# What has no derivative -----------------------------------------------------------------------------------------------


def stuck(policy: Doubtful) -> tuple[Any, Tensor]:
    """Two steps of two worlds that land, the second of which a solver of few evaluations does not solve."""
    setup = SCENES["chain-slope-drop"](worlds=2)
    q = setup.q.clone()
    q[0, 2] += 5.0  # the first one is still in free fall
    simulator = Simulator(
        setup.scene, 0.05, INTEGRATORS["implicit-euler"](), Descent(max_evaluations=2), halvings=0, gradients=Gradients(policy)
    )
    v = setup.v.clone().requires_grad_()
    return simulator.trajectory(simulator.initial_state(q, v), steps=6), v


def test_unsolved_steps_are_not_differentiated_silently() -> None:
    """They raise, with where and how many; or warn; or give zero, the other world's derivative being untouched; always flagged."""
    path, v = stuck(Doubtful.RAISE)
    assert path.solved[:, 0].all()
    assert not path.solved[:, 1].all()
    assert torch.equal((path.doubts & int(Doubt.UNSOLVED)) > 0, ~path.solved)
    with pytest.raises(GradientError, match=r"unsolved in 1 of 2 worlds.*Doubtful\.WARN or ZERO"):
        path.q[-1].sum().backward()
    path, v = stuck(Doubtful.WARN)
    with pytest.warns(GradientWarning, match="unsolved in 1 of 2 worlds"):
        path.q[-1].sum().backward()
    assert v.grad is not None
    warned = v.grad
    path, v = stuck(Doubtful.ZERO)
    path.q[-1].sum().backward()
    assert v.grad is not None
    torch.testing.assert_close(v.grad[0], warned[0], rtol=1e-12, atol=0)
    assert not v.grad[1].any()


def standing(policy: Doubtful) -> tuple[Simulator[Any], Tensor]:
    """A pendulum that stands on its head at Δt = √(I/(m g l)), where J = I/Δt² − m g l vanishes."""
    mass, length, inertia = 1.0, 0.5, 0.02
    joint = Joint("hinge", JointKind.HINGE, axis=(0.0, 1.0, 0.0))
    a = Articulation.from_links(
        [Link("rod", joints=(joint,), mass=mass, com=(0.0, 0.0, length), inertia=diagonal(inertia, inertia, inertia))]
    )
    scene = Scene(a, (Inertia(),), torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64))
    dt = math.sqrt((inertia + mass * length**2) / (mass * GRAVITY * length))
    simulator = Simulator(scene, dt, INTEGRATORS["implicit-euler"](), gradients=Gradients(policy))
    return simulator, torch.zeros(1, 1, dtype=torch.float64)


def test_singular_steps_are_damped_and_reported() -> None:
    """At a fold J has no inverse: the derivative is damped, finite, flagged and reported as the policy says."""
    for policy in Doubtful:
        simulator, zero = standing(policy)
        start = simulator.initial_state(zero, zero)
        q = start.q.clone().requires_grad_()
        path = simulator.trajectory(replaced(start, q=q), steps=1)
        assert bool(path.solved.all())
        if policy is Doubtful.RAISE:
            with pytest.raises(GradientError, match="singular in 1 of 1 worlds"):
                path.q[-1].sum().backward()
        elif policy is Doubtful.WARN:
            with pytest.warns(GradientWarning, match="singular in 1 of 1 worlds"):
                path.q[-1].sum().backward()
            assert q.grad is not None
            assert bool(torch.isfinite(q.grad).all())
        else:
            path.q[-1].sum().backward()
            assert q.grad is not None
            assert float(q.grad) == 0
        assert bool((path.doubts & int(Doubt.SINGULAR)).all())


def test_other_ways_are_flagged() -> None:
    """Eased and halved steps have exact derivatives, and say so."""
    setup = SCENES["chain-slope-drop"]()
    simulator = Simulator(setup.scene, 0.1)
    path = simulator.trajectory(simulator.initial_state(setup.q, setup.v), steps=12)
    detour = (path.status == int(Status.EASED)) | (path.status == int(Status.HALVED))
    assert bool(detour.any())
    assert torch.equal((path.doubts & int(Doubt.DETOUR)) > 0, detour)


def test_no_second_derivatives() -> None:
    """Asked for a second derivative, a step raises instead of giving half of it."""
    v0 = torch.ones(1, dtype=torch.float64, requires_grad=True)
    distance = stopped(v0, torch.full((1,), 0.3, dtype=torch.float64), seconds=0.02).sum()
    with pytest.raises(GradientError, match="first derivatives only"):
        torch.autograd.grad(distance, v0, create_graph=True)


def test_adaptive_steps_refuse() -> None:
    """Steps of their own choice carry no derivatives: a message, not a wrong number."""
    setup = SCENES["chain-fixed"]()
    simulator = AdaptiveSimulator(setup.scene, 0.05, 1e-3)
    start = simulator.initial_state(setup.q, setup.v)
    with pytest.raises(InputError, match="carry no derivatives"):
        simulator.step(replaced(start, v=start.v.clone().requires_grad_()))
    with pytest.raises(InputError, match="has rollouts only"):
        simulator.trajectory(start, steps=2)


def test_blurred_contact_is_felt_from_afar() -> None:
    """A ball above the ground knows nothing of it; blurred derivatives do, values being the same. They are biased, and so say the
    docs."""
    scene = free_bodies((Sphere(0.1),), (1.0,))
    q, v = posed((0.0, 0.0, 0.105)), torch.zeros(1, 6, dtype=torch.float64)
    found, ends = [], []
    for gradients in (Gradients(), Gradients(blur=Blur(widening=10.0, distance=5e-3))):
        simulator = Simulator(scene, 0.01, gradients=gradients)
        given = q.clone().requires_grad_()
        path = simulator.trajectory(simulator.initial_state(given, v), steps=1)
        ends.append(path.q)
        found.append(float(torch.autograd.grad(path.q[-1, 0, 2], given)[0][0, 2]))
    assert torch.equal(ends[0], ends[1])
    assert found[0] == pytest.approx(1.0, abs=1e-12)
    assert 0 < found[1] < 0.9


@pytest.mark.parametrize(
    ("changes", "message"), [({"widening": 0.5}, "widening is 0.5"), ({"distance": -1.0}, "distance is -1.0 m")]
)
def test_bad_blurs(changes: dict[str, float], message: str) -> None:
    """Refused at construction."""
    with pytest.raises(InputError, match=message):
        Blur(**changes)


def test_kept_factors_give_the_same() -> None:
    """Factors that are kept serve further derivatives of the same trajectory, to the bit."""
    setup = SCENES["chain-slope-drop"]()
    found = []
    for keep in (False, True):
        simulator = Simulator(setup.scene, 0.05, INTEGRATORS["implicit-euler"](), gradients=Gradients(keep_factors=keep))
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
        simulator = Simulator(scene, 0.01, solver=precise_solver())
        path = simulator.trajectory(simulator.initial_state(q, v), steps=2)
        return difference(scene.articulation, q, path.q[-1]).sum()

    v = torch.zeros(1, nv, dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(end(v), v)
    unit = torch.eye(nv, dtype=torch.float64)[coordinate][None]
    sides = one_sided(lambda h: float(end(h * unit)))
    assert bool(torch.isfinite(found).all())
    assert min(abs(float(found[0, coordinate]) - side) for side in sides) <= 1e-4 * max(1e-2, *map(abs, sides))


# Linear systems -------------------------------------------------------------------------------------------------------


@all_integrators
def test_linearisation(name: str) -> None:
    """A and B of a hopper's steps predict perturbed steps, with an error that shrinks as h² until rounding, in every world."""
    setup = SCENES["hopper"](worlds=2)
    simulator = Simulator(setup.scene, 0.008, INTEGRATORS[name](), precise_solver())
    random = generator(2)
    state = simulator.initial_state(setup.q, setup.v)
    for _ in range(5):
        control = 0.3 * torch.randn(2, setup.scene.nu, dtype=torch.float64, generator=random)
        state, _ = simulator.step(state, control)
    system = simulator.linearize(state, control)
    before, after = Chart(simulator, state), Chart(simulator, system.end)
    assert system.A.shape == (2, after.size, before.size)
    assert system.B.shape == (2, after.size, setup.scene.nu)
    step = torch.randn(2, before.size, dtype=torch.float64, generator=random)
    for part, place in before.layout.items():
        if part != "v":
            step[:, place] *= 0.01
    du = torch.randn(2, setup.scene.nu, dtype=torch.float64, generator=random)
    expected = (system.A @ step[..., None] + system.B @ du[..., None]).squeeze(-1)

    def off(h: float) -> float:
        ends = [after.of(simulator.step(before.at(s * step), control + s * du)[0]) for s in (h, -h)]
        return float(((ends[0] - ends[1]) / (2 * h) - expected).abs().max() / expected.abs().max())

    assert off(1e-4) <= 1e-6
    assert off(2e-4) / off(1e-4) == pytest.approx(4, rel=0.2) or off(1e-4) <= 1e-9
