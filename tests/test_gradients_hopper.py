"""Derivatives of a hopper's landing and push-off by all its actions, in both precisions."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Simulator
from pbfd_torch.gradients.linked import Linked, Made, Step, doubts_of
from pbfd_torch.integrators.integrator import State
from pbfd_torch.models import SCENES
from pbfd_torch.tensors.structures import in_dtype, mapped_tensors, tensors_of
from tests.random_trees import generator


@dataclasses.dataclass(frozen=True, eq=False)
class Hop:
    """A hopper that lands and pushes off: float64, and what the end of its motion comes to."""

    simulator: Simulator[Any]
    start: State
    controls: Tensor
    weights: Tensor

    def worth(self, end: State, simulator: Simulator[Any]) -> Tensor:
        """A number `[*batch]` of a last state."""
        v = simulator.integrator.velocity(simulator.articulation, end, simulator.step_size)
        return ((end.q + 0.1 * v) * self.weights.to(end.q.dtype)).sum(-1)

    def reward(self, controls: Tensor) -> Tensor:
        """What controls `[steps, m, nu]` come to, `[m]`."""
        many = controls.shape[1]
        wide = mapped_tensors(self.start, lambda x: x.expand(many, *x.shape[1:]).contiguous())
        path = self.simulator.trajectory(wide, controls)
        assert bool(path.solved.all())
        return self.worth(path.end, self.simulator)


@pytest.fixture(scope="module")
def hop() -> Hop:
    """32 steps of 8 ms from .16 s after a hopper was let go."""
    setup = SCENES["hopper"]()
    simulator = Simulator(setup.scene, 0.008)
    start = simulator.initial_state(setup.q, setup.v)
    for _ in range(20):
        start, _ = simulator.step(start)
    random = generator(3)
    controls = 0.4 * torch.randn(32, 1, setup.scene.nu, dtype=torch.float64, generator=random)
    return Hop(simulator, start, controls, torch.randn(setup.scene.articulation.nv, dtype=torch.float64, generator=random))


def by_controls(hop: Hop) -> Tensor:
    """The exact derivative by all controls."""
    given = hop.controls.clone().requires_grad_()
    return torch.autograd.grad(hop.reward(given).sum(), given)[0]


def test_hopper_by_all_actions(hop: Hop) -> None:
    """32 steps with contact: by all 96 actions, each on its own, within 1e-6 of central differences, relative to the largest."""
    size = hop.controls.numel()
    steps = 1e-5 * torch.eye(size, dtype=torch.float64)
    probes = torch.cat((steps, -steps, 2 * steps, -2 * steps)).reshape(4 * size, len(hop.controls), -1).movedim(0, 1)
    with torch.no_grad():
        up, down, further_up, further_down = hop.reward(hop.controls + probes).reshape(4, size)
    expected = ((8 * (up - down) - (further_up - further_down)) / 12e-5).reshape(hop.controls.shape)
    assert float((by_controls(hop) - expected).abs().max()) <= 1e-6 * float(expected.abs().max())


def test_hopper_in_float32(hop: Hop) -> None:
    """Along the same motion, rounded to float32, the derivative of all 32 steps in a row is within 1e-4 of that in float64. (Two
    simulations in the two types do not stay together: stiff friction amplifies what is rounded.)"""
    simulator = Simulator(SCENES["hopper"](dtype=torch.float32).scene, 0.008)
    states, made = [hop.start], []
    for control in hop.controls:
        end, solution, way = hop.simulator.stepper.made(states[-1], control)
        states.append(end)
        made.append(Made(solution, in_dtype(way.kept(), torch.float32), doubts_of(solution.status)))
    states = in_dtype(states, torch.float32)
    found: list[Tensor] = []

    last, leaves = alive(states[-1])
    cotangents = list(torch.autograd.grad(hop.worth(last, simulator).sum(), leaves, allow_unused=True, materialize_grads=True))
    for state, control, step in zip(reversed(states[:-1]), reversed(hop.controls.float()), reversed(made), strict=True):
        begin, leaves = alive(state)
        u = control.clone().requires_grad_()
        end = retraced(simulator, begin, u, step)
        ends = [x for x in tensors_of(end) if x.is_floating_point()]
        pairs = [(x, c) for x, c in zip(ends, cotangents, strict=True) if x.requires_grad]
        given = (*leaves, u)
        *cotangents, by_u = torch.autograd.grad(
            [x for x, _ in pairs], given, [c for _, c in pairs], allow_unused=True, materialize_grads=True
        )
        found.append(by_u)
    expected = by_controls(hop)
    assert float((torch.stack(found[::-1]).double() - expected).abs().max()) <= 1e-4 * float(expected.abs().max())


def alive(state: State) -> tuple[State, list[Tensor]]:
    """The state with leaves of a graph as its numbers, and these."""
    leaves = [x.detach().clone().requires_grad_(x.is_floating_point()) for x in tensors_of(state)]
    order = iter(leaves)
    return mapped_tensors(state, lambda _: next(order)), [x for x in leaves if x.requires_grad]


def retraced(simulator: Simulator[Any], state: State, control: Tensor, made: Made) -> Any:
    """The end of a step that is known, as a function of its state and control."""
    play = Step(Linked(simulator.eager, simulator.gradients, lambda eager: eager), state, control)
    play.made = made
    return play.again(simulator.eager, state, control)
