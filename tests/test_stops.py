"""Steps that are cut where sliding stops: where and when that is, derivatives that know of it, and what is left alone."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from pbfd_torch import EventSimulator, RungeKutta, Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.motion import Conveyor
from pbfd_torch.contact.shapes import Box, Sphere
from pbfd_torch.gradients.parameters import with_parameters
from pbfd_torch.models import SCENES, boxes
from pbfd_torch.native.engine import Engine, Native, Torch
from pbfd_torch.schedules import events
from pbfd_torch.schedules.stops import at_stop
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.normal_force import NormalForce
from tests.gradient_checks import PRECISE
from tests.random_trees import generator
from tests.touching_bodies import free_bodies, posed

GRAVITY, SPEED = boxes.GRAVITY, 1.0
SLOW = CoulombFriction(0.5).slip_speed  # [m/s]
FIRM = 1e12  # C⊥: as the slide ends the box of the named scene, 1e8, tilts back by a weight's depth of .16 mm, which is no error
MU = torch.tensor(boxes.SLIDING_FRICTION, dtype=torch.float64)
ENGINES = pytest.mark.parametrize("engine", [Torch(), Native()], ids=lambda x: x.name)
STEPS = pytest.mark.parametrize("dt", [0.05, 0.02, 0.01])


def firm(scene: Scene) -> Scene:
    """With stiffer contacts."""
    terms = [replaced(x, normal_force=NormalForce(FIRM)) if isinstance(x, Contact) else x for x in scene.terms]
    return replaced(scene, terms=tuple(terms))


def slid(make: Any, speed: Tensor, mu: Tensor, dt: float, engine: Engine | None = None) -> tuple[Tensor, list[list[int]]]:
    """How far the box has gone by 1.2 s, for speeds and μ `[m]` each, and the parts of every step."""
    setup = SCENES["box-slide"](worlds=len(mu))
    scene = with_parameters(firm(setup.scene), {"terms.1.friction.mu": mu[:, None]})
    lift = math.sqrt(GRAVITY / 4 / boxes.STIFFNESS) - math.sqrt(GRAVITY / 4 / FIRM)
    q = setup.q + lift * torch.eye(7, dtype=torch.float64)[2]
    # what depends on the energy gained so far would jump within the differences
    simulator = make(scene, dt, RungeKutta(surplus=math.inf), PRECISE, engine=engine)
    state = simulator.initial_state(q, torch.cat((speed[:, None], setup.v[:, 1:]), -1))
    parts = []
    for _ in range(round(1.2 / dt)):
        state, solution = simulator.step(state)
        assert bool(solution.solved.all())
        parts.append([1] * len(mu) if solution.steps is None else solution.steps.tolist())
    return state.q[:, 0] - q[:, 0], parts


def derived(make: Any, dt: float) -> tuple[Tensor, Tensor]:
    """The derivatives of the distances by speed and μ, relative to those of Coulomb's law, v/(μg) and −v²/(2μ²g), less 1."""
    speed, mu = torch.full_like(MU, SPEED).requires_grad_(), MU.clone().requires_grad_()
    by_speed, by_mu = torch.autograd.grad(slid(make, speed, mu, dt)[0].sum(), (speed, mu))
    return by_speed * MU * GRAVITY / SPEED - 1, -by_mu * 2 * MU**2 * GRAVITY / SPEED**2 - 1


# Where and when ---------------------------------------------------------------------------------------------------------------


@ENGINES
@STEPS
def test_coulombs_law(engine: Engine, dt: float) -> None:
    """A box slides v²/(2μg), to what friction that fades below the slip speed leaves open: 3 μm, whatever the step, which is cut
    once, where it should stop. Without the cut the worst is at least five times as far off, 2 mm at Δt .05."""
    speed = torch.full_like(MU, SPEED)
    exact = SPEED**2 / (2 * MU * GRAVITY)
    found, parts = slid(EventSimulator, speed, MU, dt, engine)
    for k, mu in enumerate(boxes.SLIDING_FRICTION):
        cut = [n for n, all_worlds in enumerate(parts) if all_worlds[k] > 1]
        assert cut == [int((SPEED - 2 * SLOW) / (mu * GRAVITY) / dt)]
        assert parts[cut[0]][k] == 2
    off, plain = ((x - exact).abs().max() for x in (found, slid(Simulator, speed, MU, dt, engine)[0]))
    assert float(off) < 3e-6
    assert float(off) < 0.2 * float(plain)


