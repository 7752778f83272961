"""Starts and records of worlds that differ in their parameters, steps with anchors and of BDF2: as the reference has them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Scene, Simulator
from pbfd_torch.bench.starts import scattered
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.integrators.bdf2 import Bdf2
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.integrators.variational import Variational
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Native
from pbfd_torch.native.library import library
from pbfd_torch.native.plan import planned
from pbfd_torch.native.roster import rostered
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.contact import Contact
from tests.native_parity import DT, compared, require_balance, require_starts
from tests.record_arrays import OVER_TIME
from tests.test_native_anchors import anchored, require_kept, stretched
from tests.test_native_bdf2 import gap
from tests.test_native_records import post_and_bodies, recorded, require_same
from tests.test_native_worlds import (
    AXES,
    CONTACT,
    CONTACTS,
    DIFFERENCES,
    WORLDS,
    Difference,
    control,
    differing,
    drawn,
    heavier,
    placed,
    robot,
    scaled,
    start,
    state_of,
)
from tests.test_native_worlds_bits import differences_of

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

INTEGRATORS: tuple[Integrator[Any], ...] = (EnergyMomentum(), ImplicitEuler(), Variational())


def only(name: str) -> Mapping[str, Difference]:
    """One parameter that differs; the reference wants axes and frames together."""
    return AXES if name in AXES else {name: DIFFERENCES[name]}


def held(scene: Scene, steps: int) -> Tensor | None:
    """The same control at each step."""
    same = control(scene)
    return None if same is None else same.expand(steps, WORLDS, -1)


def hopper() -> tuple[Scene, Tensor, Tensor]:
    """Of another weight in each world, and where it may start."""
    setup = SCENES["hopper"](worlds=WORLDS)
    return differing(setup.scene, differences_of("hopper")), *scattered(setup, 0, 0.3, 1.0)


# Starts -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DIFFERENCES)
def test_starts(name: str) -> None:
    scene = differing(robot(), only(name))
    state, _ = start(scene)
    require_starts(scene, state.q, state.v, control(scene))


def test_starts_by_themselves() -> None:
    scene, q, v = hopper()
    require_starts(scene, q, v, control(scene))
    native, same = NativeStepper(Simulator(scene, DT).eager), control(scene)
    assert same is not None
    whole = native.initial_state(q, v, same)
    for index in (torch.tensor([4]), torch.tensor([WORLDS - 1, 0, 3])):
        some = Worlds((WORLDS,), index)
        part = native.take(some).initial_state(q[index], v[index], same[index])
        assert torch.equal(part.v, whole.v[index])
        assert torch.equal(part.lag, whole.lag[index])


# Records ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DIFFERENCES)
def test_records(name: str) -> None:
    """Every array, of steps that touch."""
    scene = differing(robot(), only(name))
    simulator = Simulator(scene, DT, engine=Native())
    state, _ = start(scene)
    found, expected = recorded(simulator, state, held(scene, 3), 3)
    require_same(found, expected)
    assert float((found.contact_force.norm(dim=-1) > 0).any(-1).double().mean()) > 0.5


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=lambda x: type(x).__name__)
def test_records_of_everything_at_once(integrator: Integrator[Any]) -> None:
    """By all integrators; rollouts are made of the same."""
    scene = differing(robot(), DIFFERENCES)
    simulator: Simulator[Any] = Simulator(scene, DT, integrator, engine=Native())
    beside, _ = start(scene)
    state = simulator.initial_state(beside.q, beside.v)
    found, expected = recorded(simulator, state, held(scene, 6), 6)
    require_same(found, expected)
    whole = simulator.rollout(state, held(scene, 6))
    assert torch.equal(whole.potential_energy, found.potential_energy)
    assert torch.equal(whole.link_poses, found.link_poses)


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=lambda x: type(x).__name__)
def test_records_of_what_moves_in_a_plane(integrator: Integrator[Any]) -> None:
    scene, q, v = hopper()
    simulator: Simulator[Any] = Simulator(scene, DT, integrator, engine=Native())
    require_same(*recorded(simulator, simulator.initial_state(q, v), held(scene, 15), 15))


def shifted(value: Tensor, random: torch.Generator) -> Tensor:
    return value + 0.01 * drawn(tuple(value.shape), value, random)


RIDES: dict[str, Difference] = {
    "articulation.pseudo_inertia": heavier,
    "articulation.link_frame": placed,
    "gravity": scaled,
    "terms.2.position": shifted,
    "terms.2.normal_force.stiffness": scaled,
    "terms.3.position": shifted,
}


@pytest.mark.parametrize("names", [*([name] for name in RIDES), list(RIDES)], ids=str)
def test_what_rides_on_the_world(names: list[str]) -> None:
    """Mass, contacts and what they store, of each world; what is deepest is another thing in some than in others."""
    scene = differing(post_and_bodies(), {name: RIDES[name] for name in names})
    foot = scene.terms[2]
    assert isinstance(foot, Contact)
    foot.position[..., :8, 2] -= 0.012  # the box' corners
    simulator = Simulator(scene, DT, engine=Native())
    found, expected = recorded(simulator, state_beside(simulator), None, 8)
    require_same(found, expected)
    real = rostered(simulator.eager, planned(simulator.eager)).real
    assert real.ndim == 2
    assert bool((real != real[0]).any())
    some = Worlds((WORLDS,), torch.tensor([5, 2]))
    assert torch.equal(rostered(simulator.eager.take(some), planned(simulator.eager)).real, real[some.index])


def state_beside(simulator: Simulator[Any]) -> Any:
    a = simulator.articulation
    v = 0.5 * drawn((a.nv,), a.rest, torch.Generator().manual_seed(2))
    return simulator.initial_state(a.rest.expand(WORLDS, -1), v)


def test_records_of_some_worlds_and_of_batches() -> None:
    """To the bit the same by themselves, on threads, and in a batch of two dimensions of which parameters have one each."""
    scene = differing(robot(), DIFFERENCES)
    simulator = Simulator(scene, DT, engine=Native())
    state = state_of(simulator)
    whole = simulator.rollout(state, steps=6)
    threads = Simulator(scene, DT, engine=Native(threads=3)).rollout(state, steps=6)
    stepper = simulator.stepper
    for index in (torch.tensor([4]), torch.tensor([WORLDS - 1, 0, 3])):
        some = Worlds((WORLDS,), index)
        part = simulator.roller(stepper.take(some), state.take(some), None, 6)
        for name in set(OVER_TIME) - {"time"}:
            assert torch.equal(getattr(part, name), getattr(whole, name)[:, index]), name
            assert torch.equal(getattr(threads, name), getattr(whole, name)), name
    random, known = torch.Generator().manual_seed(0), parameters(robot())
    mass = heavier(known["articulation.pseudo_inertia"], random)[:3]
    own = {"articulation.pseudo_inertia": mass, "gravity": scaled(known["gravity"], random)[:7, None]}
    wide = Simulator(with_parameters(robot(), own), DT, engine=Native())
    shaped = mapped(lambda x: x.unflatten(0, (7, 3)), state_of(Simulator(robot(), DT)))
    require_same(*recorded(wide, shaped, None, 3))


# Anchors and BDF2 ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["articulation.pseudo_inertia", *(x for x in CONTACTS)])
def test_anchors(name: str) -> None:
    """Forces, steps and what is remembered."""
    scene = differing(anchored(robot()), {name: DIFFERENCES[name]})
    state, q = start(scene)
    state = stretched(scene, state)
    require_balance(scene, state, q, control(scene))
    native = NativeStepper(Simulator(scene, DT).eager)
    step = compared(native, state, held(scene, 1), 1)
    step.require_roots()
    assert int(step.alike.sum()) >= 0.9 * int(step.both.sum()) > 0
    assert require_kept(native, state, control(scene), step.after, step.solution) > 0.5 * WORLDS
    require_same(*recorded(Simulator(scene, DT, engine=Native()), state, held(scene, 3), 3))


@pytest.mark.parametrize("names", [only(f"{CONTACT}friction.mu"), only("gravity"), DIFFERENCES], ids=["friction", "gravity", "all"])
def test_bdf2(names: Mapping[str, Difference]) -> None:
    """Starts, steps, what these remember, and records."""
    scene = differing(robot(), names)
    simulator: Simulator[Any] = Simulator(scene, DT, Bdf2(), engine=Native())
    native, same, (beside, _) = NativeStepper(simulator.eager), control(scene), start(scene)
    state = native.initial_state(beside.q, beside.v, same)
    require_same(*recorded(simulator, state, held(scene, 4), 4))
    pairs = compared(native, state, held(scene, 4), 4, fallbacks=True)
    both = (pairs.solution.status == pairs.found.status) & pairs.found.solved
    near = both & pairs.near
    assert gap(pairs.after, pairs.expected, near) < 1e-6
    assert int(near.sum()) >= 0.95 * int(both.sum()) > 0
