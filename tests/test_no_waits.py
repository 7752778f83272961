"""A step waits for its device only to learn, once in a round, who still runs, and once, whether anybody is unsolved.

All else that CUDA would wait for, or copy between host and device, shows on the make-believe device. Not here: scenes whose bodies
touch one another, which is found on the host.
"""

from __future__ import annotations

import functools
from collections import Counter
from dataclasses import dataclass
from typing import Any

import pytest
import torch

from pbfd_torch import Simulator
from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.named import OnSquares
from pbfd_torch.solvers.objective import Objective, Status
from pbfd_torch.solvers.progress import Progress, Sighting
from pbfd_torch.solvers.squared import Squared
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.articulation import Articulation
from tests.make_believe_device import DEVICE, Tally, make_believe, values
from tests.random_trees import random_links
from tests.solver_problems import METHODS, VALUE_METHODS

TREE = "tree"  # all kinds of joints, and more than the 16 unknowns that CUDA's LU takes without waiting
ON_DEVICE = (TREE, "box-slide", "chain-fixed", "chain-free", "chain-ground", "chain-slope", "dzhanibekov", "hopper", "walker")
DESCENTS = {name: x for name, x in METHODS.items() if isinstance(x, Descent | OnSquares)}
EIGENVALUES = [name for name in DESCENTS if name.startswith("projected")]  # `ProjectedNewton` needs them, and says that it waits

all_integrators = pytest.mark.parametrize("integrator", INTEGRATORS)


@dataclass(frozen=True)
class Start:
    """A simulator on the device, and a state of it."""

    simulator: Simulator[Any]
    state: Any

    @property
    def objective(self) -> BalanceObjective:
        """The step from there."""
        return self.simulator.objective(self.state)


@functools.cache
def start(name: str, integrator: str, worlds: int = 2) -> Start:
    """After two steps of a scene."""
    with make_believe():
        if name == TREE:
            tree = Articulation.from_links(random_links(0), device=DEVICE)
            scene = Scene(tree, [Inertia()], torch.tensor([0.0, 0.0, -9.81], dtype=tree.dtype, device=DEVICE))
            simulator = Simulator(scene, 0.01, INTEGRATORS[integrator]())
            state = simulator.initial_state(tree.rest.repeat(worlds, 1))
        else:
            setup = SCENES[name](worlds=worlds, device=DEVICE)
            simulator = Simulator(setup.scene, 0.01, INTEGRATORS[integrator]())
            state = simulator.initial_state(setup.q, setup.v)
        for _ in range(2):
            state, _ = simulator.step(state)
        return Start(simulator, state)


def rounds(name: str, begun: Start) -> Tally:
    """What the first two rounds of a step ask of the device; the first one has no past."""
    method = DESCENTS[name]
    with torch.no_grad(), make_believe():
        balance = begun.objective
        objective: Objective = balance
        if name in VALUE_METHODS:
            objective = balance.lagged(begun.state.q)
        if isinstance(method, OnSquares):
            objective, method = Squared(balance), method.solver
        assert isinstance(method, Descent)
        progress = method.begin(objective, balance.guess, begun.state.q)
        with make_believe() as tally:
            for _ in range(2):
                progress = method.advance(objective, progress)
    assert tally.launches > 100
    return tally


# Rounds ---------------------------------------------------------------------------------------------------------------------


@all_integrators
@pytest.mark.parametrize("scene", ON_DEVICE)
def test_a_round_waits_for_nothing(scene: str, integrator: str) -> None:
    """Newton's rounds: no wait and no copy, so that a device may record and repeat them."""
    tally = rounds("Newton, work", start(scene, integrator))
    assert (tally.waits, tally.copies) == (Counter(), Counter())


@pytest.mark.parametrize("scene", [TREE, "chain-ground", "hopper"])
@pytest.mark.parametrize("method", [name for name in DESCENTS if name not in EIGENVALUES])
def test_no_way_to_solve_waits(method: str, scene: str) -> None:
    """All directions with the searches that they are used with, at roots, minima and ½‖r‖²."""
    tally = rounds(method, start(scene, "implicit-euler"))
    assert (tally.waits, tally.copies) == (Counter(), Counter())


