"""Linear systems of a hopper's steps against perturbed steps."""

from __future__ import annotations

import pytest
import torch

from pbfd_torch import Simulator
from pbfd_torch.gradients.linearization import Chart
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES
from tests.gradient_checks import PRECISE
from tests.random_trees import generator


@pytest.mark.parametrize("name", INTEGRATORS)
def test_linearisation(name: str) -> None:
    """A and B of a hopper's steps predict perturbed steps, with an error that shrinks as h² until rounding, in every world."""
    setup = SCENES["hopper"](worlds=2)
    simulator = Simulator(setup.scene, 0.008, INTEGRATORS[name](), PRECISE)
    random = generator(2)
    state = simulator.initial_state(setup.q, setup.v)
    for _ in range(5):
        control = 0.3 * torch.randn(2, setup.scene.nu, dtype=torch.float64, generator=random)
        state, _ = simulator.step(state, control)
    system = simulator.linearize(state, control)
    before, after = Chart(simulator, state), Chart(simulator, system.end)
    assert system.A.shape == (2, after.size, before.size)
    assert system.B.shape == (2, after.size, setup.scene.nu)
    step = torch.randn(2, before.size, dtype=torch.float64, generator=random)
    for part, place in before.layout.items():
        if part != "v":
            step[:, place] *= 0.01
        if part == "history":  # poses, whose last row is no coordinate
            step[:, place].unflatten(-1, (-1, 4, 4))[..., 3, :] = 0.0
    du = torch.randn(2, setup.scene.nu, dtype=torch.float64, generator=random)
    expected = (system.A @ step[..., None] + system.B @ du[..., None]).squeeze(-1)

    def off(h: float) -> float:
        ends = [after.of(simulator.step(before.at(s * step), control + s * du)[0]) for s in (h, -h)]
        return float(((ends[0] - ends[1]) / (2 * h) - expected).abs().max() / expected.abs().max())

    assert off(1e-4) <= 1e-6
    assert off(2e-4) / off(1e-4) == pytest.approx(4, rel=0.2) or off(1e-4) <= 1e-9
