"""Mass matrix, inverse dynamics, energy and momentum against sums over mass points; torques read off a solved step."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import (
    bias_force,
    center_of_mass,
    inverse_dynamics,
    kinetic_energy,
    mass_matrix,
    momentum,
    potential_energy,
    rotor_energy,
)
from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_springs import Armature, JointDamping
from pbfd_torch.terms.load import Term
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import Motion, difference, link_jacobians, place, retract
from pbfd_torch.tree.rotations import quaternion_matrix
from tests.point_bodies import PointBodies, point_bodies
from tests.random_trees import SEEDS, generator, random_links, random_q, random_tree
from tests.states import implicit

all_trees = pytest.mark.parametrize("seed", [*SEEDS, 3])
GRAVITY = torch.tensor([0.4, -0.2, -9.81], dtype=torch.float64)


def tangents(nv: int, count: int, seed: int, batch: tuple[int, ...] = ()) -> Tensor:
    return torch.randn(count, *batch, nv, dtype=torch.float64, generator=generator(seed))


def point_motion(bodies: PointBodies, q: Tensor, v: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
    """ṗ and p̈ of all points along q(t) = q ⊕ (t v + ½ t² a) at t = 0, by automatic differentiation."""

    def points(t: Tensor) -> Tensor:
        return bodies.points(retract(bodies.articulation, q, t * v + 0.5 * t * t * acceleration))

    zero, one = torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)

    def velocity(t: Tensor) -> Tensor:
        return torch.func.jvp(points, (t,), (one,))[1]

    first, second, *_ = torch.func.jvp(velocity, (zero,), (one,))
    return first, second


def point_jacobian(bodies: PointBodies, q: Tensor) -> Tensor:
    """∂p/∂θ `[nlink, npoint, 3, nv]`, by automatic differentiation."""
    zero = torch.zeros(bodies.articulation.nv, dtype=torch.float64)
    return torch.func.jacfwd(lambda delta: bodies.points(retract(bodies.articulation, q, delta)))(zero)


@all_trees
def test_mass_matrix_is_symmetric_and_positive(seed: int) -> None:
    """M = Mᵀ to rounding, and vᵀMv > 0, in a batch as alone."""
    articulation = random_tree(seed)
    q = random_q(articulation, seed, (4,))
    matrix = mass_matrix(articulation, q)
    size = float(matrix.abs().max())
    assert float((matrix - matrix.mT).abs().max()) <= 1e-13 * size
    assert float(torch.linalg.eigvalsh(matrix).min()) > 1e-4
    torch.testing.assert_close(mass_matrix(articulation, q[1]), matrix[1], rtol=0, atol=1e-13 * size)


@all_trees
def test_mass_matrix_is_the_sum_over_links(seed: int) -> None:
    """M = Σ_b m_b J_vᵀJ_v + J_ωᵀ R I_com Rᵀ J_ω, J_v taken at the centre of mass, from the links' own description."""
    links = random_links(seed)
    articulation = random_tree(seed)
    q = random_q(articulation, seed)
    placement = place(articulation, q)
    jacobians = link_jacobians(placement)
    expected = torch.zeros(articulation.nv, articulation.nv, dtype=torch.float64)
    for k, link in enumerate(links):
        pose = placement.poses[k, :3]
        com = pose[:, :3] @ torch.tensor(link.com, dtype=torch.float64) + pose[:, 3]
        turning, moving = jacobians[k, :3], jacobians[k, 3:]
        at_com = moving + torch.linalg.cross(turning, com[:, None].expand_as(turning), dim=0)
        inertia = pose[:, :3] @ torch.tensor(link.inertia, dtype=torch.float64) @ pose[:, :3].T
        expected += link.mass * at_com.T @ at_com + turning.T @ inertia @ turning
    torch.testing.assert_close(mass_matrix(articulation, q), expected, rtol=0, atol=1e-12 * float(expected.abs().max()))


@all_trees
def test_mass_matrix_and_inverse_dynamics_from_mass_points(seed: int) -> None:
    """M = Σ m_i J_iᵀJ_i and τ = Σ m_i J_iᵀ (p̈_i − g), with J_i, p̈_i of every mass point by automatic differentiation: ≤ 1e-11."""
    bodies = point_bodies(seed)
    a = bodies.articulation
    q = random_q(a, seed)
    v, acceleration = tangents(a.nv, 2, seed)
    jacobians = point_jacobian(bodies, q)
    weighted = bodies.masses[..., None, None] * jacobians
    matrix = torch.einsum("bpxi,bpxj->ij", weighted, jacobians)
    torch.testing.assert_close(mass_matrix(a, q), matrix, rtol=0, atol=1e-12 * float(matrix.abs().max()))
    _, second = point_motion(bodies, q, v, acceleration)
    expected = torch.einsum("bpxi,bpx->i", weighted, second - GRAVITY)
    torque = inverse_dynamics(a, q, v, acceleration, GRAVITY)
    torch.testing.assert_close(torque, expected, rtol=0, atol=1e-11 * float(expected.abs().max()))
    _, drift = point_motion(bodies, q, v, torch.zeros_like(v))
    bias = torch.einsum("bpxi,bpx->i", weighted, drift - GRAVITY)
    torch.testing.assert_close(bias_force(a, q, v, GRAVITY), bias, rtol=0, atol=1e-11 * float(bias.abs().max()))


