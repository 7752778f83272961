"""Step energies: loads are their gradients; friction lagged and widened."""

from __future__ import annotations

import dataclasses
import math
from typing import Self

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Sphere
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction, slip_factor, slip_work
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.lagged_friction import LaggedFriction
from pbfd_torch.terms.load import Frictional, Potential, Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.tree.kinematics import Placement, place, retract
from pbfd_torch.tree.rotations import log_jacobian_left
from tests.bodies import at, diagonal, free_body
from tests.finite_differences import derivative, jacobian, relative_error
from tests.random_trees import SEEDS, moved_q
from tests.term_cases import ROUND, SLIDING, STICKING, TERMS, Situation, TermCase, contact, dry_torque, situation

all_trees = pytest.mark.parametrize("seed", SEEDS)
all_laws = pytest.mark.parametrize(
    "law",
    [STICKING, SLIDING, PbfdFriction.as_printed(5e4), PbfdFriction.as_derived(5e4, 2.0, 0.5)],
    ids=lambda law: type(law).__name__,
)


def rolls(term: Term) -> bool:
    """Whether the term is a contact whose lagged friction is not exactly a gradient."""
    return isinstance(term, Contact) and term.friction is not None and term.rounded


POTENTIALS = [case for case in TERMS if isinstance(made := case.build(situation(0)), Potential) and not rolls(made)]
FRICTIONAL = [case for case in TERMS if isinstance(case.build(situation(0)), Frictional)]


def elsewhere(s: Situation, seed: int = 5) -> Placement:
    """A placement a little away from the iterate, where some of the same candidates touch."""
    return place(s.articulation, moved_q(s.articulation, s.q, seed, 0.02))


def lagged(s: Situation, term: Term) -> Term:
    """The term with its friction held as it is `elsewhere`."""
    return term.lagged(term.prepare(s.context(s.q)), elsewhere(s)) if isinstance(term, Frictional) else term


def gradient(s: Situation, term: Term, largest: float = 1e-2) -> Tensor:
    """∂E/∂δ at δ = 0 of E(q ⊕ δ), by central differences."""
    assert isinstance(term, Potential)

    def energy(delta: Tensor) -> Tensor:
        q = retract(s.articulation, s.q, delta)
        return term.energy(term.prepare(s.context(q)), place(s.articulation, q))

    return derivative(energy, s.articulation.nv, tuple(s.q.shape[:-1]), largest)


# Energies ---------------------------------------------------------------------------------------------------------------


def test_every_term_has_an_energy() -> None:
    """Of every kind of term some case is tested below."""
    assert {type(case.build(situation(0))) for case in TERMS} == {type(case.build(situation(0))) for case in POTENTIALS}


@pytest.mark.parametrize("case", POTENTIALS, ids=str)
@all_trees
def test_residual_is_the_gradient_of_the_energy(case: TermCase, seed: int) -> None:
    """r = ∂E/∂θ to 1e-8, one energy a world; J = ∂²E/∂θ² is symmetric to 1e-12. Friction is lagged, at another placement."""
    s = situation(seed, (2,))
    term = lagged(s, case.build(s))
    balance = s.balance([term], s.q)
    expected = gradient(s, term)
    assert expected.shape == balance.residual.shape
    size = expected.abs().amax(-1, keepdim=True)
    assert float(((balance.residual - expected).abs() / size).max()) <= 1e-8
    assert relative_error(balance.jacobian.mT, balance.jacobian) <= 1e-12
    assert relative_error(balance.stiffness.mT, balance.stiffness) <= 1e-12


@pytest.mark.parametrize(
    "actuator",
    [
        Actuator("motor", "", gear=-2.0, bias=0.4),
        Actuator("weak motor", "", gear=2.0, bias=0.4, force_range=(-0.1, 0.2)),
        Actuator("servo", "", gear=1.5, gain=30.0, stiffness=30.0, damping=2.0),
        Actuator("weak servo", "", gear=1.5, gain=30.0, stiffness=30.0, damping=2.0, force_range=(-8.0, 3.0)),
        Actuator("nearly a motor", "", damping=1e-9, bias=100.0, force_range=(-1e3, 1e3)),
    ],
    ids=lambda a: a.name,
)
def test_actuator_energy_is_minus_its_work(actuator: Actuator) -> None:
    """E(q) − E(q_n) = −∫ f dx from x_n, through either limit of the force, against a fine trapezoidal sum: ≤ 1e-6 relative."""
    s = situation(0)
    a = s.articulation
    column, row = int(a.topology.scalar_q[0]), int(a.topology.scalar_v[0])
    term = Actuators.from_list(a, [dataclasses.replace(actuator, joint=a.joint_names[int(a.topology.scalar_joint[0])])])
    s = dataclasses.replace(s, control=torch.full((1,), 0.1, dtype=torch.float64))
    for end in (-1.0, 0.3, 1.0):
        moved = torch.linspace(0.0, end, 10001, dtype=torch.float64)
        q = s.state.q.repeat(len(moved), 1)
        q[:, column] += moved
        prepared, placement = term.prepare(s.context(q)), place(a, q)
        force = term.load(prepared, placement).residual[:, row]
        work = torch.trapezoid(force, moved)  # exact but for the panels in which the force reaches a limit
        energy = term.energy(prepared, placement)
        assert float(energy[0]) == 0
        assert float(energy[-1]) == pytest.approx(float(work), rel=1e-6, abs=1e-9)


