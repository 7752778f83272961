"""Steps that are cut where something strikes: when that is, what is kept through it, and derivatives that know of it."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from pbfd_torch import EnergyMomentum, EventSimulator, Scene, Simulator
from pbfd_torch.contact.shapes import Box, Shape, Sphere
from pbfd_torch.errors import GradientError, InputError
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Engine, Native, Torch
from pbfd_torch.solvers.objective import Status
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.restitution import Restitution
from tests.touching_bodies import free_bodies, posed

BALL = Sphere(0.1)
FIRM = NormalForce(1e12)  # what an elastic contact gives way is lost to the rebound
ENGINES = pytest.mark.parametrize("engine", [Torch(), Native()], ids=lambda x: x.name)
GRAVITY, HEIGHT = 9.81, 0.5
FALL = math.sqrt(2 * HEIGHT / GRAVITY)  # [s]


def placed(height: float) -> Tensor:
    """A ball's centre there."""
    return posed((0, 0, height))


def bouncing(restitution: float | None, shape: Shape = BALL) -> Scene:
    """A body of 1 kg and .1 m, a ball, above the ground."""
    scene = free_bodies((shape,), (1.0,), mu=0.0)
    law = None if restitution is None else Restitution(restitution)
    terms = [replaced(x, restitution=law, normal_force=FIRM) if isinstance(x, Contact) else x for x in scene.terms]
    return replaced(scene, terms=tuple(terms))


def two_balls(restitution: float | None) -> Scene:
    """Of 1 kg and .1 m, weightless."""
    scene = free_bodies((Sphere(0.1), Sphere(0.1)), (1.0, 1.0), (), mu=0.0, gravity=torch.zeros(3, dtype=torch.float64))
    law = None if restitution is None else Restitution(restitution)
    terms = [replaced(x, restitution=law, normal_force=FIRM) if isinstance(x, BodyContact) else x for x in scene.terms]
    return replaced(scene, terms=tuple(terms))


def collided(start: Tensor, restitution: float | None, dt: float = 0.01) -> Tensor:
    """Where the second of two balls is 1 s after the first, at x1 with v0, has set out to hit it, at x2 with u0. start: x1, x2, v0,
    u0, `[m, 4]` → `[m]`."""
    simulator = EventSimulator(two_balls(restitution), dt)
    x = torch.eye(14, dtype=torch.float64)
    q = posed((0, 0, 0), (0, 0, 0)) + start[:, :1] * x[0] + start[:, 1:2] * x[7]
    v = start[:, 2:3] * x[0, :12] + start[:, 3:] * x[6, :12]
    path = simulator.trajectory(simulator.initial_state(q, v), steps=round(1 / dt))
    assert bool(path.solved.all())
    return path.q[-1, :, 7]


# When it is -------------------------------------------------------------------------------------------------------------------


