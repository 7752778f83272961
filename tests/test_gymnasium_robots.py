"""Gymnasium's own robots, left to themselves for two seconds at a step of 8 ms: every step solves, energy only falls, joints stay
within their limits and feet on the ground.

Limits and ground are stiff springs, so they give way a little. Measured on 64-bit floats:

| robot | deepest penetration | farthest past a limit | most iterations of a step |
|---|---|---|---|
| hopper | 2.03 mm | 0.12 mrad | 14 |
| walker2d, walker2d_v5 | 1.84 mm | 1.09 mrad | 52 |
| ant | 1.91 mm | 0.64 mrad after 0.5 s | 13 |
| half_cheetah | 1.93 mm | inside | 70 |
| humanoid | 2.71 mm | 0.95 mrad after 0.5 s | 75 |

The ant and the humanoid start 0.52 and 0.035 rad outside a limit in their own files and are flung back (the ant's legs hit the
other limit, 4.4 mrad deep, before 0.5 s).
"""

from __future__ import annotations

import pytest
import torch

from pbfd_torch.loading import load_robot
from pbfd_torch.models import file_setup
from tests.gymnasium_files import gymnasium_file
from tests.states import implicit

STEP, STEPS = 0.008, 250
ROBOTS = ["hopper", "walker2d", "walker2d_v5", "ant", "half_cheetah", "humanoid"]
# [s]; the ant starts .52 rad outside, the humanoid .03, and limits bring joints back; the others are inside from the start
IN_LIMITS_FROM = {"ant": 0.75, "humanoid": 0.5}
pytestmark = pytest.mark.filterwarnings("ignore::pbfd_torch.errors.NotModelledWarning", "ignore:compiler attribute")


@pytest.mark.parametrize("name", ROBOTS)
def test_left_to_itself(name: str) -> None:
    """Two seconds without control: all steps solved; total energy falls in every step, from that of the initial pose on; joints
    within 3 mrad (mm) of their limits; nothing deeper in the ground than 5 mm; in the end the robot lies or stands on it."""
    setup = file_setup(gymnasium_file(name))
    simulator = implicit(setup.scene, STEP)
    rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=STEPS)
    assert bool(rollout.solved.all()), f"{int((~rollout.solved).sum())} of {STEPS} steps unsolved"

    start = setup.scene.energy(setup.q, setup.v)
    energy = torch.cat((start[None], rollout.energy[1:]))[:, 0]
    assert float((energy[1:] - energy[:-1]).max()) < 1e-6
    assert float(energy[-1]) < float(energy[0])

    a = setup.scene.articulation
    t = a.topology
    x, lower, upper = rollout.q[:, 0, t.scalar_q], a.lower[t.scalar_v], a.upper[t.scalar_v]
    beyond = torch.maximum(lower - x, x - upper)[rollout.time >= IN_LIMITS_FROM.get(name, 0.0)]
    assert torch.isfinite(beyond).any()
    assert float(beyond.max()) < 3e-3

    assert float(rollout.penetration.max()) < 5e-3
    assert bool((rollout.contact_depth[-1] > 0).any()), "nothing touches the ground at the end"
    assert float(rollout.link_poses[-1, 0, 0, 2, 3]) > 0


@pytest.mark.parametrize("name", ROBOTS)
def test_only_numbers_of_mujocos_method_are_left_out(name: str) -> None:
    """Whatever moves these robots is modelled; how MuJoCo softens contacts and limits and how it steps is not read."""
    method = {"integrator", "iterations", "solver", "margin", "solref", "solimp", "solreflimit", "solimplimit"}
    lines = load_robot(gymnasium_file(name)).not_modelled
    assert lines
    for line in lines:
        of, _, names = line.partition(": ")
        assert of in {"attributes of <geom>", "attributes of <joint>", "attributes of <option>"}
        assert {part.split(" ")[0] for part in names.split(", ")} <= method
    assert file_setup(gymnasium_file(name)).notes == [f"not modelled: {line}" for line in lines]
