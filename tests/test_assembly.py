"""Residual and Jacobian of whole trees: against differences, sums over mass points differentiated automatically, virtual work."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.load import LinkLoad, Term
from pbfd_torch.tree.articulation import force_scale
from pbfd_torch.tree.kinematics import link_jacobians, place, retract, subtree_sum
from tests.finite_differences import jacobian, relative_error
from tests.point_bodies import point_bodies
from tests.random_trees import SEEDS, generator, moved_q, random_q, random_tree
from tests.states import state_of
from tests.term_cases import ROUND, SLIDING, STICKING, Situation, actuators, coefficients, contact, dry_torque, no_load, situation

all_trees = pytest.mark.parametrize("seed", [*SEEDS, 3])


def everything(s: Situation, friction: CoulombFriction) -> list[Term]:
    """All effects at once, with two contacts."""
    return [
        Inertia(),
        contact(s, friction),
        contact(s, friction, 2.5, ROUND),
        JointLimits(coefficients(s, 50.0), math.inf),
        JointDamping(coefficients(s, 1.0)),
        Armature(coefficients(s, 0.1)),
        JointSprings(coefficients(s, 20.0), random_q(s.articulation, 17)),
        JointDryFriction(dry_torque(s), 50.0),
        actuators(s),
    ]


@all_trees
@pytest.mark.parametrize("friction", [STICKING, SLIDING], ids=["sticking", "sliding"])
def test_jacobian_of_a_whole_step(seed: int, friction: CoulombFriction) -> None:
    """J = ∂r/∂θ of one implicit-Euler step with everything on, as a solver sees it, against differences: ≤ 1e-7 relative."""
    s = situation(seed, (2,))
    terms = everything(s, friction)

    def objective(q: Tensor) -> BalanceObjective:
        return BalanceObjective.of_step(s.articulation, terms, s.context(q), force_scale(s.articulation, 9.81))

    expected = jacobian(s.articulation, lambda q: objective(q).evaluate(q).residual, s.q)
    balance = objective(s.q).evaluate(s.q)
    assert relative_error(balance.jacobian, expected) <= 1e-7
    asymmetry = relative_error(balance.jacobian.mT, balance.jacobian)
    assert asymmetry > 1e-6  # friction has no energy


@all_trees
@pytest.mark.parametrize("exponent", [2.0, 2.5])
def test_conservative_part_is_gradient_and_hessian_of_a_sum_over_points(seed: int, exponent: float) -> None:
    """r = ∇E and J = ∇²E in the exponential chart, ≤ 1e-9 relative, for E written over the mass points of all links (Eq. 6, 8, 9):
    E = Σ m_i ‖p_i − 2p_i^n + p_i^{n−1} − Δt² g‖²/(2Δt²) + Σ C⊥ d^{α+1}/(α + 1) + Σ k x³/3 + ½ Σ k (q − rest)²."""
    bodies = point_bodies(seed)
    base = situation(seed)
    a = dataclasses.replace(bodies.articulation, lower=base.articulation.lower, upper=base.articulation.upper)
    bodies = dataclasses.replace(bodies, articulation=a)
    s = dataclasses.replace(base, articulation=a)
    t = a.topology
    made, limits = contact(s, None, exponent), JointLimits(coefficients(s, 50.0), math.inf)
    scalar = torch.zeros(a.nv, dtype=torch.float64)
    scalar[t.scalar_v] = 20.0
    springs = JointSprings(scalar, a.rest)
    target = 2 * bodies.points(s.state.q) - bodies.points(s.state.q_previous) + s.dt**2 * s.gravity

    def energy(delta: Tensor) -> Tensor:
        q = retract(a, s.q, delta)
        lag = bodies.points(q) - target
        total = (bodies.masses[..., None] * lag * lag).sum() / (2 * s.dt**2)
        poses = place(a, q).poses[made.link]
        centers = (poses[:, :3, :3] @ made.position[..., None]).squeeze(-1) + poses[:, :3, 3]
        depth = (-made.surface.field(centers).distance).clamp_min(0)
        total = total + 1e4 * (depth ** (exponent + 1)).sum() / (exponent + 1)
        x = q[t.scalar_q]
        above, below = (x - a.upper[t.scalar_v]).clamp_min(0), (a.lower[t.scalar_v] - x).clamp_min(0)
        total = total + (limits.stiffness[t.scalar_v] * (above**3 + below**3)).sum() / 3
        return total + 0.5 * 20.0 * (x - a.rest[t.scalar_q]).square().sum()

    zero = torch.zeros(a.nv, dtype=torch.float64)
    balance = s.balance([Inertia(), made, limits, springs], s.q)
    gradient, hessian = torch.func.grad(energy)(zero), torch.func.hessian(energy)(zero)
    assert float((balance.residual - gradient).abs().max()) <= 1e-9 * float(gradient.abs().max())
    assert relative_error(balance.jacobian, hessian) <= 1e-9


@all_trees
def test_residual_is_minus_the_virtual_work(seed: int) -> None:
    """A force f at point p of link b gives r = −(∂p/∂θ)ᵀ f; forces on several links add up."""
    articulation = random_tree(seed)
    q = random_q(articulation, seed, (2,))
    placement = place(articulation, q)
    random = generator(31)
    force, point = torch.randn(2, 2, articulation.nlink, 3, dtype=torch.float64, generator=random)
    moment = -torch.cat((force[..., :, None] * point[..., None, :], force[..., None]), -1)
    load = LinkLoad(moment, lambda: no_load(placement).stiffness)
    jacobians = link_jacobians(placement)  # (ω, v at the origin) per dof
    velocity = jacobians[..., 3:, :] + torch.linalg.cross(
        jacobians[..., :3, :], point[..., None].expand_as(jacobians[..., :3, :]), dim=-2
    )
    expected = -(velocity.mT @ force[..., None]).squeeze(-1).sum(-2)
    torch.testing.assert_close(Balance(placement, [load]).residual, expected, rtol=1e-12, atol=1e-12)


@all_trees
def test_subtree_sum(seed: int) -> None:
    """A joint carries the loads of all links above it in the chain of parents, and no other."""
    articulation = random_tree(seed)
    t = articulation.topology
    placement = place(articulation, random_q(articulation, seed))
    random = generator(32)
    moment = torch.randn(articulation.nlink, 3, 4, dtype=torch.float64, generator=random)
    found = subtree_sum(placement, moment)
    for joint in range(t.njoint):
        carried = []
        for link, node in enumerate(t.link_node):
            at = node
            while at not in (0, joint + 1):
                at = t.joint_parent[at - 1]
            if at == joint + 1:
                carried.append(link)
        torch.testing.assert_close(found[joint], moment[carried].sum(0), rtol=1e-12, atol=1e-12)


@all_trees
def test_stiffness_is_the_jacobian_where_no_force_acts(seed: int) -> None:
    """B, the curvature of the tree, is linear in the forces: at T = T̂ (no inertial force) J equals its stiffness part."""
    s = situation(seed)
    still = dataclasses.replace(s, gravity=torch.zeros(3, dtype=torch.float64))
    still = dataclasses.replace(still, state=state_of(s.q, s.q))
    balance = still.balance([Inertia()], s.q)
    size = float(balance.jacobian.abs().max())
    assert float(balance.residual.abs().max()) <= 1e-12 * size
    torch.testing.assert_close(balance.jacobian, balance.stiffness, rtol=0, atol=1e-12 * size)


@all_trees
def test_newton_converges_quadratically(seed: int) -> None:
    """With the exact J, ‖r_{k+1}‖ = C ‖r_k‖² near the root: the C of one step bounds the next one, down to rounding."""
    s = situation(seed)
    a = s.articulation
    before = moved_q(a, s.state.q, seed + 9, 1e-3)
    terms: list[Term] = [Inertia(), JointSprings(coefficients(s, 20.0), s.state.q), Armature(coefficients(s, 0.01))]
    context = ImplicitEuler().context(a, state_of(s.state.q, before), s.dt, s.gravity, None)
    objective = BalanceObjective.of_step(a, terms, context, force_scale(a, 9.81))
    q, norms = s.state.q, []
    for _ in range(5):
        balance = objective.evaluate(q)
        norms.append(float((balance.residual / objective.scale).norm()))
        q = objective.retract(q, -torch.linalg.solve(balance.jacobian, balance.residual))
    assert norms[2] <= 1e-2 * norms[1]
    assert norms[3] <= 10 * norms[2] / norms[1] ** 2 * norms[2] ** 2 + 1e-12
    assert norms[4] <= 1e-12
