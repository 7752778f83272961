"""Every term: exact Jacobians, energies, invariance, worlds apart; and the closed forms of contact, friction and actuators."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Capsule, Collider, Point, Shape, Sphere
from pbfd_torch.contact.surface import Plane
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact, ContactPoints
from pbfd_torch.terms.coulomb_friction import CoulombFriction, slip_factor, slip_factor_slope
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import JointDamping, JointSprings, checked_coefficient
from pbfd_torch.terms.load import LinkLoad, Term
from pbfd_torch.terms.normal_force import NormalForce, power
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link, homogeneous
from pbfd_torch.tree.kinematics import place, retract
from pbfd_torch.tree.rotations import quaternion_exp, quaternion_matrix, quaternion_multiply
from tests.finite_differences import derivative, jacobian, relative_error
from tests.random_trees import SEEDS
from tests.states import state_of
from tests.term_cases import CONTACTS, ROUND, SLIDING, STICKING, TERMS, Situation, TermCase, contact, raised, situation

all_terms = pytest.mark.parametrize("case", TERMS, ids=str)
all_contacts = pytest.mark.parametrize("case", CONTACTS, ids=str)
all_trees = pytest.mark.parametrize("seed", SEEDS)


def jacobian_error(s: Situation, terms: list[Term]) -> float:
    """Relative error of the assembled Jacobian against central differences of the residual."""
    balance = s.balance(terms, s.q)
    expected = jacobian(s.articulation, lambda q: s.balance(terms, q).residual, s.q)
    return relative_error(balance.jacobian, expected, floor=1e-3 * balance.residual.abs().amax(-1))


# Jacobians and energies -----------------------------------------------------------------------------------------------


@all_trees
def test_situations_hold_what_the_cases_need(seed: int) -> None:
    """In every world some candidates touch and some do not, sticking ones slip less than the width ε_v Δt, sliding ones more
    than ten times it; some joints are below their range, some above it and some inside."""
    s = situation(seed, (2,))
    placement, context = place(s.articulation, s.q), s.context(s.q)
    for shapes in (ROUND, (Point(),)):
        made = contact(s, STICKING, shapes=shapes)
        points = made.points(made.prepare(context), placement)
        touching = points.depth > 0
        assert bool(touching.any(-1).all())
        assert bool((~touching).any(-1).all())
        slip = torch.linalg.vector_norm(points.slip, dim=-1)[touching]
        assert float(slip.max()) < STICKING.slip_speed * float(s.dt)
        assert float(slip.min()) > 10 * SLIDING.slip_speed * float(s.dt)
    x = s.q[..., s.articulation.topology.scalar_q]
    below = x < s.articulation.lower[..., s.articulation.topology.scalar_v]
    above = x > s.articulation.upper[..., s.articulation.topology.scalar_v]
    assert bool((below.any(-1) & above.any(-1) & (~below & ~above).any(-1)).all())


@all_terms
@all_trees
def test_jacobian_is_exact(case: TermCase, seed: int) -> None:
    """J = ∂r/∂θ in the exponential chart (METHOD §3), against central differences of r: ≤ 1e-7 relative."""
    s = situation(seed, (2,))
    assert jacobian_error(s, [case.build(s)]) <= 1e-7


@pytest.mark.parametrize("friction", [STICKING, SLIDING, PbfdFriction.as_printed(5e4)], ids=lambda f: type(f).__name__)
@all_trees
def test_jacobian_is_exact_for_large_turns(friction: FrictionLaw, seed: int) -> None:
    """As above for rounded candidates whose links turn by about a radian over the step: φ = log(R R_nᵀ) is far from linear."""
    s = situation(seed, (2,), turn=0.6)
    made = contact(s, friction, shapes=ROUND)
    assert jacobian_error(s, [made]) <= 1e-7


@all_trees
def test_jacobian_of_all_terms_together(seed: int) -> None:
    """Loads add up, and so do their Jacobians: r = Σ r_k, J = Σ J_k, and J is exact for the sum."""
    s = situation(seed, (2,))
    terms = [case.build(s) for case in TERMS]
    whole = s.balance(terms, s.q)
    parts = [s.balance([term], s.q) for term in terms]
    residual, matrix = sum(p.residual for p in parts), sum(p.jacobian for p in parts)
    torch.testing.assert_close(whole.residual, residual, rtol=1e-12, atol=1e-12 * float(whole.residual.abs().max()))
    torch.testing.assert_close(whole.jacobian, matrix, rtol=1e-12, atol=1e-12 * float(whole.jacobian.abs().max()))
    assert jacobian_error(s, terms) <= 1e-7


@pytest.mark.parametrize("case", [c for c in TERMS if c.stores], ids=str)
@all_trees
def test_residual_and_jacobian_derive_from_the_energy(case: TermCase, seed: int) -> None:
    """r = ∂E/∂δ and J = ∂²E/∂δ² at δ = 0 of E(q ⊕ δ), by automatic differentiation: ≤ 1e-10 relative. J is symmetric."""
    s = situation(seed)
    term = case.build(s)
    prepared = term.prepare(s.context(s.q))

    def energy(delta: Tensor) -> Tensor:
        placement = place(s.articulation, retract(s.articulation, s.q, delta))
        if case.stores == "potential":
            return term.potential(placement, s.state.time)  # type: ignore[attr-defined, no-any-return, unused-ignore]
        return term.energy(prepared, placement)  # type: ignore[attr-defined, no-any-return, unused-ignore]

    at = torch.zeros(s.articulation.nv, dtype=torch.float64)
    gradient = torch.func.grad(energy)(at)
    hessian = torch.func.hessian(energy)(at)
    balance = s.balance([term], s.q)
    assert float((balance.residual - gradient).abs().max()) <= 1e-10 * float(gradient.abs().max())
    assert relative_error(balance.jacobian, hessian) <= 1e-10
    assert relative_error(balance.jacobian.mT, balance.jacobian) <= 1e-12


@all_terms
def test_stiffness_of_conservative_terms_is_symmetric_and_never_pulls(case: TermCase) -> None:
    """The stiffness (J without the tree's curvature) is the solver's fallback: for terms that store energy it is symmetric and
    positive semi-definite. With friction it is finite."""
    s = situation(0, (3,))
    stiffness = s.balance([case.build(s)], s.q).stiffness
    assert bool(torch.isfinite(stiffness).all())
    if case.stores:
        size = float(stiffness.abs().max())
        assert float((stiffness - stiffness.mT).abs().max()) <= 1e-12 * size
        assert float(torch.linalg.eigvalsh(0.5 * (stiffness + stiffness.mT)).min()) >= -1e-12 * size


# Where there is nothing, there is nothing -----------------------------------------------------------------------------


@all_contacts
def test_no_load_where_nothing_touches(case: TermCase) -> None:
    """d ≤ 0 for every candidate ⇒ force and stiffness are exactly zero, whatever the slip."""
    s = situation(0, (3,))
    made = case.build(s)
    assert isinstance(made, Contact)
    placement = place(s.articulation, s.q)
    apart = raised(made, -made.depth(placement).amax(-1, keepdim=True) - 1e-9)
    load = apart.load(apart.prepare(s.context(s.q)), placement)
    assert float(apart.depth(placement).max()) <= 0
    assert bool((load.moment == 0).all())
    assert bool((load.stiffness == 0).all())
    assert bool((apart.potential(placement, s.state.time) == 0).all())


@all_contacts
def test_no_force_at_depth_zero(case: TermCase) -> None:
    """d = 0 exactly: f = C⊥ 0^α = 0 and df/dd = 0; finite, no NaN from 0/0."""
    s = situation(1)
    made = case.build(s)
    assert isinstance(made, Contact)
    law = made.normal_force
    zero = torch.zeros(4, dtype=torch.float64)
    push, slope = law.force(zero)
    assert bool((push == 0).all())
    assert bool((slope == 0).all())
    if made.friction is not None:
        for size in (torch.zeros(4, dtype=torch.float64), torch.ones(4, dtype=torch.float64)):
            assert bool((made.friction.drag(push, zero, size, s.dt) == 0).all())
            for value in made.friction.drag_slopes(push, slope, zero, size, s.dt):
                assert bool((value == 0).all())


def test_no_load_inside_the_limits() -> None:
    """lower < x < upper ⇒ residual and stiffness are exactly zero; so is the energy."""
    s = situation(0, (3,))
    inf = torch.full_like(s.articulation.lower, math.inf)
    free = dataclasses.replace(s.articulation, lower=-inf, upper=inf)
    limits = JointLimits(torch.full((free.nv,), 50.0, dtype=torch.float64))
    load = limits.load(limits.prepare(dataclasses.replace(s, articulation=free).context(s.q)), place(free, s.q))
    assert bool((load.residual == 0).all())
    assert bool((load.stiffness == 0).all())
    assert bool((limits.potential(place(free, s.q), s.state.time) == 0).all())


@pytest.mark.parametrize("case", [c for c in TERMS if "dry" in c.name or "damping" in c.name], ids=str)
def test_dissipation_needs_motion(case: TermCase) -> None:
    """At θ_{n+1} = θ_n damping and dry friction give no force."""
    s = situation(0, (3,))
    still = dataclasses.replace(s, q=s.state.q)
    assert bool((still.balance([case.build(still)], still.q).residual.abs() <= 1e-12).all())


# Frames, worlds, precision --------------------------------------------------------------------------------------------


def moved_scene(s: Situation, turn: Tensor, shift: Tensor) -> tuple[Situation, Tensor, Callable[[Tensor], Tensor]]:
    """The same situation seen from another frame (p ← R p + t), P with r' = P r, and what turns q into q'."""
    t = s.articulation.topology
    quaternion, rotation = quaternion_exp(turn), quaternion_matrix(quaternion_exp(turn))
    frame = homogeneous(rotation, shift)

    def moved(q: Tensor) -> Tensor:
        q = q.clone()
        q[..., t.free_q] = q[..., t.free_q] @ rotation.mT + shift
        rows = t.turning_q[t.moving]
        q[..., rows] = quaternion_multiply(quaternion, q[..., rows])
        return q

    roots = torch.tensor([p == 0 for p in t.joint_parent])
    roots[t.turning_joint[t.moving]] = False
    world_links = torch.tensor([node == 0 for node in t.link_node])
    a = dataclasses.replace(
        s.articulation,
        joint_frame=torch.where(roots[:, None, None], frame @ s.articulation.joint_frame, s.articulation.joint_frame),
        link_frame=torch.where(world_links[:, None, None], frame @ s.articulation.link_frame, s.articulation.link_frame),
    )
    change = torch.eye(a.nv, dtype=torch.float64)
    for rows in t.free_v:
        change[rows[:, None], rows] = rotation
    state = state_of(moved(s.state.q), moved(s.state.q_previous))
    return dataclasses.replace(s, articulation=a, state=state, q=moved(s.q), gravity=s.gravity @ rotation.mT), change, moved


@all_terms
@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.2), (0.7, -1.1, 0.4)], ids=["about z", "about any axis"])
def test_physics_does_not_depend_on_the_frame(case: TermCase, axis: tuple[float, float, float]) -> None:
    """Turn and shift the whole scene, obstacle and gravity included: r' = P r and J' = P J Pᵀ, where P turns a free base's
    translation and leaves all other degrees of freedom alone."""
    s = situation(2, (2,))
    turn, shift = torch.tensor(axis, dtype=torch.float64), torch.tensor([0.3, -2.0, 0.9], dtype=torch.float64)
    there, change, in_frame = moved_scene(s, turn, shift)
    term = case.build(s)
    term_there = term
    if isinstance(term, Contact):
        assert isinstance(term.surface, Plane)
        normal = quaternion_matrix(quaternion_exp(turn)) @ term.surface.normal
        term_there = dataclasses.replace(term, surface=Plane(normal, term.surface.offset + normal @ shift))
    elif isinstance(term, JointSprings):
        term_there = dataclasses.replace(term, rest=in_frame(term.rest))
    elif isinstance(term, Pushes):
        term_there = dataclasses.replace(term, force=term.force @ quaternion_matrix(quaternion_exp(turn)).mT)
    here, moved = s.balance([term], s.q), there.balance([term_there], there.q)
    size = float(here.residual.abs().max())
    torch.testing.assert_close(moved.residual, here.residual @ change.mT, rtol=0, atol=1e-11 * size)
    assert relative_error(moved.jacobian, change @ here.jacobian @ change.mT) <= 1e-11


@all_terms
def test_poisoned_world_harms_no_other(case: TermCase) -> None:
    """NaN in world 1's configuration: the residuals and Jacobians of worlds 0 and 2 stay bitwise the same."""
    s = situation(0, (3,))
    term = case.build(s)
    clean = s.balance([term], s.q)
    q = s.q.clone()
    q[1] = math.nan
    dirty = s.balance([term], q)
    for before, after in ((clean.residual, dirty.residual), (clean.jacobian, dirty.jacobian), (clean.stiffness, dirty.stiffness)):
        assert torch.equal(before[[0, 2]], after[[0, 2]])
    assert bool(torch.isfinite(clean.residual).all())


@all_terms
def test_batch_equals_its_worlds(case: TermCase) -> None:
    """A batch `[2, 3]` gives what each of its worlds gives alone, also where limits and ground height differ between worlds."""
    s = situation(1, (2, 3))
    term = case.build(s)
    whole = s.balance([term], s.q)
    assert whole.residual.shape == (2, 3, s.articulation.nv)
    for i, j in ((0, 0), (1, 2)):
        a = dataclasses.replace(s.articulation, lower=s.articulation.lower[i, j], upper=s.articulation.upper[i, j])
        state = state_of(s.state.q[i, j], s.state.q_previous[i, j])
        control = None if s.control is None else s.control[i, j]
        one = dataclasses.replace(s, articulation=a, state=state, q=s.q[i, j], control=control)
        one_term = of_world(term, (i, j)) if isinstance(term, Contact) else term
        alone = one.balance([one_term], one.q)
        size = float(whole.residual.abs().max())
        torch.testing.assert_close(whole.residual[i, j], alone.residual, rtol=0, atol=1e-13 * size)
        torch.testing.assert_close(whole.jacobian[i, j], alone.jacobian, rtol=0, atol=1e-13 * float(whole.jacobian.abs().max()))


def of_world(made: Contact, world: tuple[int, ...]) -> Contact:
    """A contact with the ground height of one world."""
    assert isinstance(made.surface, Plane)
    return dataclasses.replace(made, surface=Plane(made.surface.normal, made.surface.offset[world]))


@pytest.mark.parametrize("friction", [CoulombFriction, PbfdFriction], ids=lambda f: f.__name__)
def test_contact_parameters_may_differ_from_world_to_world(friction: type) -> None:
    """C⊥ `[*batch, 1]`, μ or C∥ `[*batch, npoint]`, and the pseudo-inertia `[*batch, nlink, 4, 4]`: each world gets its own."""
    s = situation(0, (3,))
    stiffness = torch.tensor([1e3, 1e4, 1e5], dtype=torch.float64)
    share = torch.linspace(0.1, 0.9, 3 * len(contact(s, None).link), dtype=torch.float64).view(3, -1)

    def law(value: Tensor) -> FrictionLaw:
        return CoulombFriction(value, 50.0) if friction is CoulombFriction else PbfdFriction.as_printed(1e5 * value)

    base = contact(s, None)
    made = dataclasses.replace(base, normal_force=NormalForce(stiffness[:, None]), friction=law(share))
    mass = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)[:, None, None, None]
    a = dataclasses.replace(s.articulation, pseudo_inertia=mass * s.articulation.pseudo_inertia)
    whole = dataclasses.replace(s, articulation=a).balance([Inertia(), made], s.q)
    for k in range(3):
        one_made = dataclasses.replace(of_world(base, (k,)), normal_force=NormalForce(float(stiffness[k])), friction=law(share[k]))
        one_a = dataclasses.replace(
            s.articulation, pseudo_inertia=a.pseudo_inertia[k], lower=s.articulation.lower[k], upper=s.articulation.upper[k]
        )
        state = state_of(s.state.q[k], s.state.q_previous[k])
        one = dataclasses.replace(s, articulation=one_a, state=state, q=s.q[k], control=None)
        alone = one.balance([Inertia(), one_made], one.q)
        torch.testing.assert_close(whole.residual[k], alone.residual, rtol=1e-12, atol=1e-10)
        torch.testing.assert_close(whole.jacobian[k], alone.jacobian, rtol=1e-12, atol=1e-9)


