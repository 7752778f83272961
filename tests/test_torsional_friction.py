"""Torsional friction: exact derivatives on random trees, a spinning sphere that stops, worlds apart."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.balance.objective import EnergyObjective
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Capsule, Collider, Point, Sphere
from pbfd_torch.errors import InputError
from pbfd_torch.native.engine import Engine, Torch
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.torsional_friction import TorsionalFriction
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import place
from tests.bodies import GRAVITY, at, diagonal, down, free_body, rolled_out
from tests.finite_differences import jacobian, relative_error
from tests.native_parity import DT
from tests.random_trees import SEEDS
from tests.states import implicit
from tests.term_cases import no_load
from tests.test_native_contact import SOLIDS as UNEVEN
from tests.test_native_contact import beside, touching
from tests.test_obstacles import SOLIDS, Meeting, meeting

RADIUS, INERTIA, MU, PATCH = 0.1, 0.004, 0.5, 0.02


def balance(m: Meeting, term: TorsionalFriction, q: torch.Tensor) -> Balance:
    placement = place(m.situation.articulation, q)
    return Balance(placement, [no_load(placement), term.load(term.prepare(m.context(q)), placement)])


@pytest.mark.parametrize("spin_speed", [100.0, 1e-3], ids=["sticking", "sliding"])
@pytest.mark.parametrize("solid", SOLIDS)
@pytest.mark.parametrize("seed", SEEDS)
def test_jacobian_is_exact(seed: int, solid: str, spin_speed: float) -> None:
    """J = ∂r/∂θ against central differences of r, ≤ 1e-7 relative, on a solid that turns, with links that turn by .3 rad."""
    m = meeting(seed, (2,), solid, "turntable", "round", None, turn=0.3)
    term = TorsionalFriction(m.contact, 0.7, 0.05, spin_speed)
    here = balance(m, term, m.situation.q)
    assert float(here.residual.abs().max()) > 0
    expected = jacobian(m.situation.articulation, lambda q: balance(m, term, q).residual, m.situation.q)
    assert relative_error(here.jacobian, expected, floor=1e-3 * here.residual.abs().amax(-1)) <= 1e-7


@pytest.mark.parametrize("share", [0.25, 1.0, 30.0])
def test_torque(share: float) -> None:
    """−ℓ μ N (2 − y) y at y = share of ε_ω Δt below 1, −ℓ μ N above, about the normal; no force; nothing without contact."""
    for height, normal in ((RADIUS - 1e-3, 1e6 * 1e-6), (RADIUS + 1e-3, 0.0)):
        articulation, contact = ball()
        term = TorsionalFriction(contact, MU, PATCH, 0.1)
        simulator = implicit(Scene(articulation, (Inertia(), contact, term), down()), 0.01)
        before, after = at(height), at(height, (0.0, 0.0, share * 0.1 * 0.01))
        state = dataclasses.replace(simulator.initial_state(), q=before, q_previous=before)
        step = simulator.objective(state).step
        residual = Balance(place(articulation, after), [term.load(term.prepare(step), place(articulation, after))]).residual
        expected = torch.zeros(6, dtype=torch.float64)
        expected[5] = PATCH * MU * normal * (1.0 if share >= 1 else (2 - share) * share)
        torch.testing.assert_close(residual, expected, rtol=1e-9, atol=1e-15)


def ball() -> tuple[Articulation, Contact]:
    """A ball of 1 kg on the ground, C⊥ = 1e6."""
    articulation = free_body(1.0, diagonal(INERTIA, INERTIA, INERTIA))
    colliders = [Collider("ball", "body", Sphere(RADIUS))]
    return articulation, Contact.between(articulation, colliders, HalfSpace(), NormalForce(1e6), CoulombFriction(MU))


@pytest.mark.parametrize("dt", [0.005, 0.02])
def test_spinning_ball_stops(dt: float) -> None:
    """In PyTorch; by the compiled core in `test_native_torsion`."""
    require_stop(dt, Torch())


def require_stop(dt: float, engine: Engine) -> None:
    """ω_0 = 2 rad/s about the vertical ends after ω_0 I/(ℓ μ m g), to 1 % and two steps, on the spot. On the way the scheme's own
    law I (2 sin Δ' − sin(Δ' + Δ))/Δt² = −ℓ μ m g holds to 1e-6, Δ the turn per step. Without the friction it spins on."""
    articulation, contact = ball()
    q = at(RADIUS - (GRAVITY / 1e6) ** 0.5)
    v = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 2.0], dtype=torch.float64)
    terms = (Inertia(), contact, TorsionalFriction(contact, MU, 0.2 * PATCH))
    rollout = rolled_out(Scene(articulation, terms, down()), dt, 0.8, q, v, engine=engine)
    assert bool(rollout.solved.all())
    brake = 0.2 * PATCH * MU * GRAVITY
    exact = 2.0 * INERTIA / brake
    spin = rollout.v[:, 5]
    assert float(rollout.time[int((spin < 0.02).nonzero()[0])]) == pytest.approx(exact, abs=0.01 * exact + 2 * dt)
    assert float(spin[-1].abs()) <= 1e-9
    assert float((rollout.q[:, :2]).abs().max()) <= 1e-9
    turned = spin[1:][spin[1:] > 0.05] * dt
    law = INERTIA * (2 * torch.sin(turned[1:]) - torch.sin(turned[1:] + turned[:-1])) / dt**2
    torch.testing.assert_close(law, torch.full_like(law, -brake), rtol=1e-6, atol=0)
    free = rolled_out(Scene(articulation, terms[:2], down()), 0.02, 0.5, q, v, engine=engine)
    assert float(free.v[-1, 5]) > 1.85


@pytest.mark.parametrize("solid", ["terrain", "grid"])
def test_jacobian_is_exact_where_distances_are_not(solid: str) -> None:
    """J = ∂r/∂θ on solids whose depths grow by less or more than what sinks, ≤ 1e-9 relative."""
    scene = touching((Sphere(0.05), Capsule(0.03, 0.1)), (UNEVEN[solid],))
    state, q = beside(scene, 12)
    contact, step = scene.terms[1], Simulator(scene, DT).objective(state).step
    assert isinstance(contact, Contact)
    term = TorsionalFriction(contact, 0.7, 0.05, 100.0)
    assert contact.touching(term.prepare(step), place(scene.articulation, q)).steepness is not None

    def here(q: torch.Tensor) -> Balance:
        placement = place(scene.articulation, q)
        return Balance(placement, [no_load(placement), term.load(term.prepare(step), placement)])

    expected = jacobian(scene.articulation, lambda q: here(q).residual, q, 1e-4)
    assert relative_error(here(q).jacobian, expected, floor=1e-3 * here(q).residual.abs().amax(-1)) <= 1e-9


def test_worlds_are_apart_and_lagged_friction_has_an_energy() -> None:
    """`take` gives what the batch has; the step with the friction held is an `EnergyObjective`, whose torque is the same there."""
    m = meeting(1, (3,), "cylinder", "turntable", "round", None)
    patch = torch.tensor([[0.01], [0.02], [0.05]], dtype=torch.float64)
    term = TorsionalFriction(m.contact, 0.7, patch, 1.0)
    whole = balance(m, term, m.situation.q)
    some = Worlds((3,), torch.tensor([2, 0]))
    taken, context = term.take(some), m.context(m.situation.q).take(some)
    there = place(context.previous.articulation, m.situation.q[[2, 0]])
    part = Balance(there, [taken.load(taken.prepare(context), there)])
    torch.testing.assert_close(part.residual, whole.residual[[2, 0]], rtol=0, atol=1e-13 * float(whole.residual.abs().max()))
    torch.testing.assert_close(part.jacobian, whole.jacobian[[2, 0]], rtol=0, atol=1e-13 * float(whole.jacobian.abs().max()))

    articulation, contact = ball()
    scene = Scene(articulation, (Inertia(), contact, TorsionalFriction(contact, MU, PATCH)), down())
    simulator = implicit(scene, 0.01)
    q = at(RADIUS - 1e-3, (0.0, 0.0, 0.01))
    objective = simulator.objective(simulator.initial_state(at(RADIUS - 1e-3)))
    lagged = objective.lagged(q)
    assert isinstance(lagged, EnergyObjective)
    torch.testing.assert_close(lagged.evaluate(q).residual, objective.evaluate(q).residual, rtol=1e-12, atol=1e-12)
    # a turn about the normal: here the energy's gradient is the torque itself
    steps = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0, h] for h in (1e-5, -1e-5)], dtype=torch.float64)
    values = [lagged.evaluate(lagged.retract(q, step)).value for step in steps]
    slope = float(values[0] - values[1]) / 2e-5
    assert slope == pytest.approx(float(lagged.evaluate(q).residual[5]), rel=1e-6)


def test_points_have_no_patch() -> None:
    """A contact of points alone is refused, and so are a negative patch and no spin speed."""
    articulation, contact = ball()
    points = Contact.between(articulation, [Collider("point", "body", Point())], HalfSpace(), NormalForce(1e6))
    with pytest.raises(InputError, match="radius"):
        TorsionalFriction(points, MU, PATCH)
    for values, words in (((MU, -1.0, 1.0), "patch"), ((-1.0, PATCH, 1.0), "mu"), ((MU, PATCH, 0.0), "spin_speed")):
        with pytest.raises(InputError, match=words):
            TorsionalFriction(contact, *values)
