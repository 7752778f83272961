"""The make-believe device complains, waits and launches as CUDA does; and everything that we simulate runs on it."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch import Simulator
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES, Setup
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.named import TABLE_1, OnLagged
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.stepping.stepper import Solver
from pbfd_torch.tree.inertial import mass_com_inertia
from tests.make_believe_device import DEVICE, MixedDevicesError, Tally, make_believe, values
from tests.solver_problems import ROOT_METHODS, changed

# The device itself ----------------------------------------------------------------------------------------------------------


def asked(act: Callable[[Tensor], object]) -> Tally:
    """What an act on the matrices [[4, 0, 0], [1, 3, 0], [1, 1, 2]] `[2, 3, 3]` asks of the device that they are on."""
    with make_believe():
        x = (torch.ones(2, 3, 3).tril() + torch.diag(torch.tensor([3.0, 2.0, 1.0]))).to(DEVICE)
        with make_believe() as tally:
            act(x)
    return tally


def put(x: Tensor, where: Any, value: Any) -> None:
    x[where] = value


def gradient(x: Tensor) -> Tensor:
    return torch.autograd.grad(x.square().sum(), x)[0]


WAITS: dict[str, Callable[[Tensor], object]] = {
    "a number": lambda x: x[0, 0, 0].item(),
    "a choice": lambda x: bool((x > 0).all()),
    "an index that is a tensor without dimensions": lambda x: x[x[0, 0, 0].long() - 4],
    "positions": lambda x: x.nonzero(),
    "a mask": lambda x: x[x > 0],
    "values under a mask": lambda x: put(x, x > 0, x.sum()),
    "equality": lambda x: torch.equal(x, x),
    "an inverse, checked": torch.linalg.inv,
    "a solution, checked": lambda x: torch.linalg.solve(x, x),
    "eigenvalues": torch.linalg.eigvalsh,
    "LU of 17 unknowns": lambda x: torch.linalg.lu_factor_ex(torch.eye(17, device=DEVICE)),
    "a solution for 17 unknowns": lambda x: torch.linalg.solve_ex(torch.eye(17, device=DEVICE), torch.ones(17, 1, device=DEVICE)),
    "an orthogonal factor": torch.linalg.qr,
}
COPIES: dict[str, Callable[[Tensor], object]] = {
    "to the host": lambda x: x.cpu(),
    "a list of numbers": lambda x: x.tolist(),
    "from the host": lambda x: torch.ones(3).to(DEVICE),
    "a tensor of numbers": lambda x: torch.tensor([1.0, 2.0], device=DEVICE),
    "a tensor of one number": lambda x: torch.as_tensor(1.0, device=DEVICE),
    "a list as an index": lambda x: x[..., [0, 2]],
    "an index on the host": lambda x: x[..., torch.tensor([0, 2])],
    "a number put at indices": lambda x: put(x, torch.arange(2, device=DEVICE), 1.0),
    "into the host's memory": lambda x: torch.ones(3, 3).copy_(x[0]),
}
FREE: dict[str, Callable[[Tensor], object]] = {
    "arithmetic": lambda x: (2 * x + torch.tensor(1.0)) @ x,
    "factories": lambda x: (torch.zeros(3, device=DEVICE), torch.full((3,), 2.0, device=DEVICE), torch.eye(3, device=DEVICE)),
    "a choice of tensors": lambda x: torch.where(x > 0, 1.0, x),
    "an index": lambda x: x[..., torch.arange(2, device=DEVICE)],
    "a number put under a mask": lambda x: put(x, x > 0, 1.0),
    "a number put in a slice": lambda x: put(x, (..., 1), 1.0),
    "another type": lambda x: x.double(),
    "unchecked inverse": torch.linalg.inv_ex,
    "unchecked solution": lambda x: torch.linalg.solve_ex(x, x),
    "a determinant": torch.linalg.det,
    "a triangular factor": lambda x: torch.linalg.qr(x, mode="r"),
    "reflections": torch.geqrf,
    "gradients": lambda x: gradient(torch.ones_like(x, requires_grad=True)),
}
MIXED: dict[str, Callable[[Tensor], object]] = {
    "a sum": lambda x: x + torch.ones(3),
    "a product": lambda x: x @ torch.ones(3, 3),
    "a list of tensors": lambda x: torch.stack((x.sum(), torch.tensor(1.0))),
    "values put at indices": lambda x: put(x, torch.arange(2, device=DEVICE), torch.ones(2, 3, 3)),
    "into a number of the host": lambda x: torch.tensor(1.0).add_(x.sum()),
    "out of the host's memory": lambda x: torch.ones(3)[torch.arange(2, device=DEVICE)],
}


@pytest.mark.parametrize("act", WAITS.values(), ids=WAITS)
def test_waits_are_counted(act: Callable[[Tensor], object]) -> None:
    """One wait, and no copy."""
    tally = asked(act)
    assert (tally.waits.total(), tally.copies.total()) == (1, 0)


@pytest.mark.parametrize("act", COPIES.values(), ids=COPIES)
def test_copies_are_counted(act: Callable[[Tensor], object]) -> None:
    """One copy, and no wait."""
    tally = asked(act)
    assert (tally.waits.total(), tally.copies.total()) == (0, 1)


@pytest.mark.parametrize("act", FREE.values(), ids=FREE)
def test_kernels_are_waited_for_by_nobody(act: Callable[[Tensor], object]) -> None:
    """No wait and no copy, but launches."""
    tally = asked(act)
    assert (tally.waits.total(), tally.copies.total()) == (0, 0)
    assert tally.launches > 0


@pytest.mark.parametrize("act", MIXED.values(), ids=MIXED)
def test_devices_do_not_mix(act: Callable[[Tensor], object]) -> None:
    """As on CUDA."""
    with pytest.raises(MixedDevicesError):
        asked(act)


def test_views_launch_nothing() -> None:
    """Nor do empty tensors."""
    tally = asked(lambda x: (x.mT[..., 1:, None].expand(2, 3, 2, 5), x.unbind(-1), x.reshape(-1), torch.empty_like(x), x.detach()))
    assert tally == Tally()


def test_lines_of_ours_are_named() -> None:
    """The innermost one that is being executed."""
    tally = asked(lambda x: mass_com_inertia(torch.eye(4, device=DEVICE)))
    (where,) = tally.waits
    assert re.fullmatch(r"item at tree/inertial\.py:\d+ _checked", where)


def test_numbers_are_copied_by_hand_only() -> None:
    """NumPy gets none, and nothing works without the device at hand."""
    with make_believe():
        x = torch.ones(3, device=DEVICE)
        with pytest.raises(TypeError, match=r"use Tensor\.cpu"):
            np.asarray(x)
    with pytest.raises(RuntimeError, match="outside"):
        x + 1


# Simulations on it ----------------------------------------------------------------------------------------------------------


@functools.cache
def on_device(name: str) -> Setup:
    with make_believe():
        return SCENES[name](worlds=2, device=DEVICE)


@functools.cache
def on_host(name: str) -> Setup:
    return SCENES[name](worlds=2)


def started(setup: Setup, integrator: str) -> tuple[Simulator[Any], Any]:
    """A simulator with steps of 2 ms, and the state that the scene starts in."""
    simulator = Simulator(setup.scene, 0.002, INTEGRATORS[integrator]())
    return simulator, simulator.initial_state(setup.q, setup.v)


@functools.cache
def started_on_device(scene: str, integrator: str) -> tuple[Simulator[Any], Any]:
    """The same on the device."""
    with make_believe():
        return started(on_device(scene), integrator)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("scene", SCENES)
def test_every_scene_steps(scene: str, integrator: str) -> None:
    """Three steps without mixing devices, to where the host's lead, whose solutions are as exact."""

    def moved(setup: Setup, simulator: Simulator[Any], state: Any) -> Tensor:
        for control in setup.controls(3):
            state, _ = simulator.step(state, control)
        return values(state.q)

    here = moved(on_host(scene), *started(on_host(scene), integrator))
    with make_believe():
        there = moved(on_device(scene), *started_on_device(scene, integrator))
    torch.testing.assert_close(there, here, rtol=0, atol=1e-8)


