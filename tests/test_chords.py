"""Loads that a step feels on its way: inertia on the chord, and springs, damping and servos taken at a share of the step."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.balance.chords import ChordBalance
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.fitted import Fittable, Fitted, fit, fitted
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_springs import JointDamping, JointSprings
from pbfd_torch.terms.load import ChordLoad, StepContext
from pbfd_torch.tree.articulation import JointKind
from pbfd_torch.tree.kinematics import Chord, local_twists, place, retract
from pbfd_torch.tree.rotations import skew
from tests.bodies import on_world
from tests.finite_differences import derivative, jacobian, relative_error
from tests.random_trees import SEEDS, generator, random_q
from tests.states import state_of
from tests.term_cases import Situation, actuators, coefficients, situation

all_trees = pytest.mark.parametrize("seed", [*SEEDS, 3])
all_shares = pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 1.0])


def context(s: Situation, share: float, q: Tensor) -> StepContext:
    """The situation's step with inertia at a share of the chord, for worlds like those of q."""
    return dataclasses.replace(s.context(q), share=q.new_full(q.shape[:-1], share))


def on_chord(s: Situation, share: float, q: Tensor) -> ChordBalance:
    """What inertia does there."""
    load = Inertia().load(Inertia().prepare(context(s, share, q)), place(s.articulation, q))
    assert isinstance(load, ChordLoad)
    return ChordBalance(load)


# Inertia on the chord -------------------------------------------------------------------------------------------------


@all_shares
@all_trees
def test_residual_is_the_virtual_work_on_the_chord(seed: int, share: float) -> None:
    """r_i = κ Σ tr(D S (ŝ̄_i T̄)ᵀ) over the links that dof i moves, link by link: T̄ and the axis' frame N̄ are a share of the way in a
    straight line, ŝ̄_i = [ω̄]x + v̄ with ω̄ = N̄ ω, v̄ = N̄ v + p̄ × ω̄. To 1e-12."""
    s = situation(seed)
    a, t = s.articulation, s.articulation.topology
    step, end = context(s, share, s.q), place(s.articulation, s.q)
    nodes, poses = (x + share * (y - x) for x, y in ((step.previous.nodes, end.nodes), (step.previous.poses, end.poses)))
    lag = step.weight * (end.poses - step.target_poses) @ a.pseudo_inertia
    expected = torch.zeros(a.nv, dtype=torch.float64)
    for i in range(a.nv):
        frame, local = nodes[t.dof_node[i]], local_twists(a)[i]
        omega = frame[:3, :3] @ local[:, 0]
        twist = torch.zeros(4, 4, dtype=torch.float64)
        twist[:3, :3] = skew(omega)
        twist[:3, 3] = frame[:3, :3] @ local[:, 1] + torch.linalg.cross(frame[:3, 3], omega)
        for link in t.moves_link[:, i].nonzero().flatten().tolist():
            expected[i] += torch.trace(lag[link] @ (twist @ poses[link]).mT)
    found = on_chord(s, share, s.q).residual
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))


@all_shares
@all_trees
def test_jacobian_on_the_chord(seed: int, share: float) -> None:
    """Stiffness and curvature make up the exact Jacobian in the exponential chart at q, against differences, and are what the
    assembly takes: ≤ 1e-7 relative."""
    s = situation(seed, (2,), turn=0.3)
    expected = jacobian(s.articulation, lambda q: on_chord(s, share, q).residual, s.q)
    chord = on_chord(s, share, s.q)
    assert relative_error(chord.stiffness + chord.curvature, expected) <= 1e-7
    placement = place(s.articulation, s.q)
    balance = Balance(placement, [Inertia().load(Inertia().prepare(context(s, share, s.q)), placement)])
    assert torch.equal(balance.residual, chord.residual)
    assert torch.equal(balance.jacobian, chord.stiffness + chord.curvature)
    assert torch.equal(balance.stiffness, chord.stiffness)


@all_trees
def test_end_of_the_chord_is_the_end_of_the_step(seed: int) -> None:
    """At w = 1 residual, stiffness and Jacobian are the paper's, those of κ/2 Σ tr(D S Dᵀ). To 1e-12."""
    s = situation(seed, (2,))
    paper, chord = s.balance([Inertia()], s.q), on_chord(s, 1.0, s.q)
    whole = chord.stiffness + chord.curvature
    pairs = ((chord.residual, paper.residual), (chord.stiffness, paper.stiffness), (whole, paper.jacobian))
    for found, expected in pairs:
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))