# Closed forms: the normal force ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [1.5, 2.0, 2.5, 3.0])
def test_normal_force_carries_a_load_at_its_rest_depth(exponent: float) -> None:
    """f(d) = N at d = (N/C⊥)^{1/α} (METHOD §4); df/dd = α C⊥ d^{α−1}; f = d/dd of the energy C⊥ d^{α+1}/(α+1)."""
    law = NormalForce(3e6, exponent)
    load = torch.tensor([0.1, 9.81, 500.0], dtype=torch.float64)
    depth = (load / 3e6) ** (1 / exponent)
    push, slope = law.force(depth)
    torch.testing.assert_close(push, load, rtol=1e-13, atol=0)
    torch.testing.assert_close(slope, exponent * load / depth, rtol=1e-13, atol=0)
    d = depth.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(law.energy(d).sum(), d)
    torch.testing.assert_close(gradient, load, rtol=1e-12, atol=0)


def test_normal_force_for_weight() -> None:
    """`for_weight` makes a load W rest at the depth asked for: C⊥ = W/d^α."""
    push, _ = NormalForce.for_weight(20.0, 5e-4, 2.5).force(torch.tensor([5e-4], dtype=torch.float64))
    assert float(push) == pytest.approx(20.0, rel=1e-13)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 2.0, 2.5, 3.0, 4.0, 5.0])
