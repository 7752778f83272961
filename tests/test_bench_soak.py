"""`pbfd bench soak`: random robots, what is counted, and what the command writes."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from pbfd_torch import JointKind, Simulator
from pbfd_torch.bench import soak
from pbfd_torch.bench.random_robots import RandomRobot
from pbfd_torch.solvers.objective import Status
from tests.command import Pbfd, caller

pbfd = pytest.fixture(caller)


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two worlds, four steps, other pushes after two."""
    for name, value in {"WORLDS": 2, "STEPS": 4, "PUSHED": 2}.items():
        monkeypatch.setattr(soak, name, value)


def test_random_robots() -> None:
    """The same for the same seed; among twenty there are all joints and all shapes, and nothing begins in the ground."""
    kinds, shapes = set(), set()
    for seed in range(20):
        robot, again = RandomRobot(seed), RandomRobot(seed)
        q, _ = robot.start(3)
        assert torch.equal(q, again.start(3)[0])
        assert torch.equal(robot.articulation.pseudo_inertia, again.articulation.pseudo_inertia)
        kinds |= {(*size, hinge) for size, hinge in zip(*_joints(robot), strict=True)}
        shapes |= {type(x.shape).__name__ for x in robot.scene.colliders}
        assert bool(torch.isfinite(robot.scene.energy(q, torch.zeros(3, robot.articulation.nv, dtype=q.dtype))).all())
    assert kinds == {(7, 6, False), (4, 3, False), (1, 1, True), (1, 1, False)}
    assert shapes == {"Sphere", "Capsule", "Box", "Cylinder", "Ellipsoid", "ConvexHull"}
    assert len(JointKind) == len(kinds)


def _joints(robot: RandomRobot) -> tuple[Any, Any]:
    t = robot.articulation.topology
    return t.joint_sizes, t.joint_is_hinge


def test_counts(few: None) -> None:
    """So many world-steps as were asked for, at least; every step has one status; progress sums to them."""
    seen: list[int] = []
    found = soak.soak(14, 3, 0.01, seen.append)
    assert found.world_steps == sum(seen) == sum(found.status.values()) == 14
    assert found.seeds == 2
    assert found.not_finite_unsaid == found.over_budget == 0
    assert 1 <= found.evaluations <= 5000
    assert found.slowest["seed"] in (3, 4)
    assert found.slowest_s > 0
    assert set(found.memory) == {"tenth_bytes", "end_bytes"}


def test_findings() -> None:
    """NaN that no status tells of, energy beyond the account, steps over their budget and unsolved ones are counted and listed."""
    robot = RandomRobot(0)
    simulator = Simulator(robot.scene, 0.01)
    state, solution = simulator.step(simulator.initial_state(*robot.start(4)))
    q = state.q.clone()
    q[0] = math.nan
    odd = dataclasses.replace(state, q=q, surplus=state.peak, gained=state.peak)
    status = torch.tensor([Status.SOLVED, Status.NON_FINITE, Status.STALLED, Status.SOLVED], dtype=torch.int32)
    told = dataclasses.replace(solution, status=status, evaluations=torch.tensor([1, 1, 6000, 1], dtype=torch.int32))
    found = soak.Soak()
    found.count(7, 5, 0.5, odd, told)
    assert (found.not_finite_unsaid, found.over_budget, found.unsolved, found.energy_rises) == (1, 1, 1, 2)
    listed = [(x["what"], x["world"], x["status"]) for x in found.findings]
    assert ("not finite", 0, "SOLVED") in listed
    assert ("unsolved", 2, "STALLED") in listed
    assert ("unsolved", 1, "NON_FINITE") in listed
    assert ("over budget", 2, "STALLED") in listed
    assert all((x["seed"], x["step"]) == (7, 5) for x in found.findings)


def test_command(few: None, tmp_path: Path, pbfd: Pbfd) -> None:
    """`pbfd bench soak --json` prints one object and writes the same; exit status 0 where nothing is wrong."""
    ran = pbfd("bench", "soak", "--world-steps", 6, "--seed", 1, "--out", tmp_path, "--json")
    assert ran.status == 0
    report = ran.data
    assert report == json.loads((tmp_path / "soak.json").read_text())
    assert report["world_steps"] == 6
    assert report["seed"] == 1
    assert sum(report["status"].values()) == 6


@pytest.mark.parametrize(("world_steps", "seed"), [(0, 0), (-5, 0), (10**12, 0), (10, -1)])
def test_refused(world_steps: int, seed: int, tmp_path: Path, pbfd: Pbfd) -> None:
    """Numbers of steps and seeds that make no sense are refused before anything is measured."""
    ran = pbfd("bench", "soak", "--world-steps", world_steps, "--seed", seed, "--out", tmp_path)
    assert ran.status == 2
    assert "--world-steps is" in ran.words or "--seed is" in ran.words
    assert not list(tmp_path.iterdir())