@all_trees
def test_chord_that_does_not_move(seed: int) -> None:
    """From a pose to itself: T̄ and the axes are those of the pose at every share, and without a force there is no curvature."""
    s = situation(seed)
    still = dataclasses.replace(s, state=state_of(s.q, s.q), gravity=torch.zeros(3, dtype=torch.float64))
    placement = place(s.articulation, s.q)
    chord = Chord(placement, placement, torch.tensor(0.5, dtype=torch.float64))
    torch.testing.assert_close(chord.poses, placement.poses, rtol=0, atol=1e-14)
    torch.testing.assert_close(chord.axes, placement.axes, rtol=0, atol=1e-14)
    balance = on_chord(still, 0.5, s.q)
    size = float(balance.stiffness.abs().max())
    assert float(balance.residual.abs().max()) <= 1e-12 * size
    assert float(balance.curvature.abs().max()) <= 1e-12 * size


# Loads at a share of the step -----------------------------------------------------------------------------------------


def shares(s: Situation) -> Tensor:
    """Random θ in [½, 1) `[nv]`, 1 for rotations."""
    share = 0.5 + 0.5 * torch.rand(s.articulation.nv, dtype=torch.float64, generator=generator(12))
    share[s.articulation.topology.turning_v] = 1.0
    return share


BUILDS: dict[str, Callable[[Situation], Fittable]] = {
    "springs": lambda s: JointSprings(coefficients(s, 20.0), random_q(s.articulation, 17)),
    "damping": lambda s: JointDamping(coefficients(s, 1.0)),
    "actuators": actuators,
}


