"""Live mode without a browser: its steps are the simulator's, what it draws is their record, and it keeps to real time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch

from pbfd_torch import Simulator
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Engine, Native, Torch
from pbfd_torch.native.library import library
from pbfd_torch.viewer import Live
from pbfd_torch.viewer.live import FRAME
from pbfd_torch.viewer.strides import strode

DT = 0.005
compiled = pytest.mark.skipif(library() is None, reason="there is no core")
DRAWN = ("q", "link_poses", "obstacle_poses", "center_of_mass", "contact_depth", "contact_point", "contact_force", "contact_slip")


@contextmanager
def still(name: str, worlds: int = 1) -> Iterator[Live]:
    """A live scene at its start whose own clock stands."""
    live = Live(SCENES[name](worlds=worlds), DT, port=8660)
    live._paused = True
    try:
        live.reset()
        yield live
    finally:
        live.close()


@pytest.mark.parametrize("name", ["hopper", "conveyor", "stack"])
@pytest.mark.parametrize("engine", [pytest.param(Native(), marks=compiled), Torch()], ids=["native", "torch"])
def test_records_are_those_of_rollouts(name: str, engine: Engine) -> None:
    """The states after a few steps, and all that is drawn of the last one; in PyTorch steps are made one by one."""
    setup = SCENES[name](worlds=1)
    simulator = Simulator(setup.scene, DT, engine=engine)
    state = start = simulator.initial_state(setup.q, setup.v)
    control, count = setup.controls(1)[0], 0
    while count < 3:
        stride = strode(simulator, state, control, 3 - count)
        assert stride.steps == (3 if simulator.engine == "native" else 1)
        state, count = stride.after, count + stride.steps
    rollout, last = simulator.rollout(start, setup.controls(3)), stride.record()
    assert last.steps == 1
    assert torch.equal(stride.solution.status[-1], rollout.status[-1])
    for field in DRAWN:
        torch.testing.assert_close(getattr(last, field)[-1], getattr(rollout, field)[-1], rtol=1e-9, atol=1e-9)


def test_a_picture_of_several_steps() -> None:
    """The time, the number of steps and the state are those after all of them; one step is one step."""
    with still("chain-ground") as live:
        setup = SCENES["chain-ground"](worlds=1)
        assert live.step(4) + sum(live.step(1) for _ in range(2)) == live.steps
        rollout = live._simulator.rollout(live._simulator.initial_state(setup.q, setup.v), steps=live.steps)
        torch.testing.assert_close(live.q, rollout.q[-1, 0], rtol=0, atol=1e-12)
        assert live.time == pytest.approx(live.steps * DT)
        live.reset()
        assert live.steps == 0
        assert torch.equal(live.q, setup.q[0])


def test_the_camera_follows_from_the_start() -> None:
    """The root moves back by as much as the centre of mass has moved since the start, not since the picture before; loose bodies,
    of which one may fall off, are looked at from where they are."""
    with still("chain-slope") as live:
        begun = live.film.center[0, 0].clone()
        for _ in range(10):
            live.step(4)
        away = begun - live.film.center[-1, 0]
        assert float(away.abs().max()) > 0.01
        torch.testing.assert_close(torch.tensor(live.stage._root.position, dtype=away.dtype), away, rtol=0, atol=1e-9)
    with still("stack") as live:
        live.step(4)
        assert tuple(live.stage._root.position) == (0.0, 0.0, 0.0)


def test_the_first_of_several_worlds_is_stepped() -> None:
    """With its own numbers: the box slides under another μ in each."""
    with still("box-slide", 5) as live:
        setup = SCENES["box-slide"](worlds=5)
        while live.steps < 8:
            live.step(4)
        simulator = Simulator(setup.scene, DT)
        rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=live.steps)
        torch.testing.assert_close(live.q, rollout.q[-1, 0], rtol=0, atol=1e-9)


@compiled
@pytest.mark.parametrize("name", SCENES)
def test_every_scene_keeps_to_real_time(name: str) -> None:
    """The steps of a picture, at 5 ms each, their record and the drawing take less time of a processor than they simulate."""
    with still(name) as live:
        live.step(4)
        spent = []
        for _ in range(5):
            began, before = time.thread_time(), live.steps
            live.step(round(FRAME / DT))
            spent.append((time.thread_time() - began) / (live.steps - before) / DT)
        assert min(spent) < 1
