"""A step ends: it spends no more evaluations than it may, and what is unsolved by then says so. What overlaps is let out gently."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from pbfd_torch import Simulator
from pbfd_torch.bench.starts import scattered
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.hazards import Hazard
from pbfd_torch.contact.shapes import Box, Collider, Shape, Sphere
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.tensors.structures import mapped_tensors
from pbfd_torch.terms.contact_terms import contact_terms
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from tests.bodies import diagonal


def hurried(integrator: str, budget: int) -> tuple[Simulator[Any], Any]:
    """Three walkers that fall into the ground, of whose steps every try is given up after five evaluations."""
    setup = SCENES["walker"](worlds=3)
    q, v = scattered(setup, 0, 0.3, 1.0)
    q[:, 1] -= 0.1
    v[:, 1] -= 5.0
    solver = Fallbacks(*(Descent(max_evaluations=5),) * 2, stage=Descent(max_evaluations=5))
    simulator = Simulator(setup.scene, 0.05, INTEGRATORS[integrator](), solver, evaluations=budget)
    return simulator, simulator.initial_state(q, v)


@pytest.mark.parametrize("integrator", ["implicit-euler", "energy-momentum"])
def test_a_step_spends_what_it_may(integrator: str) -> None:
    """Walkers in the ground whose tries are all too short: every world stops within its budget, and some of each budget say that
    they are unsolved. With more to spend more is tried. All budgets in one batch, which takes no longer than the largest alone."""
    simulator, state = hurried(integrator, 200)
    _, alone = simulator.step(state)
    budgets = torch.tensor([200, 400, 600, 800, 2000])[:, None]
    state = mapped_tensors(state, lambda x: x.expand(len(budgets), *x.shape))
    _, solution, _ = simulator.eager.changed(evaluations=budgets).made(state, None)
    assert bool((solution.evaluations <= budgets).all())
    assert not bool(solution.solved.all(-1).any())
    spent = solution.evaluations.amax(-1)[[0, 1, 3]].tolist()
    assert spent == sorted(set(spent))
    assert torch.equal(alone.evaluations, solution.evaluations[0])


def test_a_budget_must_suffice_for_one_try() -> None:
    with pytest.raises(InputError, match="evaluations is 100: must be ≥ 200"):
        Simulator(SCENES["box-slide"]().scene, 0.01, evaluations=100)


@pytest.mark.parametrize("shape", [Sphere(0.1), Box((0.1, 0.1, 0.1))], ids=["balls", "boxes"])
@pytest.mark.parametrize("dt", [0.01, 0.02, 0.05])
@pytest.mark.parametrize("integrator", ["implicit-euler", "energy-momentum"])
def test_what_overlaps_is_let_out(integrator: str, dt: float, shape: Shape) -> None:
    """Two bodies that begin 4 cm within each other part at the release speed, .1 m/s, within few evaluations, and the hazard says
    so until they have."""
    links = [
        Link(name, joints=(Joint(f"free {name}", JointKind.FREE),), mass=1.0, inertia=diagonal(0.005, 0.005, 0.005))
        for name in "ab"
    ]
    a = Articulation.from_links(links)
    terms = contact_terms(a, [Collider(x, x, shape) for x in "ab"])
    simulator = Simulator(Scene(a, (Inertia(), *terms), torch.zeros(3).double()), dt, INTEGRATORS[integrator]())
    q = a.rest[None].clone()
    q[0, 7] = 0.16
    rollout = simulator.rollout(simulator.initial_state(q), steps=round(0.6 / dt))
    assert bool(rollout.solved.all())
    assert float(rollout.v.abs().max()) < 0.1
    distance = rollout.q[:, 0, 7] - rollout.q[:, 0, 0]
    assert float(distance[-1]) > 0.19
    assert bool((rollout.hazards[0] & int(Hazard.OVERLAPPED)).bool().all())
    assert int(rollout.hazards[-1].item()) == 0
    assert float(rollout.evaluations.double().mean()) < 15


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_out_of_the_ground(dt: float) -> None:
    """A ball that begins 5 cm in the ground comes up at no more than the release speed."""
    inertia = diagonal(0.004, 0.004, 0.004)
    a = Articulation.from_links([Link("ball", joints=(Joint("free", JointKind.FREE),), mass=1.0, inertia=inertia)])
    terms = contact_terms(a, [Collider("ball", "ball", Sphere(0.1))], [HalfSpace()])
    simulator = Simulator(Scene(a, (Inertia(), *terms), torch.tensor([0.0, 0.0, -9.81]).double()), dt)
    q = a.rest[None].clone()
    q[0, 2] = 0.05
    rollout = simulator.rollout(simulator.initial_state(q), steps=round(0.8 / dt))
    assert bool(rollout.solved.all())
    assert float(rollout.q[:, 0, 2].diff().max()) < 0.1 * dt
    assert abs(float(rollout.q[-1, 0, 2]) - 0.1) < 1e-3
    assert float(rollout.evaluations.double().mean()) < 10
