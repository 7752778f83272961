"""Steps without a sound derivative: reported, damped or refused; and derivatives that are blurred."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Simulator
from pbfd_torch.contact.shapes import Sphere
from pbfd_torch.errors import GradientError, GradientWarning, InputError
from pbfd_torch.gradients.implicit import Blur, Doubt, Doubtful, Gradients
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import AdaptiveSimulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.objective import Status
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from tests.bodies import GRAVITY, diagonal
from tests.sliding_box import stopped
from tests.touching_bodies import free_bodies, posed


def stuck(policy: Doubtful) -> tuple[Any, Tensor]:
    """Two steps of two worlds that land, the second of which a solver of few evaluations does not solve."""
    setup = SCENES["chain-slope-drop"](worlds=2)
    q = setup.q.clone()
    q[0, 2] += 5.0  # the first one is still in free fall
    simulator = Simulator(
        setup.scene, 0.05, INTEGRATORS["implicit-euler"](), Descent(max_evaluations=2), halvings=0, gradients=Gradients(policy)
    )
    v = setup.v.clone().requires_grad_()
    return simulator.trajectory(simulator.initial_state(q, v), steps=6), v


def test_unsolved_steps_are_not_differentiated_silently() -> None:
    """They raise, with where and how many; or warn; or give zero, the other world's derivative being untouched; always flagged."""
    path, v = stuck(Doubtful.RAISE)
    assert path.solved[:, 0].all()
    assert not path.solved[:, 1].all()
    assert torch.equal((path.doubts & int(Doubt.UNSOLVED)) > 0, ~path.solved)
    with pytest.raises(GradientError, match=r"unsolved in 1 of 2 worlds.*Doubtful\.WARN or ZERO"):
        path.q[-1].sum().backward()
    path, v = stuck(Doubtful.WARN)
    with pytest.warns(GradientWarning, match="unsolved in 1 of 2 worlds"):
        path.q[-1].sum().backward()
    assert v.grad is not None
    warned = v.grad
    path, v = stuck(Doubtful.ZERO)
    path.q[-1].sum().backward()
    assert v.grad is not None
    torch.testing.assert_close(v.grad[0], warned[0], rtol=1e-12, atol=0)
    assert not v.grad[1].any()


def standing(policy: Doubtful) -> tuple[Simulator[Any], Tensor]:
    """A pendulum that stands on its head at Δt = √(I/(m g l)), where J = I/Δt² − m g l vanishes."""
    mass, length, inertia = 1.0, 0.5, 0.02
    joint = Joint("hinge", JointKind.HINGE, axis=(0.0, 1.0, 0.0))
    a = Articulation.from_links(
        [Link("rod", joints=(joint,), mass=mass, com=(0.0, 0.0, length), inertia=diagonal(inertia, inertia, inertia))]
    )
    scene = Scene(a, (Inertia(),), torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64))
    dt = math.sqrt((inertia + mass * length**2) / (mass * GRAVITY * length))
    simulator = Simulator(scene, dt, INTEGRATORS["implicit-euler"](), gradients=Gradients(policy))
    return simulator, torch.zeros(1, 1, dtype=torch.float64)


def test_singular_steps_are_damped_and_reported() -> None:
    """At a fold J has no inverse: the derivative is damped, finite, flagged and reported as the policy says."""
    for policy in Doubtful:
        simulator, zero = standing(policy)
        start = simulator.initial_state(zero, zero)
        q = start.q.clone().requires_grad_()
        path = simulator.trajectory(replaced(start, q=q), steps=1)
        assert bool(path.solved.all())
        if policy is Doubtful.RAISE:
            with pytest.raises(GradientError, match="singular in 1 of 1 worlds"):
                path.q[-1].sum().backward()
        elif policy is Doubtful.WARN:
            with pytest.warns(GradientWarning, match="singular in 1 of 1 worlds"):
                path.q[-1].sum().backward()
            assert q.grad is not None
            assert bool(torch.isfinite(q.grad).all())
        else:
            path.q[-1].sum().backward()
            assert q.grad is not None
            assert float(q.grad) == 0
        assert bool((path.doubts & int(Doubt.SINGULAR)).all())


def test_other_ways_are_flagged() -> None:
    """Eased and halved steps have exact derivatives, and say so."""
    setup = SCENES["chain-slope-drop"]()
    simulator = Simulator(setup.scene, 0.1)
    path = simulator.trajectory(simulator.initial_state(setup.q, setup.v), steps=12)
    detour = (path.status == int(Status.EASED)) | (path.status == int(Status.HALVED))
    assert bool(detour.any())
    assert torch.equal((path.doubts & int(Doubt.DETOUR)) > 0, detour)


def test_no_second_derivatives() -> None:
    """Asked for a second derivative, a step raises instead of giving half of it."""
    v0 = torch.ones(1, dtype=torch.float64, requires_grad=True)
    distance = stopped(v0, torch.full((1,), 0.3, dtype=torch.float64), seconds=0.02).sum()
    with pytest.raises(GradientError, match="first derivatives only"):
        torch.autograd.grad(distance, v0, create_graph=True)


def test_adaptive_steps_refuse() -> None:
    """Steps of their own choice carry no derivatives: a message, not a wrong number."""
    setup = SCENES["chain-fixed"]()
    simulator = AdaptiveSimulator(setup.scene, 0.05, 1e-3)
    start = simulator.initial_state(setup.q, setup.v)
    with pytest.raises(InputError, match="carry no derivatives"):
        simulator.step(replaced(start, v=start.v.clone().requires_grad_()))
    with pytest.raises(InputError, match="has rollouts only"):
        simulator.trajectory(start, steps=2)


def test_blurred_contact_is_felt_from_afar() -> None:
    """A ball above the ground knows nothing of it; blurred derivatives do, values being the same. They are biased, and so say the
    docs."""
    scene = free_bodies((Sphere(0.1),), (1.0,))
    q, v = posed((0.0, 0.0, 0.105)), torch.zeros(1, 6, dtype=torch.float64)
    found, ends = [], []
    for gradients in (Gradients(), Gradients(blur=Blur(widening=10.0, distance=5e-3))):
        simulator = Simulator(scene, 0.01, gradients=gradients)
        given = q.clone().requires_grad_()
        path = simulator.trajectory(simulator.initial_state(given, v), steps=1)
        ends.append(path.q)
        found.append(float(torch.autograd.grad(path.q[-1, 0, 2], given)[0][0, 2]))
    assert torch.equal(ends[0], ends[1])
    assert found[0] == pytest.approx(1.0, abs=1e-12)
    assert 0 < found[1] < 0.9


@pytest.mark.parametrize(
    ("changes", "message"), [({"widening": 0.5}, "widening is 0.5"), ({"distance": -1.0}, "distance is -1.0 m")]
)
def test_bad_blurs(changes: dict[str, float], message: str) -> None:
    """Refused at construction."""
    with pytest.raises(InputError, match=message):
        Blur(**changes)