@all_trees
def test_energy_and_momentum_from_mass_points(seed: int) -> None:
    """½ Σ m ṗ², Σ m ṗ, Σ m (p − c) × ṗ, c = Σ m p/Σ m and −Σ m g·p; kinetic energy is also ½ vᵀMv."""
    bodies = point_bodies(seed)
    a = bodies.articulation
    q = random_q(a, seed)
    (v,) = tangents(a.nv, 1, seed)
    velocity, _ = point_motion(bodies, q, v, torch.zeros_like(v))
    mass, position = bodies.masses[..., None], bodies.points(q)
    com = (mass * position).sum((0, 1)) / mass.sum()
    placement = place(a, q)
    rates = Motion(placement, v).rates
    linear, angular = momentum(placement, rates)
    energy = 0.5 * (mass * velocity * velocity).sum()
    pairs = [
        (center_of_mass(placement), com),
        (kinetic_energy(a, rates), energy),
        (0.5 * v @ mass_matrix(a, q) @ v, energy),
        (linear, (mass * velocity).sum((0, 1))),
        (angular, (mass * torch.linalg.cross(position - com, velocity)).sum((0, 1))),
        (potential_energy(placement, GRAVITY), -(mass * position * GRAVITY).sum()),
    ]
    for found, expected in pairs:
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


@all_trees
def test_power_balance(seed: int) -> None:
    """d/dt (kinetic + potential) = τ·v along any motion, with τ from inverse dynamics."""
    articulation = random_tree(seed)
    q = random_q(articulation, seed)
    v, acceleration = tangents(articulation.nv, 2, seed)
    torque = inverse_dynamics(articulation, q, v, acceleration, GRAVITY)

    def energy(t: Tensor) -> Tensor:
        placement = place(articulation, retract(articulation, q, t * v))  # v̇ enters the kinetic energy only
        rates = Motion(placement, v + t * acceleration).rates
        return kinetic_energy(articulation, rates) + potential_energy(placement, GRAVITY)

    _, power, *_ = torch.func.jvp(energy, (torch.zeros((), dtype=torch.float64),), (torch.ones((), dtype=torch.float64),))
    assert float(power) == pytest.approx(float(torque @ v), rel=1e-11)


@all_trees
def test_armature_adds_to_the_diagonal(seed: int) -> None:
    """M + diag(armature); its energy is ½ Σ a v²; several armatures add up."""
    articulation = random_tree(seed)
    q = random_q(articulation, seed)
    (v,) = tangents(articulation.nv, 1, seed)
    armature = torch.linspace(0.1, 1.0, articulation.nv, dtype=torch.float64)
    terms: list[Term] = [Armature(armature), Inertia(), Armature(armature)]
    expected = mass_matrix(articulation, q) + torch.diag(2 * armature)
    assert torch.equal(mass_matrix(articulation, q, terms), expected)
    assert float(rotor_energy(articulation, v, terms)) == pytest.approx(float((armature * v * v).sum()), rel=1e-13)


@all_trees
def test_inverse_dynamics_per_world(seed: int) -> None:
    """A batch `[2, 3]` with one gravity per world gives what each world gives alone."""
    articulation = random_tree(seed)
    q = random_q(articulation, seed, (2, 3))
    v, acceleration = tangents(articulation.nv, 2, seed, (2, 3))
    gravity = GRAVITY * torch.linspace(0.1, 2.0, 6, dtype=torch.float64).view(2, 3, 1)
    whole = inverse_dynamics(articulation, q, v, acceleration, gravity)
    alone = inverse_dynamics(articulation, q[1, 2], v[1, 2], acceleration[1, 2], gravity[1, 2])
    assert whole.shape == (2, 3, articulation.nv)
    torch.testing.assert_close(whole[1, 2], alone, rtol=0, atol=1e-11 * float(alone.abs().max()))