# Lagged friction --------------------------------------------------------------------------------------------------------


@all_laws
@all_trees
def test_lagged_friction_is_the_law_where_it_was_frozen(law: FrictionLaw, seed: int) -> None:
    """At the placement of `lagged` the loads are bitwise the same; away from it J is still exact, for round candidates too.
    Lagging again freezes anew."""
    s = situation(seed, (2,))
    made = contact(s, law, shapes=ROUND)
    here, prepared = place(s.articulation, s.q), made.prepare(s.context(s.q))
    frozen = made.lagged(prepared, here)
    assert isinstance(frozen.friction, LaggedFriction)
    again = made.lagged(prepared, elsewhere(s)).lagged(prepared, here)
    for other in (frozen, again):
        assert torch.equal(other.load(prepared, here).moment, made.load(prepared, here).moment)
    away = made.lagged(prepared, elsewhere(s))
    assert not torch.equal(away.load(prepared, here).moment, made.load(prepared, here).moment)
    exact = jacobian(s.articulation, lambda q: s.balance([away], q).residual, s.q)
    assert relative_error(s.balance([away], s.q).jacobian, exact) <= 1e-7


@all_laws
@pytest.mark.parametrize("planar", [True, False], ids=["planar", "spatial"])
def test_gradient_of_lagged_rolling_friction(law: FrictionLaw, planar: bool) -> None:
    """Of a sphere: ∂E/∂θ − r is the moment ρ (Lᵀ − 1)(n × f), L = ∂φ/∂ω; zero where φ is along n × f."""
    a = free_body(1.0, diagonal(0.01, 0.01, 0.01))
    radius = 0.2
    made = Contact.between(a, [Collider("ball", "body", Sphere(radius))], HalfSpace(), NormalForce(1e4, release=math.inf), law)
    step = (0.05, 0.0, 0.0, 0.0, 0.7, 0.0) if planar else (0.05, 0.1, 0.0, 0.3, 0.7, -0.4)
    start = at(radius - 0.03)
    end = retract(a, start, torch.tensor(step, dtype=torch.float64))
    s = dataclasses.replace(situation(0), articulation=a, q=end, control=None)
    s = dataclasses.replace(s, state=dataclasses.replace(s.state, q=start, q_previous=start))
    placement, prepared = place(a, end), made.prepare(s.context(end))
    frozen = made.lagged(prepared, placement)
    friction = frozen.points(prepared, placement).force[0] * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    left = log_jacobian_left(torch.tensor(step[3:], dtype=torch.float64))  # the body starts unturned: φ is what it turned by
    normal = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    moment = radius * (left.mT - torch.eye(3, dtype=torch.float64)) @ torch.linalg.cross(normal, friction)
    turned = placement.poses[-1, :3, :3].mT @ moment  # a free joint turns about its body's axes
    difference = gradient(s, frozen) - s.balance([frozen], end).residual
    size = radius * float(torch.linalg.vector_norm(friction))
    assert float((difference - torch.cat((torch.zeros(3, dtype=torch.float64), turned))).abs().max()) <= 1e-8 * max(size, 1.0)
    assert float(moment.abs().max()) <= 1e-15 * size if planar else float(moment.abs().max()) > 0.1 * size