def test_power(exponent: float) -> None:
    """base^e for base ≥ 0, with 0^0 = 1 and 0^e = 0, in one world as in many; its gradient is e base^{e−1}."""
    base = torch.tensor([0.0, 1e-9, 0.3, 1.0, 7.0], dtype=torch.float64)
    expected = [x**exponent for x in base.tolist()]
    torch.testing.assert_close(power(base, exponent), torch.tensor(expected, dtype=torch.float64), rtol=1e-13, atol=0)
    assert all(torch.equal(power(base[k], exponent), power(base, exponent)[k]) for k in range(5))
    x = base[1:].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(power(x, exponent).sum(), x) if exponent else (torch.zeros(4, dtype=torch.float64),)
    torch.testing.assert_close(gradient, exponent * base[1:] ** (exponent - 1), rtol=1e-12, atol=0)


def test_softened_contact_and_limits() -> None:
    """softened(f) scales force, stiffness and energy by f, of contacts (Coulomb friction follows) and of limits."""
    s = situation(0, (2,))
    for case in TERMS:
        term = case.build(s)
        if case.name not in ("contact, α = 2", "Coulomb, sliding", "joint limits"):
            continue
        assert isinstance(term, (Contact, JointLimits))
        full, soft = s.balance([term], s.q), s.balance([term.softened(0.01)], s.q)
        torch.testing.assert_close(soft.residual, 0.01 * full.residual, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(soft.jacobian, 0.01 * full.jacobian, rtol=1e-12, atol=1e-9)


# Closed forms: one body on a plane ------------------------------------------------------------------------------------


def one_body(
    shape: Shape, friction: FrictionLaw | None, stiffness: float = 1e6, margin: float = 0.0
) -> tuple[Articulation, Contact]:
    """A free body of 1 kg with one collider at its origin, on the plane z = 0."""
    eye = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))
    articulation = Articulation.from_links([Link("body", joints=(Joint("free", JointKind.FREE),), mass=1.0, inertia=eye)])
    colliders = [Collider("c", "body", shape, margin=margin)]
    return articulation, Contact.between(articulation, colliders, HalfSpace(), NormalForce(stiffness), friction)