@pytest.mark.parametrize("method", EIGENVALUES)
def test_eigenvalues_are_waited_for(method: str) -> None:
    """And for nothing else, where a direction needs them; no other one does."""
    tally = rounds(method, start(TREE, "implicit-euler"))
    assert {what.split(" at ")[0] for what in tally.waits} == {"eigh"}
    assert tally.copies == Counter()


@pytest.mark.parametrize("method", [name for name in DESCENTS if name not in EIGENVALUES])
def test_more_worlds_launch_no_more_kernels(method: str) -> None:
    """Nothing in a round is done world by world."""
    few, many = (rounds(method, start("chain-ground", "implicit-euler", worlds)) for worlds in (2, 5))
    assert few.launches == many.launches


# Steps ----------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def sightings(monkeypatch: pytest.MonkeyPatch) -> list[Sighting]:
    """Gets one entry for every round that is begun."""
    seen: list[Sighting] = []
    sight = Descent.sight

    def counted(self: Descent, objective: Objective, progress: Progress) -> Sighting:
        seen.append(sight(self, objective, progress))
        return seen[-1]

    monkeypatch.setattr(Descent, "sight", counted)
    return seen


@pytest.mark.parametrize("integrator", [name for name in INTEGRATORS if name != "runge-kutta"])
@pytest.mark.parametrize("scene", ["hopper", "walker", "chain-ground", "chain-slope"])
def test_a_step_waits_once_a_round_and_once_more(scene: str, integrator: str, sightings: list[Sighting]) -> None:
    """Each of three steps copies nothing, and waits no more often than it evaluates, plus once."""
    begun = start(scene, integrator)
    state = begun.state
    for _ in range(3):
        sightings.clear()
        with make_believe():
            control = state.q.new_zeros(*state.q.shape[:-1], begun.simulator.scene.nu)
            with make_believe() as tally:
                state, solution = begun.simulator.step(state, control)
        assert bool(values(solution.status).eq(Status.SOLVED).all())
        assert len(sightings) >= 1
        assert tally.copies == Counter()
        assert tally.waits.total() <= len(sightings) + 1, tally.waits


@pytest.mark.parametrize("scene", ["chain-ground", "box-slide"])
def test_an_explicit_step_waits_twice(scene: str) -> None:
    """To know whether anything strikes, and which worlds may not make it; here all may: they fly."""
    begun = start(scene, "runge-kutta")
    with make_believe():
        q = begun.state.q.clone()
        q[..., 2] += 1.0
        state = replaced(begun.state, q=q)
        control = q.new_zeros(*q.shape[:-1], begun.simulator.scene.nu)
        with make_believe() as tally:
            _, solution = begun.simulator.step(state, control)
    assert bool(values(solution.status).eq(Status.EXPLICIT).all())
    assert tally.copies == Counter()
    assert tally.waits.total() <= 2, tally.waits


def test_lanes_are_dropped_without_asking_which(sightings: list[Sighting]) -> None:
    """Of 20 chains two are about to land, and the others end at once: still one wait a round, and fewer evaluations."""
    begun = start("chain-ground", "implicit-euler", 20)
    sightings.clear()
    with torch.no_grad(), make_believe():
        q, before = begun.state.q.clone(), begun.state.q_previous.clone()
        for pose in (before, q):
            pose[:2, 2] -= q[:2, 2] - 0.03
        objective = begun.simulator.objective(replaced(begun.state, q=q, q_previous=before))
        with make_believe() as tally:
            solution = Descent().solve(objective, objective.guess, q)
    assert values(solution.status).tolist() == [Status.SOLVED] * 20
    assert tally.copies == Counter()
    assert tally.waits.total() == len(sightings)
    assert int(values(solution.evaluations).sum()) <= solution.lanes < 20 * len(sightings)
