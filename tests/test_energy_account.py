"""The account of what steps have gained: energy never rises above its start by more than it may, and losses are no credit."""

from __future__ import annotations

import math

import pytest
import torch

from pbfd_torch import Simulator, Status
from pbfd_torch.bench.starts import scattered
from pbfd_torch.contact.shapes import Cylinder, Ellipsoid
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.energy_momentum import RESERVE, EnergyMomentum
from pbfd_torch.models import SCENES
from tests.test_curved_contact import BALL, FLOORS, UPRIGHT, WHEEL, R, body_on, rolled


@pytest.mark.parametrize("floor", ["plane", "box"])
@pytest.mark.parametrize("shape", [WHEEL, BALL], ids=["wheel", "ball"])
@pytest.mark.parametrize("dt", [0.01, 0.02, 0.05])
def test_rolling_gains_nothing(dt: float, shape: Cylinder | Ellipsoid, floor: str) -> None:
    """Up to .8 rad a step the energy stays below 1.001 of its start, and above .99."""
    speed = 0.8 * R / dt
    rollout = rolled(body_on(shape, FLOORS[floor]), dt, 30 * dt, R, UPRIGHT, speed)
    energy = rollout.energy[1:, 0] / rollout.energy[0, 0]
    assert bool(rollout.solved.all())
    assert 0.99 < float(energy.min()) <= float(energy.max()) < 1 + EnergyMomentum().surplus


@pytest.mark.parametrize(("name", "dt"), [("chain-ground", 0.02), ("hopper", 0.008), ("box-slide", 0.02)])
def test_a_step_that_would_overdraw_is_not_taken(name: str, dt: float) -> None:
    """From scattered starts: where the step itself was taken, the account is within its bounds; it never counts more of losses than
    the reserve; and the largest energy never falls."""
    setup = SCENES[name](worlds=8)
    simulator = Simulator(setup.scene, dt)
    state = simulator.initial_state(*scattered(setup, 0, 0.3, 1.0))
    refused = 0
    for _ in range(40):
        before = state.peak
        state, solution = simulator.step(state)
        taken = solution.status == int(Status.SOLVED)
        refused += int((~taken).sum())
        kept = (state.surplus <= EnergyMomentum().surplus * state.peak) | (state.gained <= 1e-4 * state.peak)
        assert bool(kept[taken].all())
        assert bool((state.surplus >= -RESERVE * state.peak * (1 + 1e-12)).all())
        assert bool((state.peak >= before).all())
    assert refused < 8 * 40 // 2


def test_the_account_goes_with_its_world() -> None:
    """A world alone has the account that it has among others, to the bit."""
    setup = SCENES["hopper"](worlds=3)
    simulator = Simulator(setup.scene, 0.008)
    q, v = scattered(setup, 0, 0.3, 1.0)
    together, alone = simulator.initial_state(q, v), simulator.initial_state(q[1:2], v[1:2])
    for _ in range(20):
        together, alone = simulator.step(together)[0], simulator.step(alone)[0]
    assert torch.equal(together.surplus[1:2], alone.surplus)
    assert torch.equal(together.peak[1:2], alone.peak)


def test_what_may_be_gained_is_a_choice() -> None:
    """Without the account a fast wheel gains, as the scheme has it; a share that is not > 0 is refused."""
    scene, dt = body_on(WHEEL, FLOORS["plane"]), 0.05
    energies = []
    for surplus in (1e-3, math.inf):
        rollout = rolled(scene, dt, 20 * dt, R, UPRIGHT, R / dt, EnergyMomentum(surplus))
        energies.append(float((rollout.energy[1:] / rollout.energy[:1]).max()))
    assert energies[0] < 1.001 < energies[1] < 1.01
    with pytest.raises(InputError, match=r"surplus is 0.0: must be > 0"):
        EnergyMomentum(0.0)