@pytest.mark.parametrize("name", BUILDS)
@all_trees
def test_taken_at_a_share_of_the_step(seed: int, name: str) -> None:
    """r = ∂E/∂δ and J = ∂r/∂δ by central differences, ≤ 1e-7 relative, with actuators within and beyond their efforts; at θ = 1
    both are those of the term itself."""
    s = situation(seed, (2,))
    term = BUILDS[name](s)
    taken = Fitted(term.taken_at(shares(s)), shares(s))

    def energy(delta: Tensor) -> Tensor:
        q = retract(s.articulation, s.q, delta)
        return taken.energy(taken.prepare(s.context(q)), place(s.articulation, q))

    balance = s.balance([taken], s.q)
    gradient = derivative(energy, s.articulation.nv, (2,))
    assert relative_error(balance.residual[..., None, :], gradient[..., None, :]) <= 1e-7
    expected = jacobian(s.articulation, lambda q: s.balance([taken], q).residual, s.q)
    assert relative_error(balance.jacobian, expected) <= 1e-7
    last, plain = s.balance([term.taken_at(torch.ones_like(shares(s)))], s.q), s.balance([term], s.q)
    torch.testing.assert_close(last.residual, plain.residual, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(last.jacobian, plain.jacobian, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", BUILDS)
def test_slope(name: str) -> None:
    """`slope` is the diagonal of the Jacobian: of springs at their rest, of damping at the start, of actuators within their
    efforts."""
    s = situation(0)
    term = BUILDS[name](s)
    if isinstance(term, JointSprings):
        term = dataclasses.replace(term, rest=s.q)
    if isinstance(term, Actuators):
        strong = torch.tensor([-math.inf, math.inf], dtype=torch.float64)
        term = dataclasses.replace(term, force_range=strong.expand_as(term.force_range))
    still = dataclasses.replace(s, state=state_of(s.q, s.q))
    diagonal = still.balance([term], s.q).jacobian.diagonal()
    torch.testing.assert_close(term.slope(s.articulation, s.dt).expand_as(diagonal), diagonal, rtol=1e-12, atol=1e-12)


def test_fit() -> None:
    """θ(z) = 1/(1 − e^{−z}) − 1/z: ½ at 0, with slope 1/12 there; 1 − 1/z for large z; always rising, without a gap at z = 1e-3
    where its series begins."""
    z = torch.tensor([0.0, 1e-12, 1e-6, 0.5, 1.0, 3.0, 40.0, 1e3, 1e300, math.inf], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(fit(z).sum(), z)
    exact = [0.5 + x / 12 if x < 1e-5 else 1 / (1 - math.exp(-x)) - 1 / x for x in z.tolist()]
    torch.testing.assert_close(fit(z).detach(), torch.tensor(exact, dtype=torch.float64), rtol=1e-14, atol=0)
    assert float(slope[0]) == pytest.approx(1 / 12)
    assert bool((torch.isfinite(slope) & (slope >= 0)).all())
    around = fit(1e-3 * (1 + torch.linspace(-1e-6, 1e-6, 101, dtype=torch.float64)))
    assert float((around - 0.5 - 1e-3 / 12).abs().max()) <= 1e-10
    assert bool((fit(torch.logspace(-8, 8, 200, dtype=torch.float64)).diff() >= -1e-12).all())


def test_fitted_to_all_loads_together() -> None:
    """z sums up over the terms, so that all have one θ; rotations of balls and free joints have 1; other terms stay themselves."""
    s = situation(0)
    a = s.articulation
    inertia, springs, damping = Inertia(), BUILDS["springs"](s), BUILDS["damping"](s)
    first, second, third = fitted(a, [inertia, springs, damping], s.dt)
    assert first is inertia
    assert isinstance(second, Fitted)
    assert isinstance(third, Fitted)
    torch.testing.assert_close(second.share, third.share, rtol=0, atol=0)
    (alone,) = (x for x in fitted(a, [inertia, springs], s.dt) if isinstance(x, Fitted))
    other = ~torch.isin(torch.arange(a.nv), a.topology.turning_v)
    assert bool((alone.share[other] < second.share[other]).all())
    assert bool((second.share[~other] == 1).all())
    assert bool(((alone.share >= 0.5) & (second.share <= 1)).all())
    assert fitted(a, [inertia], s.dt) == [inertia]


# In motion ---------------------------------------------------------------------------------------------------------------


def doubles(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("z", [1e-6, 0.05, 0.5, 5.0])
@pytest.mark.parametrize(("kind", "inertia"), [(JointKind.HINGE, 0.02), (JointKind.SLIDE, 1.0)])
def test_damped_joint(kind: JointKind, inertia: float, z: float) -> None:
    """The velocity that a step starts with falls by e^{−z}, z = Δt c/m, in every step: to 1e-9 of the start."""
    scene = on_world(kind, 1.0, [JointDamping(doubles(z * inertia / 0.1))])
    simulator = Simulator(scene, 0.1, EnergyMomentum(), solver=Descent(tolerance=1e-14))
    state = simulator.initial_state(doubles(0.3), doubles(1e-3))
    for _ in range(4):
        after, _ = simulator.step(state)
        assert float((after.v - math.exp(-z) * state.v).abs()) <= 1e-9 * 1e-3
        state = after


def sprung(servo: bool, stiffness: float) -> Scene:
    """A hinge with an inertia of .02 kg m², held at 0 by a spring or by a position servo."""
    articulation = on_world(JointKind.HINGE, 1.0).articulation
    spring = JointSprings(doubles(stiffness), articulation.rest)
    position = Actuators.from_list(articulation, [Actuator.position("servo", "joint", kp=stiffness)])
    return on_world(JointKind.HINGE, 1.0, [position if servo else spring])


def released(scene: Scene, dt: float, steps: int) -> Rollout:
    """From .3 rad, at rest."""
    simulator = Simulator(scene, dt)
    return simulator.rollout(simulator.initial_state(doubles(0.3)), steps=steps)


both_springs = pytest.mark.parametrize("servo", [False, True], ids=["spring", "servo"])


@both_springs
def test_stiff_spring_does_not_ring(servo: bool) -> None:
    """k = 1e6 N m/rad, Δt .05, z = 1.25e5: a step takes away all but 1/z of the stretch, and no later one gives any back."""
    rollout = released(sprung(servo, 1e6), 0.05, 6)
    q = rollout.q[:, 0].abs()
    assert float(q[1]) <= 2 / 1.25e5 * 0.3
    assert bool((q[3:] <= q[1:-2].clamp_min(1e-12)).all())
    assert bool(rollout.solved.all())


@both_springs
def test_soft_spring_swings(servo: bool) -> None:
    """q = q_0 cos(ωt), ω = 10 rad/s, over a period: to second order in Δt, the energy within 1 %."""
    errors = []
    for dt in (0.01, 0.005):
        rollout = released(sprung(servo, 2.0), dt, round(0.63 / dt))
        q, v = rollout.q[:, 0], rollout.v[:, 0]
        errors.append(float((q - 0.3 * torch.cos(10 * rollout.time)).abs().max()))
        energy = 0.5 * 0.02 * v * v + 0.5 * 2.0 * q * q
        assert float((energy / energy[0] - 1).abs().max()) <= 0.01
    assert errors[0] <= 0.01 * 0.3
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.4)