@ENGINES
@pytest.mark.parametrize("shape", [BALL, Box((0.1, 0.1, 0.1))], ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("restitution", [None, 1.0])
@pytest.mark.parametrize("dt", [0.05, 0.02, 0.007])
def test_a_body_that_falls(engine: Engine, shape: Shape, restitution: float | None, dt: float) -> None:
    """A ball, or a box with four corners at once, from .5 m: it strikes after √(2h/g), to 1e-6 s, whatever the step; until then its
    energy is exact, and then it keeps all of it or none: what the contact gives way is a share of 1e-3."""
    simulator = EventSimulator(bouncing(restitution, shape), dt, engine=engine)
    assert simulator.engine == engine.name
    state = simulator.initial_state(placed(0.1 + HEIGHT))
    energy: list[float] = []
    for k in range(math.ceil(FALL / dt) + 2):
        state, solution = simulator.step(state)
        assert bool(solution.solved.all())
        strike = solution.strike
        assert strike is not None
        if float(strike) < 1 and not energy:
            assert (k + float(strike)) * dt == pytest.approx(FALL, abs=1e-6)
            assert solution.steps is not None
            assert int(solution.steps) == 2
            energy.append(0.0)
        v = float(simulator.integrator.velocity(simulator.articulation, state, simulator.step_size)[0, 2])
        found = 0.5 * v * v + GRAVITY * (float(state.q[0, 2]) - 0.1)
        if not energy:
            assert found == pytest.approx(GRAVITY * HEIGHT, rel=1e-9)
        else:
            energy.append(found)
    kept = GRAVITY * HEIGHT if restitution else 0.0
    assert energy[-1] == pytest.approx(kept, abs=1e-3 * GRAVITY * HEIGHT)


def test_several_worlds_strike_at_their_own_time() -> None:
    """In a batch as alone, to the bit; a world that nothing strikes makes a whole step."""
    simulator = EventSimulator(bouncing(1.0), 0.02)
    q = torch.cat([placed(0.1 + 1e-3 * k) for k in (1.0, 1.5, 40.0)])
    state, solution = simulator.step(simulator.initial_state(q))
    assert solution.steps is not None
    assert solution.steps.tolist() == [2, 2, 1]
    for k in range(3):
        alone, _ = simulator.step(simulator.initial_state(q[k : k + 1]))
        assert torch.equal(alone.q[0], state.q[k])
        assert torch.equal(alone.v[0], state.v[k])


@ENGINES
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_any_batch(engine: Engine, batch: tuple[int, ...]) -> None:
    """A single world without batch, and batches of more dimensions: as a batch of one, derivatives too."""
    simulator = EventSimulator(bouncing(1.0), 0.02, engine=engine)

    def stepped(shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        q = placed(0.1 + 1e-3)[0].expand(*shape, 7).clone().requires_grad_()
        state, solution = simulator.step(simulator.initial_state(q))
        assert solution.steps is not None
        assert solution.steps.shape == shape
        assert bool((solution.steps == 2).all())
        (by_q,) = torch.autograd.grad(state.q.sum(), q)
        return state.q.detach(), by_q

    for found, expected in zip(stepped(batch), stepped((1,)), strict=True):
        assert found.shape == (*batch, 7)
        torch.testing.assert_close(found, expected[0].expand(*batch, 7), rtol=1e-12, atol=1e-12)


def test_engines_agree() -> None:
    """On a chain up to its first strike and through it, with as many parts."""
    setup = SCENES["chain-ground"]()
    ends = []
    for engine in (Native(), Torch()):
        simulator = EventSimulator(setup.scene, 0.02, engine=engine)
        state, parts = simulator.initial_state(setup.q, setup.v), []
        for _ in range(16):
            state, solution = simulator.step(state)
            assert solution.steps is not None
            parts.append(int(solution.steps))
        ends.append((state, parts))
    assert ends[0][1] == ends[1][1]
    assert ends[0][1] == [1] * 15 + [2]
    assert float((ends[0][0].q - ends[1][0].q).abs().max()) < 1e-9


def test_a_rollout_is_made_of_these_steps() -> None:
    """And its record is theirs."""
    simulator = EventSimulator(bouncing(1.0), 0.05)
    state = simulator.initial_state(placed(0.1 + HEIGHT))
    rollout = simulator.rollout(state, steps=9)
    for k in range(9):
        state, _ = simulator.step(state)
        assert torch.equal(rollout.q[k + 1], state.q)


def test_what_bounces_within_a_step_goes_on() -> None:
    """A ball that strikes more often than a step may be cut is stepped all the same."""
    simulator = EventSimulator(bouncing(0.5), 0.1)
    state = simulator.initial_state(placed(0.1 + 0.02))
    for _ in range(20):
        state, solution = simulator.step(state)
        assert bool(solution.solved.all())
    assert float(state.q[0, 2]) == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("made", [lambda s: s.linearize(None), lambda s: s.trajectory(None, steps=3, checkpoint=2)])
def test_what_it_does_not_do_is_refused(made: Any) -> None:
    with pytest.raises(InputError, match=r"does not linearise|checkpoint is 2"):
        made(EventSimulator(bouncing(1.0), 0.01))


def test_an_integrator_without_explicit_steps_is_refused() -> None:
    with pytest.raises(InputError, match=r"EnergyMomentum: .* such as RungeKutta"):
        EventSimulator(bouncing(1.0), 0.01, EnergyMomentum())


# Derivatives ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("x2", [0.503, 0.507])
def test_two_equal_balls(x2: float) -> None:
    """Where the second of two elastic balls ends, Δt .01: by (x1, x2, v0, u0) the derivatives are (1, 0, T, 0), to 1 %, wherever in
    its step the impact is; and those of central differences."""
    start = torch.tensor([[0.0, x2, 1.0, 0.0]], dtype=torch.float64)
    given = start.clone().requires_grad_()
    end = collided(given, 1.0)
    assert float(end.detach()) == pytest.approx(1.2, abs=1e-4)
    (found,) = torch.autograd.grad(end.sum(), given)
    torch.testing.assert_close(found[0], torch.tensor([1.0, 0.0, 1.0, 0.0], dtype=torch.float64), rtol=0, atol=0.01)
    steps = 1e-4 * torch.eye(4, dtype=torch.float64)
    around = collided(torch.cat((start + steps, start - steps)), 1.0)
    torch.testing.assert_close(found[0], (around[:4] - around[4:]) / 2e-4, rtol=0, atol=1e-4)


def rebound(height: Tensor, push: Tensor, dt: float) -> Tensor:
    """How fast a ball from that height, thrown down at a speed, is .05 s after .35 s, `[m]`; they carry derivatives."""
    simulator = EventSimulator(bouncing(0.8), dt)
    q = placed(0.1) + height[:, None] * torch.eye(7, dtype=torch.float64)[2]
    v = -push[:, None] * torch.eye(6, dtype=torch.float64)[2]
    state = simulator.initial_state(q, v)
    for _ in range(round(0.4 / dt)):
        state, _ = simulator.step(state)
    return simulator.integrator.velocity(simulator.articulation, state, simulator.step_size)[:, 2]


def test_by_central_differences() -> None:
    """Through an impact within its step, to 1e-6, and near those of free fall and Newton's law: v = e √(u² + 2gh) − g (T − t*)."""
    height, push = (torch.tensor([x], dtype=torch.float64, requires_grad=True) for x in (0.45, 0.3))
    found = torch.autograd.grad(rebound(height, push, 0.02).sum(), (height, push))
    h = 1e-3
    for k, by in enumerate(found):
        ends = [rebound(height.detach() + s * h * (k == 0), push.detach() + s * h * (k == 1), 0.02) for s in (1, -1)]
        assert float(by) == pytest.approx(float((ends[0] - ends[1]) / (2 * h)), rel=1e-6, abs=1e-6)
    u, tall = 0.3, 0.45
    fast = math.sqrt(u * u + 2 * GRAVITY * tall)
    # t* = (fast − u)/g, so v = e fast − g T + fast − u
    assert float(found[0]) == pytest.approx(1.8 * GRAVITY / fast, rel=5e-3)
    assert float(found[1]) == pytest.approx(1.8 * u / fast - 1, rel=5e-3)


def test_forward_derivatives() -> None:
    """Are those of reverse mode; torch.func, which cannot have them, is told so."""
    height, push = (torch.tensor([x], dtype=torch.float64) for x in (0.45, 0.3))
    given = height.clone().requires_grad_()
    (expected,) = torch.autograd.grad(rebound(given, push, 0.02).sum(), given)
    with forward_ad.dual_level():
        moved = rebound(forward_ad.make_dual(height, torch.ones_like(height)), push, 0.02)
        torch.testing.assert_close(forward_ad.unpack_dual(moved).tangent, expected, rtol=1e-7, atol=0)
    simulator = EventSimulator(bouncing(1.0), 0.02)
    state = simulator.initial_state(placed(0.2))
    with pytest.raises(GradientError, match=r"torch\.func cannot look into"):
        torch.func.jvp(lambda q: simulator.step(replaced(state, q=q))[0].q, (state.q,), (torch.ones_like(state.q),))


def test_values_are_the_same_to_the_bit() -> None:
    """With derivatives and without."""
    start = torch.tensor([[0.0, 0.505, 1.0, 0.0]], dtype=torch.float64)
    plain = collided(start, 1.0, 0.05)
    carrying = collided(start.clone().requires_grad_(), 1.0, 0.05)
    assert torch.equal(plain, carrying.detach())


def test_nothing_strikes() -> None:
    """Then its steps are those of a `Simulator`, and so are their derivatives."""
    setup = SCENES["chain-free"]()
    found = []
    for make in (EventSimulator, Simulator):
        v = setup.v.clone().requires_grad_()
        simulator = make(setup.scene, 0.01, EventSimulator(setup.scene, 0.01).integrator)
        path = simulator.trajectory(simulator.initial_state(setup.q, v), steps=3)
        assert bool((path.status == int(Status.EXPLICIT)).all())
        found.append((path.q.detach(), *torch.autograd.grad(path.q[-1].sum(), v)))
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)