@all_trees
def test_torque_is_read_off_the_solved_step(seed: int) -> None:
    """At the solved motion the residual without actuators equals the applied generalised force gear · u: to 1e-8 relative. The
    pseudo-forces that the step balances are those of Eq. 5."""
    articulation = random_tree(seed)
    t = articulation.topology
    names = [articulation.joint_names[int(j)] for j in t.scalar_joint]
    motors = Actuators.from_list(articulation, [Actuator.motor(f"m{k}", name, gear=1.0 + k) for k, name in enumerate(names)])
    passive: list[Term] = [Inertia(), JointDamping(torch.full((articulation.nv,), 0.1, dtype=torch.float64))]
    scene = Scene(articulation, (*passive, motors), GRAVITY)
    simulator = implicit(scene, 0.01, solver=Descent(tolerance=1e-12))
    (v,) = tangents(articulation.nv, 1, seed)
    control = torch.linspace(-2.0, 3.0, motors.nu, dtype=torch.float64)
    state = simulator.initial_state(random_q(articulation, seed), 0.3 * v, control)
    after, solution = simulator.step(state, control)
    assert bool(solution.solved)
    context = simulator.integrator.context(articulation, state, torch.tensor(0.01, dtype=torch.float64), GRAVITY, None)
    residual = BalanceObjective.of_step(articulation, passive, context, torch.ones(())).evaluate(after.q).residual
    applied = torch.zeros(articulation.nv, dtype=torch.float64)
    applied[t.scalar_v] = control * torch.arange(1.0, motors.nu + 1, dtype=torch.float64)
    scale = float(applied.abs().max())
    assert float((residual - applied).abs().max()) <= 1e-8 * scale


def test_short_steps_obey_inverse_dynamics() -> None:
    """τ(q, v, (v_{n+1} − v_n)/Δt) → applied torque as Δt → 0: the scheme solves M v̇ + h = τ up to O(Δt), which halves with Δt."""
    articulation = random_tree(1)
    t = articulation.topology
    names = [articulation.joint_names[int(j)] for j in t.scalar_joint]
    motors = Actuators.from_list(articulation, [Actuator.motor(f"m{k}", name) for k, name in enumerate(names)])
    scene = Scene(articulation, (Inertia(), motors), GRAVITY)
    control = torch.linspace(-2.0, 3.0, motors.nu, dtype=torch.float64)
    applied = torch.zeros(articulation.nv, dtype=torch.float64)
    applied[t.scalar_v] = control
    (v,) = tangents(articulation.nv, 1, 1)
    errors = []
    for dt in (2e-4, 1e-4, 5e-5):
        simulator = implicit(scene, dt, solver=Descent(tolerance=1e-12))
        state = simulator.initial_state(random_q(articulation, 1), 0.3 * v, control)
        after, _ = simulator.step(state, control)
        before = difference(articulation, state.q_previous, state.q) / dt
        now = difference(articulation, state.q, after.q) / dt
        torque = inverse_dynamics(articulation, state.q, 0.5 * (before + now), (now - before) / dt, GRAVITY)
        errors.append(float((torque - applied).abs().max()))
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.4)
    assert errors[1] / errors[2] == pytest.approx(2.0, abs=0.4)


def test_free_body_by_hand() -> None:
    """A free body: τ_translation = m (v̇ − g), and about its COM τ_rotation = I ω̇ + ω × I ω in its own axes (Newton–Euler)."""
    rows = ((0.3, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.7))
    body = Articulation.from_links([Link("b", joints=(Joint("f", JointKind.FREE),), mass=2.0, inertia=rows)])
    q = random_q(body, 5)
    v, acceleration = tangents(6, 2, 9)
    torque = inverse_dynamics(body, q, v, acceleration, GRAVITY)
    inertia = torch.tensor(rows, dtype=torch.float64)
    spin = inertia @ acceleration[3:] + torch.linalg.cross(v[3:], inertia @ v[3:])
    torch.testing.assert_close(torque[:3], 2.0 * (acceleration[:3] - GRAVITY), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(torque[3:], spin, rtol=1e-12, atol=1e-12)
    placement = place(body, q)
    _, angular = momentum(placement, Motion(placement, v).rates)
    torch.testing.assert_close(angular, quaternion_matrix(q[3:]) @ inertia @ v[3:], rtol=1e-12, atol=1e-12)


def test_one_configuration_with_many_masses() -> None:
    """q `[nq]` with pseudo-inertia `[3, nlink, 4, 4]` gives three mass matrices, proportional to the masses."""
    articulation = random_tree(2)
    q = random_q(articulation, 2)
    scale = torch.tensor([1.0, 2.0, 5.0], dtype=torch.float64)
    heavier = dataclasses.replace(articulation, pseudo_inertia=scale[:, None, None, None] * articulation.pseudo_inertia)
    matrices = mass_matrix(heavier, q)
    torch.testing.assert_close(matrices, scale[:, None, None] * mass_matrix(articulation, q), rtol=1e-13, atol=1e-13)


def test_parameters_carry_gradients() -> None:
    """∂M/∂(mass scale) = M: inverse dynamics is linear in the pseudo-inertias, and they carry gradients."""
    articulation = random_tree(0)
    q = random_q(articulation, 0)
    v, acceleration = tangents(articulation.nv, 2, 0)

    def torque(scale: Tensor) -> Tensor:
        heavier = dataclasses.replace(articulation, pseudo_inertia=scale * articulation.pseudo_inertia)
        return inverse_dynamics(heavier, q, v, acceleration, GRAVITY)

    slope = torch.func.jacrev(torque)(torch.ones((), dtype=torch.float64))
    torch.testing.assert_close(slope, inverse_dynamics(articulation, q, v, acceleration, GRAVITY), rtol=1e-11, atol=1e-11)