def step_by(solver: Solver, scene: str, integrator: str, halvings: int) -> Solution:
    """One step of a scene on the device by another solver than the one that it was started with."""
    with make_believe():
        simulator, state = started_on_device(scene, integrator)
        hasty = Simulator(simulator.scene, simulator.dt, simulator.integrator, solver, halvings)
        _, solution = hasty.step(state)
        return solution


HASTY: dict[str, Solver] = {name: changed(method, max_evaluations=2) for name, method in ROOT_METHODS.items()}
LAGGED: dict[str, Solver] = {
    name: changed(make(), max_evaluations=2) for name, make in TABLE_1.items() if isinstance(make(), OnLagged)
}


@pytest.mark.parametrize("scene", ["chain-ground", "conveyor"])
@pytest.mark.parametrize("name", HASTY)
def test_every_solver_steps(name: str, scene: str) -> None:
    """The first rounds of a step without mixing devices, and those of the easier step."""
    step_by(HASTY[name], scene, "energy-momentum", 0)


@pytest.mark.parametrize("scene", ["chain-ground", "conveyor"])
@pytest.mark.parametrize("name", LAGGED)
def test_every_minimiser_steps(name: str, scene: str) -> None:
    """The same with an energy, which only the paper's integrator has."""
    step_by(LAGGED[name], scene, "implicit-euler", 0)


@pytest.mark.parametrize(("scene", "integrator"), [*(("box-slide", name) for name in INTEGRATORS), ("conveyor", "implicit-euler")])
def test_every_detour_is_taken(scene: str, integrator: str) -> None:
    """Worlds that nothing solves go through all that there is to try, without mixing devices."""
    once = Descent(max_evaluations=1)
    solution = step_by(Fallbacks(once, once, stage=once), scene, integrator, 1)
    assert bool((values(solution.fallbacks)[:, 3] == 1).all())  # halving is the last resort