def contact_points(
    articulation: Articulation, made: Contact, before: Tensor, after: Tensor, dt: float
) -> tuple[ContactPoints, LinkLoad]:
    """What the contact sees over a step from one configuration to the next."""
    time = torch.tensor(dt, dtype=torch.float64)
    gravity = torch.zeros(3, dtype=torch.float64)
    prepared = made.prepare(ImplicitEuler().context(articulation, state_of(before, before), time, gravity, None))
    placement = place(articulation, after)
    return made.points(prepared, placement), made.load(prepared, placement)


def pose(position: tuple[float, float, float], turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tensor:
    return torch.cat((torch.tensor(position, dtype=torch.float64), quaternion_exp(torch.tensor(turn, dtype=torch.float64))))


@pytest.mark.parametrize(("speed", "share"), [(0.5, 1.0), (1e-3, 1.0), (5e-4, 0.75), (1e-4, 0.19), (0.0, 0.0)])
def test_coulomb_force(speed: float, share: float) -> None:
    """f∥ = −μ N s(‖u‖) u: of size μN against the slip from ε_v = 1 mm/s on, and (2 − y)y μN at y = v/ε_v below; N = C⊥ d²."""
    articulation, made = one_body(Point(), CoulombFriction(0.4, 1e-3))
    direction = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64)
    dt, depth = 0.01, 2e-3
    after = pose((0.0, 0.0, -depth))
    after[:3] += speed * dt * direction
    points, load = contact_points(articulation, made, pose((0.0, 0.0, -depth)), after, dt)
    normal = 1e6 * depth**2
    expected = torch.tensor([0.0, 0.0, normal], dtype=torch.float64) - 0.4 * normal * share * direction
    torch.testing.assert_close(points.force[0], expected, rtol=0, atol=1e-9 * normal)
    torch.testing.assert_close(-load.moment[0, :, 3], expected, rtol=0, atol=1e-9 * normal)


