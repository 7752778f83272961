"""Every term: exact Jacobians, energies, no load where there is nothing, invariance, worlds apart."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.shapes import Point
from pbfd_torch.contact.surface import Plane
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import JointSprings
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.tree.articulation import homogeneous
from pbfd_torch.tree.kinematics import place, retract
from pbfd_torch.tree.rotations import quaternion_exp, quaternion_matrix, quaternion_multiply
from tests.finite_differences import jacobian, relative_error
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
