"""Motions between their recorded instants."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from pbfd_torch import InputError, RungeKutta, Simulator
from pbfd_torch.models import SCENES
from pbfd_torch.models.setup import Setup
from pbfd_torch.records.dense_output import dense_output
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.simulator import AdaptiveSimulator
from pbfd_torch.tree.kinematics import coordinate_rates, difference, place, retract, velocity_of_rates
from tests.bodies import diagonal, free_body
from tests.random_trees import generator, random_q, random_tree

BETWEEN = torch.arange(1, 100, dtype=torch.float64) / 250  # [s], every 4 ms, of the first .4 s


def spinning(setup: Setup) -> Setup:
    """Bodies that turn fast about all of their axes as well, some joints the other way."""
    v = setup.v + 2 * torch.sin(torch.arange(setup.v.shape[-1], dtype=torch.float64))
    return dataclasses.replace(setup, v=v)


def rolled(setup: Setup, frame: float, accuracy: float = 1e-10, seconds: float = 0.4) -> Rollout:
    """Frames whose ends are all but exact."""
    simulator = AdaptiveSimulator(setup.scene, frame, accuracy, RungeKutta(), shortest=1e-4)
    return simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=round(seconds / frame))


@pytest.mark.parametrize("name", ["chain-free", "dzhanibekov"])
def test_fourth_order(name: str) -> None:
    """A chain in the air that bends and turns, and a spinning body that falls over: q between frames of .02 and .01 s against a
    run that is recorded every 4 ms falls off with an order of 3.8 at least, v with 2.8; the poses are those of q."""
    setup = spinning(SCENES[name]())
    a = setup.scene.articulation
    fine = rolled(setup, 0.004)
    off = []
    for frame in (0.02, 0.01):
        found = rolled(setup, frame).at(a, BETWEEN)
        off.append([float(x.abs().max()) for x in (difference(a, fine.q[1:-1], found.q), found.v - fine.v[1:-1])])
        assert torch.equal(found.link_poses, place(a, found.q).poses[..., :3, :])
        norm = torch.linalg.vector_norm(found.q[..., a.topology.turning_q], dim=-1)
        torch.testing.assert_close(norm, torch.ones_like(norm), rtol=0, atol=1e-14)
    orders = [math.log2(one / other) for one, other in zip(*off, strict=True)]
    assert orders[0] > 3.8
    assert orders[1] > 2.8


@pytest.mark.parametrize("name", ["chain-ground", "box-slide", "dzhanibekov"])
def test_recorded_instants(name: str) -> None:
    """There q and v are those recorded, to the bit, in all worlds, whatever the order of the times."""
    setup = SCENES[name](worlds=3)
    simulator = Simulator(setup.scene, 0.02)
    rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=20)
    for order in (slice(None), torch.randperm(21, generator=generator(0))):
        found = rollout.at(simulator.articulation, rollout.time[order])
        assert torch.equal(found.q, rollout.q[order])
        assert torch.equal(found.v, rollout.v[order])
        torch.testing.assert_close(found.link_poses, rollout.link_poses[order], rtol=0, atol=1e-13)


def test_motions_of_third_degree_are_exact() -> None:
    """A point that moves by a cubic of time, without a batch of worlds, between instants of unlike distances."""
    a = free_body(1.0, diagonal(0.1, 0.2, 0.3))
    time = torch.tensor([0.0, 0.5, 0.6, 2.0], dtype=torch.float64)
    times = torch.linspace(0, 2, 41, dtype=torch.float64)

    def states(at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x, rate = at**3 - 2 * at, 3 * at**2 - 2
        q, v = torch.zeros(len(at), 7, dtype=torch.float64), torch.zeros(len(at), 6, dtype=torch.float64)
        q[:, 0], q[:, 3], v[:, 0] = x, 1.0, rate
        return q, v

    found = dense_output(a, time, *states(time), times)
    for one, other in zip((found.q, found.v), states(times), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-14)


def test_quaternions_of_either_sign() -> None:
    """q and −q are one rotation: what is between does not depend on which of them was recorded."""
    a = free_body(1.0, diagonal(0.1, 0.2, 0.3))
    q = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]], dtype=torch.float64)
    v = torch.tensor([[0.0, 0, 0, 0.3, -0.2, 0.5]], dtype=torch.float64)
    ends = torch.cat((q, retract(a, q, v)))
    turned = ends * torch.tensor([[1.0] * 7, [1.0] * 3 + [-1.0] * 4], dtype=torch.float64)
    time, times = torch.tensor([0.0, 1.0], dtype=torch.float64), [0.25, 0.5]
    found = [dense_output(a, time, x, v.expand(2, 6), times) for x in (ends, turned)]
    assert torch.equal(found[0].q, found[1].q)
    expected = torch.cat([retract(a, q, x * v) for x in times])
    torch.testing.assert_close(found[0].q, expected, rtol=0, atol=1e-3)


def test_rates_and_velocities() -> None:
    """Undo each other, for quaternions of any norm."""
    a = random_tree(1)
    q, v = random_q(a, 2, (4,)), torch.randn(4, a.nv, dtype=torch.float64, generator=generator(3))
    q[..., a.topology.turning_q] *= 1.7
    torch.testing.assert_close(velocity_of_rates(a, q, coordinate_rates(a, q, v)), v, rtol=0, atol=1e-13)


def test_times_that_are_refused() -> None:
    setup = SCENES["dzhanibekov"]()
    rollout = rolled(setup, 0.02, 1e-4, 0.04)
    a = setup.scene.articulation
    for wrong in (-1e-3, 0.041, math.nan):
        with pytest.raises(InputError, match=rf"times holds {wrong:.9g} s: must be from 0 to 0\.04 s"):
            rollout.at(a, [0.01, wrong])
    with pytest.raises(InputError, match=r"times has shape \(1, 1\): must be \[T\]"):
        rollout.at(a, [[0.01]])
    with pytest.raises(InputError, match=r"articulation has \(\d+, \d+\) .* must be those of the rollout, \(7, 6\)"):
        rollout.at(SCENES["chain-free"]().scene.articulation, [0.01])
    assert rollout.at(a, []).q.shape == (0, 1, 7)