def test_slip_factor_is_smooth() -> None:
    """s·y rises from 0 to 1 at y = w with slope 2/w at 0 and 0 at w, and stays 1: both s and its slope are continuous at w."""
    width = torch.tensor(1e-3, dtype=torch.float64)
    eps = 1e-9
    below, above = width * (1 - eps), width * (1 + eps)
    assert float(slip_factor(below, width) * width) == pytest.approx(1.0, abs=1e-8)
    for function in (slip_factor, slip_factor_slope):
        assert float(function(below, width)) == pytest.approx(float(function(above, width)), rel=1e-8)
    y = torch.linspace(0.0, 3e-3, 301, dtype=torch.float64)
    force = slip_factor(y, width) * y
    assert bool((force.diff() >= -1e-12).all())
    assert float(force[0]) == 0
    assert float(force[1:2] / y[1:2]) == pytest.approx(2 / 1e-3, rel=1e-2)
    assert float((force[y >= 1e-3] - 1).abs().max()) <= 1e-12


@pytest.mark.parametrize("beta", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("printed", [True, False], ids=["as printed", "as derived"])
def test_pbfd_friction_is_coulombs_with_a_calibrated_mu(beta: float, printed: bool) -> None:
    """With α = 2, γ = 1: f∥ = −μ_eff N u/‖u‖, μ_eff = (β + 1)(C∥/C⊥)(v Δt)^{β+1} as printed, ^β as derived, at any depth."""
    tangential, normal_stiffness, dt, speed = 4e5, 1e6, 0.02, 0.7
    law = (PbfdFriction.as_printed if printed else PbfdFriction.as_derived)(tangential, beta, 1.0)
    articulation, made = one_body(Point(), law, normal_stiffness)
    mu = (beta + 1) * tangential / normal_stiffness * (speed * dt) ** (beta + 1 if printed else beta)
    for depth in (1e-4, 1e-3, 1e-2):
        points, _ = contact_points(articulation, made, pose((0.0, 0.0, 0.0)), pose((speed * dt, 0.0, -depth)), dt)
        normal = normal_stiffness * depth**2
        assert float(points.force[0, 2]) == pytest.approx(normal, rel=1e-12)
        assert float(points.force[0, 0]) == pytest.approx(-mu * normal, rel=1e-12)


@pytest.mark.parametrize("beta", [1.0, 2.0])
@pytest.mark.parametrize("printed", [True, False], ids=["as printed", "as derived"])
def test_calibrated_friction_brakes_with_mu(beta: float, printed: bool) -> None:
    """`calibrated(μ, C⊥, v, Δt)`: at slip v Δt the law brakes with μN exactly, at any depth."""
    law = (PbfdFriction.as_printed if printed else PbfdFriction.as_derived)(1.0, beta, 1.0).calibrated(0.35, 1e6, 0.7, 0.02)
    articulation, made = one_body(Point(), law, 1e6)
    for depth in (1e-4, 1e-2):
        points, _ = contact_points(articulation, made, pose((0.0, 0.0, 0.0)), pose((0.0, 0.7 * 0.02, -depth)), 0.02)
        assert float(points.force[0, 1]) == pytest.approx(-0.35 * 1e6 * depth**2, rel=1e-12)


@pytest.mark.parametrize("angle", [1e-6, 0.01, 0.5, 2.0, 3.1])
@pytest.mark.parametrize("direction", [0.0, 0.8])
def test_pure_rolling_does_not_slip(angle: float, direction: float) -> None:
    """A sphere that turns by φ while its centre moves by φ × ρ n has u = 0 at every angle φ < π, where the chord has Rφ³/6;
    and so does every sphere of a capsule that rolls across its axis."""
    radius, depth = 0.05, 1e-3
    axis = (-math.sin(direction), math.cos(direction), 0.0)
    turn = (angle * axis[0], angle * axis[1], 0.0)
    for start in ((0.0, 0.0, 0.0), (0.3, 1.0, -0.2)):
        articulation, made = one_body(Sphere(radius), CoulombFriction(0.5))
        before = pose((1.0, 2.0, radius - depth), start)
        after = before.clone()
        after[0] += radius * angle * math.cos(direction)
        after[1] += radius * angle * math.sin(direction)
        after[3:] = quaternion_multiply(quaternion_exp(torch.tensor(turn, dtype=torch.float64)), before[3:])
        points, _ = contact_points(articulation, made, before, after, 0.01)
        assert float(points.depth) == pytest.approx(depth, rel=1e-9)
        assert float(points.slip.abs().max()) <= 1e-14
        assert float(points.force[0, :2].abs().max()) <= 1e-9
    articulation, made = one_body(Capsule(radius, 0.2), CoulombFriction(0.5))
    lying = quaternion_exp(0.5 * math.pi * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))  # its axis along −y
    before = torch.cat((torch.tensor([0.0, 0.0, radius - depth], dtype=torch.float64), lying))
    after = before.clone()
    after[0] += radius * angle
    after[3:] = quaternion_multiply(quaternion_exp(torch.tensor([0.0, angle, 0.0], dtype=torch.float64)), lying)
    points, _ = contact_points(articulation, made, before, after, 0.01)
    assert points.slip.shape == (2, 3)
    assert float(points.slip.abs().max()) <= 1e-14


