"""Bodies and chains in free motion against closed forms and conservation laws. Every test states its equation."""

from __future__ import annotations

import pytest
import torch

from pbfd_torch.balance.dynamics import center_of_mass
from pbfd_torch.models.chains import chain_free
from pbfd_torch.models.spinning import dzhanibekov
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import place
from tests.bodies import at, box_inertia, diagonal, down, free_body, rises, rolled_out
from tests.random_trees import generator, random_inertia
from tests.setup_runs import metric, run
from tests.states import implicit


@pytest.mark.parametrize("turn", [0.01, 0.3, 1.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rotation_oracle(seed: int, turn: float) -> None:
    """One implicit-Euler step of a free body without potential: Eq. 5 is least at R = polar((2R_n − R_{n−1}) J), J = ∫ρ x xᵀ about
    the centre of mass, which itself goes straight on, c = 2c_n − c_{n−1}: to 1e-12. The COM is not at the link's origin."""
    random = generator(seed)
    rows = random_inertia(random, 1.7)
    link = Link("body", joints=(Joint("free", JointKind.FREE),), mass=1.7, com=(0.2, -0.1, 0.3), inertia=rows)
    articulation = Articulation.from_links([link])
    scene = Scene(articulation, (Inertia(),), torch.zeros(3, dtype=torch.float64))
    simulator = implicit(scene, 0.1, solver=Descent(tolerance=1e-13))
    v = torch.randn(6, dtype=torch.float64, generator=random)
    v[3:] *= turn / 0.1 / torch.linalg.vector_norm(v[3:])
    state = simulator.initial_state(at(0.5, (0.3, 0.2, -0.7)), v)
    after, solution = simulator.step(state)
    assert bool(solution.solved)
    before, now, then = (place(articulation, q) for q in (state.q_previous, state.q, after.q))
    inertia = torch.tensor(rows, dtype=torch.float64)
    second = 0.5 * torch.trace(inertia) * torch.eye(3, dtype=torch.float64) - inertia
    ahead = 2 * now.poses[0, :3, :3] - before.poses[0, :3, :3]
    u, _, vh = torch.linalg.svd(ahead @ second)
    polar = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.sign(torch.linalg.det(u @ vh)))], dtype=torch.float64)) @ vh
    assert float((then.poses[0, :3, :3] - polar).abs().max()) <= 1e-12
    straight = 2 * center_of_mass(now) - center_of_mass(before)
    assert float((center_of_mass(then) - straight).abs().max()) <= 1e-12


@pytest.mark.parametrize("dt", [0.005, 0.02, 0.1, 0.25])
def test_projectile(dt: float) -> None:
    """p(t) = p_0 + v t + ½ g t² at every grid point, to 1e-9 from the second-order start at any step, while the body spins."""
    articulation = free_body(2.0, diagonal(0.1, 0.2, 0.25))
    v = torch.tensor([1.0, -2.0, 3.0, 0.5, -0.3, 0.8], dtype=torch.float64)
    rollout = rolled_out(Scene(articulation, (Inertia(),), down()), dt, 1.0, at(0.4), v)
    t = rollout.time[:, None]
    exact = at(0.4)[:3] + t * v[:3] + 0.5 * t * t * down()
    assert bool(rollout.solved.all())
    assert float((rollout.center_of_mass - exact).abs().max()) <= 1e-9
    assert float(rollout.time[-1]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("turn", [0.05, 0.5, 1.5])
def test_spin_down_of_the_scheme(turn: float) -> None:
    """About a principal axis the paper's integrator slows a spin by Δ' = atan2(sin Δ, 2 − cos Δ), Δ the turn per step: energy is
    lost at order Δt, and nothing else happens."""
    articulation = free_body(1.0, diagonal(0.1, 0.2, 0.25))
    scene = Scene(articulation, (Inertia(),), torch.zeros(3, dtype=torch.float64))
    v = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, turn / 0.05], dtype=torch.float64)
    rollout = rolled_out(scene, 0.05, 0.5, at(0.0), v)
    turned = rollout.v[:, 3:] * 0.05
    assert float(turned[:, :2].abs().max()) <= 1e-12
    expected = torch.atan2(torch.sin(turned[:-1, 2]), 2 - torch.cos(turned[:-1, 2]))
    assert float((turned[1:, 2] - expected).abs().max()) <= 1e-11


@pytest.mark.parametrize("dt", [0.01, 0.1])
def test_linear_momentum_of_a_free_chain(dt: float) -> None:
    """Σ m v is constant without external force: relative drift < 1e-10 over 2 s; energy never rises; every step solved."""
    setup = chain_free()
    rollout = run(setup, dt, 2.0)
    assert bool(rollout.solved.all())
    assert metric(setup, rollout, "linear_momentum_drift")[0] < 1e-10
    assert rises(rollout.energy) <= 1e-9 * float(rollout.energy[0])


def test_linear_momentum_under_internal_torques() -> None:
    """Random motor torques inside a free chain move its parts and not its centre of mass: drift of Σ m v < 1e-8 m v over .5 s."""
    setup = chain_free()
    articulation = setup.scene.articulation
    motors = Actuators.from_list(articulation, [Actuator.motor(n, n) for n in articulation.joint_names[1:]])
    simulator = implicit(Scene(articulation, (Inertia(), motors), setup.scene.gravity), 0.01)
    controls = 0.02 * torch.randn(50, 1, motors.nu, dtype=torch.float64, generator=generator(3))
    rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), controls)
    linear = rollout.linear_momentum
    assert bool(rollout.solved.all())
    assert float((linear - linear[:1]).abs().max() / linear[0].abs().max()) < 1e-8
    assert float((rollout.q[-1, 0, 7:] - rollout.q[0, 0, 7:]).abs().max()) > 0.1


def test_dzhanibekov() -> None:
    """A T-shaped body turning about its middle axis, no force: the COM stays (drift < 1e-12 m) and energy never rises."""
    setup = dzhanibekov()
    rollout = run(setup, 1 / 240, 1.5)
    assert bool(rollout.solved.all())
    assert float((rollout.center_of_mass - rollout.center_of_mass[:1]).abs().max()) < 1e-12
    assert rises(rollout.energy) <= 1e-12 * float(rollout.energy[0])


def test_tumbling_box() -> None:
    """Half sizes .1, .2, .3 m, ω = (1, 2, 3) rad/s, Δt .01: energy never rises, the angular momentum keeps its direction."""
    half = (0.1, 0.2, 0.3)
    scene = Scene(free_body(1.0, box_inertia(1.0, half)), (Inertia(),), torch.zeros(3, dtype=torch.float64))
    rollout = rolled_out(scene, 0.01, 2.0, at(0.0), torch.tensor([0.0, 0.0, 0.0, 1.0, 2.0, 3.0], dtype=torch.float64))
    assert rises(rollout.energy) <= 1e-12 * float(rollout.energy[0])
    start, end = rollout.angular_momentum[0], rollout.angular_momentum[-1]
    cosine = float(start @ end / torch.linalg.vector_norm(start) / torch.linalg.vector_norm(end))
    assert cosine > 0.99