def test_slip_work() -> None:
    """S(y) = ∫ s·y dy: 0 at 0, 2w/3 at y = w, and Gauss's rule on both sides of w, where s·y is a polynomial."""
    width = torch.tensor(1e-3, dtype=torch.float64)
    y = torch.cat((torch.zeros(1, dtype=torch.float64), torch.logspace(-9, 1, 41, dtype=torch.float64)))
    offset = math.sqrt(0.6) * torch.tensor([[-0.5], [0.0], [0.5]], dtype=torch.float64)
    weight = torch.tensor([[5.0], [8.0], [5.0]], dtype=torch.float64) / 18

    def integral(low: Tensor, high: Tensor) -> Tensor:
        at = 0.5 * (low + high) + offset * (high - low)
        return (weight * slip_factor(at, width) * at).sum(0) * (high - low)

    expected = integral(torch.zeros_like(y), y.clamp_max(width)) + integral(width.expand_as(y), y.clamp_min(width))
    torch.testing.assert_close(slip_work(y, width), expected, rtol=1e-14, atol=0)
    assert float(slip_work(width, width)) == pytest.approx(2e-3 / 3, rel=1e-15)


# Widened friction -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", FRICTIONAL, ids=str)
def test_friction_widened_by_one_is_the_same(case: TermCase) -> None:
    """widened(1): bitwise the same load, lagged or not; without friction the term itself."""
    s = situation(0, (2,))
    here = place(s.articulation, s.q)
    original = case.build(s)
    for term in (original, lagged(s, original)):
        assert isinstance(term, Frictional)
        assert torch.equal(s.balance([term.widened(1.0)], s.q).jacobian, s.balance([term], s.q).jacobian)
        if isinstance(term, Contact) and term.friction is None:
            assert term.widened(7.0) is term
            assert term.lagged(term.prepare(s.context(s.q)), here) is term


def test_widened_friction_is_flatter_at_zero_slip() -> None:
    """The slope of Coulomb's force at u = 0 is 2μN/ε and that of a dry joint 2τ/ε, ε = f ε_v Δt: widened(f), on what the original
    prepared, divides it by f, lagged or not, and slipping fast changes nothing. The paper's law has no ε."""
    s = situation(0, (2,))
    moving, prepared_at = place(s.articulation, s.q), s.context(s.q)
    still = place(s.articulation, s.state.q)
    joints = JointDryFriction(dry_torque(s), slip_speed=1e-4)
    prepared = joints.prepare(prepared_at)
    slope = joints.load(prepared, still).stiffness
    assert bool((slope.diagonal(dim1=-2, dim2=-1)[..., s.articulation.topology.scalar_v] > 0).all())
    torch.testing.assert_close(joints.widened(8.0).load(prepared, still).stiffness, slope / 8, rtol=1e-15, atol=0)
    fast, wide = joints.load(prepared, moving).residual, joints.widened(8.0).load(prepared, moving).residual
    torch.testing.assert_close(fast, wide, rtol=1e-14, atol=0)

    made = contact(s, SLIDING)
    touched = made.prepare(prepared_at)
    for term in (made, made.lagged(touched, moving)):
        wider = term.widened(8.0)
        torch.testing.assert_close(wider.load(touched, moving).moment, term.load(touched, moving).moment, rtol=1e-14, atol=1e-12)
        assert wider.friction is not None
        assert term.friction is not None
        push, _ = made.normal_force.force(made.depth(moving))
        arguments = push, made.depth(moving), torch.zeros_like(push), touched.dt
        steep, flat = term.friction.drag(*arguments), wider.friction.drag(*arguments)
        assert float(steep.abs().max()) > 0
        torch.testing.assert_close(flat, steep / 8, rtol=1e-15, atol=0)
    law = PbfdFriction.as_printed(5e4)
    assert law.widened(8.0) is law


@pytest.mark.parametrize("factor", [0.5, 0.0, -1.0, math.nan, math.inf])
def test_bad_widening_is_refused(factor: float) -> None:
    """A factor below 1 or not finite: the message names the value and the range."""
    s = situation(0)
    for friction in (CoulombFriction(0.5), PbfdFriction.as_printed(1.0), JointDryFriction(dry_torque(s)), contact(s, STICKING)):
        with pytest.raises(InputError, match=f"{factor}: must be ≥ 1 and finite"):
            friction.widened(factor)


def test_a_law_without_slip_energy_stays_as_it_is() -> None:
    """A friction law without `slip_energy` and `widened`, as README allows: the contact is not lagged and not widened."""

    class Viscous:
        def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
            return normal

        def drag_slopes(
            self, normal: Tensor, normal_slope: Tensor, depth: Tensor, size: Tensor, dt: Tensor
        ) -> tuple[Tensor, Tensor]:
            return normal_slope, torch.zeros_like(size)

        def take(self, worlds: Worlds) -> Self:
            return self

    s = situation(0)
    made = contact(s, Viscous())
    assert made.widened(2.0) is made
    assert made.lagged(made.prepare(s.context(s.q)), elsewhere(s)) is made