def test_spinning_in_place_slips() -> None:
    """A sphere that turns by φ about y without moving slips by u = −ρ φ × n = −ρφ x: the surface point runs backwards."""
    articulation, made = one_body(Sphere(0.05), CoulombFriction(0.5))
    points, _ = contact_points(articulation, made, pose((0, 0, 0.049)), pose((0, 0, 0.049), (0.0, 0.3, 0.0)), 0.01)
    torch.testing.assert_close(points.slip[0], torch.tensor([-0.015, 0.0, 0.0], dtype=torch.float64), rtol=0, atol=1e-15)


def test_force_acts_at_the_surface() -> None:
    """Friction of a sphere acts at c − ρn: its moment about the centre is (−ρ n) × f; a point with a margin feels it itself."""
    for shape, margin, lever in ((Sphere(0.05), 0.0, 0.05), (Point(), 0.05, 0.0)):
        articulation, made = one_body(shape, CoulombFriction(0.5), margin=margin)
        before = pose((0.4, -0.3, 0.049))
        after = before.clone()
        after[0] += 0.01
        points, load = contact_points(articulation, made, before, after, 0.01)
        residual = Balance(place(articulation, after), [load]).residual
        force = points.force[0]
        arm = torch.tensor([0.0, 0.0, -lever], dtype=torch.float64)
        torch.testing.assert_close(residual[:3], -force, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(residual[3:], -torch.linalg.cross(arm, force), rtol=1e-12, atol=1e-12)
        assert float(force[0]) == pytest.approx(-0.5 * float(force[2]), rel=1e-12)


# Closed forms: joints -------------------------------------------------------------------------------------------------


def test_joint_limit_torque() -> None:
    """Torque −k x² back into the range at a violation x; energy k x³/3; a load τ rests √(τ/k) past the limit."""
    s = situation(0)
    a = s.articulation
    k = torch.full((a.nv,), 40.0, dtype=torch.float64)
    limits = JointLimits(k, math.inf)
    residual = limits.load(limits.prepare(s.context(s.q)), place(a, s.q)).residual
    x = s.q[a.topology.scalar_q]
    lower, upper = a.lower[a.topology.scalar_v], a.upper[a.topology.scalar_v]
    expected = 40.0 * ((x - upper).clamp_min(0) ** 2 - (lower - x).clamp_min(0) ** 2)
    torch.testing.assert_close(residual[a.topology.scalar_v], expected, rtol=1e-12, atol=1e-12)
    others = torch.cat((a.topology.free_v.flatten(), a.topology.turning_v.flatten()))
    assert bool((residual[others] == 0).all())


def test_dry_friction_torque() -> None:
    """Torque of size τ against the motion once |q̇| ≥ slip_speed; (2 − y) y τ at y = |q̇|/slip_speed below."""
    s = situation(0)
    a = s.articulation
    torque = torch.zeros(a.nv, dtype=torch.float64)
    torque[a.topology.scalar_v] = 2.0
    for y, share in ((3.0, 1.0), (1.0, 1.0), (0.5, 0.75), (-0.5, -0.75), (-3.0, -1.0)):
        q = s.state.q.clone()
        q[a.topology.scalar_q] += y * 0.1 * float(s.dt)
        residual = s.balance([JointDryFriction(torque, slip_speed=0.1)], q).residual
        expected = torch.full((len(a.topology.scalar_v),), 2.0 * share, dtype=torch.float64)
        torch.testing.assert_close(residual[a.topology.scalar_v], expected, rtol=1e-9, atol=1e-9)


def test_actuator_forces() -> None:
    """Force gear · clamp(gain·u + bias − kp·x − kv·ẋ, effort) at x = gear·q, control clamped to its range; several actuators on one
    joint add up."""
    s = situation(0)
    a = s.articulation
    name = a.joint_names[int(a.topology.scalar_joint[0])]
    column, row = int(a.topology.scalar_q[0]), int(a.topology.scalar_v[0])
    dt, gear, u = float(s.dt), 1.5, 0.9
    x = gear * float(s.q[column])
    rate = (x - gear * float(s.state.q[column])) / dt

    def force(*made: Actuator) -> float:
        bank = Actuators.from_list(a, list(made))
        one = dataclasses.replace(s, control=torch.full((len(made),), u, dtype=torch.float64))
        residual = one.balance([bank], one.q).residual
        assert int((residual != 0).sum()) <= 1
        return -float(residual[row])

    assert force(Actuator.motor("m", name, gear)) == pytest.approx(gear * u, rel=1e-12)
    assert force(Actuator.motor("m", name, gear, effort=0.5)) == pytest.approx(gear * 0.5, rel=1e-12)
    expected = 20 * (u - x) - 3 * rate
    position = Actuator("p", name, gear, gain=20, stiffness=20, damping=3)
    assert force(position) == pytest.approx(gear * expected, rel=1e-12)
    limited = dataclasses.replace(position, force_range=(-0.01, 0.02))
    assert force(limited) == pytest.approx(gear * (0.02 if expected > 0 else -0.01), rel=1e-12)
    assert force(Actuator("v", name, gear, gain=3, damping=3)) == pytest.approx(gear * 3 * (u - rate), rel=1e-12)
    assert force(Actuator("c", name, gear, control_range=(-0.2, 0.2))) == pytest.approx(gear * 0.2, rel=1e-12)
    assert force(Actuator("b", name, gear, bias=-0.4)) == pytest.approx(gear * (u - 0.4), rel=1e-12)
    both = force(position, Actuator.motor("m", name, gear))
    assert both == pytest.approx(gear * (expected + u), rel=1e-12)


def test_actuators_without_control_get_zero() -> None:
    """control None is u = 0: a motor gives nothing, a position servo pulls to x = 0."""
    s = situation(0)
    a = s.articulation
    name, column = a.joint_names[int(a.topology.scalar_joint[0])], int(a.topology.scalar_q[0])
    bank = Actuators.from_list(a, [Actuator.motor("m", name), Actuator.position("p", name, kp=5.0)])
    residual = dataclasses.replace(s, control=None).balance([bank], s.q).residual
    assert float(residual[a.topology.scalar_v[0]]) == pytest.approx(5.0 * float(s.q[column]), rel=1e-12)


def test_damping_of_a_free_spin() -> None:
    """Damping of a ball or free joint: torque −c ω for the average angular velocity ω = log(R_nᵀR)/Δt about the body's axes."""
    articulation, _ = one_body(Point(), None)
    s = dataclasses.replace(situation(0), articulation=articulation)
    before = pose((0.0, 0.0, 0.0), (0.2, -0.1, 0.5))
    step = torch.tensor([0.1, 0.0, -0.2, 0.3, -0.4, 0.2], dtype=torch.float64)
    after = retract(articulation, before, step)
    moving = dataclasses.replace(s, state=state_of(before, before), q=after, control=None)
    damping = torch.tensor([2.0, 2.0, 2.0, 0.5, 0.5, 0.5], dtype=torch.float64)
    residual = moving.balance([JointDamping(damping)], after).residual
    torch.testing.assert_close(residual, damping * step / float(s.dt), rtol=1e-12, atol=1e-12)


# Bad parameters -------------------------------------------------------------------------------------------------------


def test_joint_coefficients_are_checked() -> None:
    """One number per degree of freedom, finite, ≥ 0, equal about the axes of one rotation; the message says which value failed."""
    a = situation(0).articulation
    good = torch.ones(a.nv, dtype=torch.float64)
    assert torch.equal(checked_coefficient(a, good, "damping"), good)
    uneven = good.clone()
    uneven[a.topology.turning_v[0, 1]] = 2.0
    for bad, words in ((good[:-1], "shape"), (-good, "≥ 0"), (good * math.nan, "finite"), (uneven, "rotation axes")):
        with pytest.raises(InputError, match=words):
            checked_coefficient(a, bad, "damping")


def test_derivative_of_a_known_function() -> None:
    """The checker itself: ∂ sin(x)/∂x = cos(x) to 1e-11, and with a kink 3e-4 away from the point as well."""
    x = torch.tensor([0.3, -1.2], dtype=torch.float64)

    def smooth(delta: Tensor) -> Tensor:
        return torch.sin(5 * (x + delta))

    def kinked(delta: Tensor) -> Tensor:
        return torch.sin(5 * (x + delta)) + (delta - 3e-4).clamp_min(0)

    expected = torch.diag(5 * torch.cos(5 * x))
    assert float((derivative(smooth, 2) - expected).abs().max()) <= 1e-11
    assert float((derivative(kinked, 2) - expected).abs().max()) <= 1e-9