@pytest.mark.parametrize("dt", [0.05, 0.01])
def test_the_instant(dt: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """2 ε_v is left after (v − 2 ε_v)/(μg), to 1e-5 s, whatever the step."""
    seen: list[float] = []

    def noted(*given: Any) -> Any:
        found = at_stop(*given)
        seen.extend((given[2][0].time + found[0]).tolist())
        return found

    monkeypatch.setattr(events, "at_stop", noted)
    slid(EventSimulator, torch.full_like(MU, SPEED), MU, dt)
    assert sorted(seen, reverse=True) == pytest.approx(((SPEED - 2 * SLOW) / (MU * GRAVITY)).tolist(), abs=1e-5)


def test_several_worlds_stop_at_their_own_time() -> None:
    """In a batch as alone, to the bit."""
    setup = SCENES["box-slide"]()
    simulator = EventSimulator(setup.scene, 0.05)
    state, ends = simulator.initial_state(setup.q, setup.v), []
    for _ in range(24):
        state, _ = simulator.step(state)
        ends.append(state)
    for k in (0, 2, 4):
        alone = EventSimulator(with_parameters(setup.scene, {"terms.1.friction.mu": MU[k : k + 1, None]}), 0.05)
        state = alone.initial_state(setup.q[k : k + 1], setup.v[k : k + 1])
        for end in ends:
            state, _ = alone.step(state)
            assert torch.equal(state.q[0], end.q[k])
            assert torch.equal(state.v[0], end.v[k])


def test_a_single_world_without_batch() -> None:
    """As a batch of one."""
    setup = SCENES["box-slide"](worlds=1)
    found = []
    for q, v in ((setup.q, setup.v), (setup.q[0], setup.v[0])):
        scene = with_parameters(setup.scene, {"terms.1.friction.mu": torch.tensor([0.5], dtype=torch.float64)})
        simulator = EventSimulator(scene, 0.05)
        state = simulator.initial_state(q, v)
        for _ in range(5):
            state, solution = simulator.step(state)
        assert solution.steps is not None
        assert solution.steps.reshape(-1).tolist() == [2]
        found.append(state.q.reshape(-1))
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-12)


def test_engines_agree() -> None:
    ends = [slid(EventSimulator, torch.full_like(MU, SPEED), MU, 0.02, engine)[0] for engine in (Native(), Torch())]
    assert float((ends[0] - ends[1]).abs().max()) < 1e-10


def test_on_a_belt() -> None:
    """A box that is laid on a belt of 1 m/s slides until it moves with it, .5 m/s²·t²: μg t = 1 m/s; it is 1/(2μg) behind."""
    belt = HalfSpace(motion=Conveyor((1.0, 0.0, 0.0)))
    scene = firm(free_bodies((Box((0.1, 0.1, 0.01)),), (1.0,), (belt,), mu=0.4))
    simulator = EventSimulator(scene, 0.05)
    state, parts = simulator.initial_state(posed((0, 0, 0.01 - 1e-6))), 0
    for _ in range(20):
        state, solution = simulator.step(state)
        assert solution.steps is not None
        parts += int(solution.steps)
    assert parts == 21
    assert float(state.q[0, 0]) == pytest.approx(1.0 - 0.5 / (0.4 * GRAVITY), abs=2e-4)


def test_body_on_body() -> None:
    """A small box slides along a long one that lies on the ground without friction: it stops against that one after
    v (M/(m + M))/(μg), and both go on together at v m/(m + M); bodies touch at other candidates every step."""
    scene = firm(free_bodies((Box((0.5, 0.1, 0.05)), Box((0.05, 0.05, 0.05))), (1.0, 1.0), mu=0.4))
    terms = [replaced(x, friction=None) if isinstance(x, Contact) else x for x in scene.terms]
    simulator = EventSimulator(replaced(scene, terms=tuple(terms)), 0.02)
    v = torch.zeros(1, 12, dtype=torch.float64)
    v[0, 6] = 1.0
    state = simulator.initial_state(posed((0, 0, 0.05), (-0.3, 0, 0.15)), v)
    cuts = []
    for k in range(10):
        state, solution = simulator.step(state)
        assert solution.steps is not None
        cuts += [k] * (int(solution.steps) - 1)
    assert cuts
    assert set(cuts) == {int(0.5 / (0.4 * GRAVITY) / 0.02)}
    velocity = simulator.integrator.velocity(simulator.articulation, state, simulator.step_size)
    assert velocity[0, [0, 6]].tolist() == pytest.approx([0.5, 0.5], abs=5e-3)


# Derivatives ------------------------------------------------------------------------------------------------------------------


@STEPS
def test_derivatives_are_those_of_coulombs_law(dt: float) -> None:
    """By speed and μ: to 4 slip speeds over the speed, and twice that by μ, which has the square of the speed; without the cut at
    least ten times as far off."""
    found = derived(EventSimulator, dt)
    plain = derived(Simulator, dt)
    for one, other, size in zip(found, plain, (1, 2), strict=True):
        assert float(one.abs().max()) < size * 4 * SLOW / SPEED
        assert float(one.abs().max()) < 0.1 * float(other.abs().max())


@pytest.mark.parametrize("dt", [0.05, 0.02])
def test_by_central_differences(dt: float) -> None:
    """Of the same simulation, to 1e-6."""
    speed, mu = torch.full_like(MU, SPEED).requires_grad_(), MU.clone().requires_grad_()
    found = torch.autograd.grad(slid(EventSimulator, speed, mu, dt)[0].sum(), (speed, mu))
    h = 1e-5
    for k, by in enumerate(found):
        with torch.no_grad():
            ends = [slid(EventSimulator, speed + s * h * (k == 0), mu + s * h * mu * (k == 1), dt)[0] for s in (1, -1)]
        differences = (ends[0] - ends[1]) / (2 * h * (1 if k == 0 else mu.detach()))
        torch.testing.assert_close(by, differences, rtol=1e-6, atol=0)


def test_forward_derivatives() -> None:
    """Are those of reverse mode."""
    mu = torch.tensor([0.5], dtype=torch.float64)
    speed = torch.ones_like(mu)
    given = speed.clone().requires_grad_()
    (expected,) = torch.autograd.grad(slid(EventSimulator, given, mu, 0.05)[0].sum(), given)
    with forward_ad.dual_level():
        moved = slid(EventSimulator, forward_ad.make_dual(speed, torch.ones_like(speed)), mu, 0.05)[0]
        torch.testing.assert_close(forward_ad.unpack_dual(moved).tangent, expected, rtol=1e-7, atol=0)


def test_values_are_the_same_to_the_bit() -> None:
    """With derivatives and without."""
    speed = torch.full_like(MU, SPEED)
    carrying = slid(EventSimulator, speed.clone().requires_grad_(), MU, 0.05)[0]
    assert torch.equal(slid(EventSimulator, speed, MU, 0.05)[0], carrying.detach())


def test_a_robot_that_lands() -> None:
    """A quadruped's feet are struck, slide, and stop, several at once: a cut is made only where the instant is found, so that the
    derivatives by its start are those of central differences, 1e-5 of them."""
    setup = SCENES["quadruped"](worlds=1)
    change = torch.randn(setup.v.shape[-1], dtype=torch.float64, generator=generator(0))

    def ended(by: Tensor) -> tuple[Tensor, int]:
        simulator = EventSimulator(setup.scene, 0.01, RungeKutta(surplus=math.inf), PRECISE)
        state = simulator.initial_state(setup.q.expand(len(by), -1), setup.v + by[:, None] * change)
        cuts = 0
        for _ in range(60):
            state, solution = simulator.step(state)
            assert solution.steps is not None
            cuts += int((solution.steps - 1).sum())
        return state.q[:, :3].sum(-1), cuts

    given = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    end, cuts = ended(given)
    assert cuts > 0
    (found,) = torch.autograd.grad(end.sum(), given)
    with torch.no_grad():
        around, _ = ended(torch.tensor([1e-6, -1e-6], dtype=torch.float64))
    assert float(found) == pytest.approx(float(around[0] - around[1]) / 2e-6, rel=1e-5)


# What is left alone -----------------------------------------------------------------------------------------------------------


def same_as_plain(scene: Scene, q: Tensor, v: Tensor, dt: float, steps: int) -> None:
    """The steps are those of a `Simulator`, to the bit."""
    made = [make(scene, dt, RungeKutta()) for make in (EventSimulator, Simulator)]
    states = [x.initial_state(q, v) for x in made]
    for _ in range(steps):
        states = [x.step(state)[0] for x, state in zip(made, states, strict=True)]
        assert torch.equal(states[0].q, states[1].q)
        assert torch.equal(states[0].v, states[1].v)


@pytest.mark.parametrize(("name", "dt"), [("chain-free", 0.01), ("chain-slope", 0.02), ("box-slope", 0.02), ("stack", 0.02)])
def test_nothing_stops(name: str, dt: float) -> None:
    """In the air, sliding on and on, and at rest."""
    setup = SCENES[name]()
    same_as_plain(setup.scene, setup.q, setup.v, dt, 20)


def test_a_ball_that_rolls() -> None:
    """It does not slide, however fast it moves."""
    scene = free_bodies((Sphere(0.1),), (1.0,), mu=0.5)
    v = torch.tensor([[1.0, 0.0, 0.0, 0.0, 10.0, 0.0]], dtype=torch.float64)
    same_as_plain(scene, posed((0, 0, 0.1)), v, 0.02, 20)


def test_without_friction() -> None:
    setup = SCENES["box-slide"](worlds=1)
    terms = [replaced(x, friction=None) if isinstance(x, Contact) else x for x in setup.scene.terms]
    same_as_plain(replaced(setup.scene, terms=tuple(terms)), setup.q, setup.v, 0.02, 5)
