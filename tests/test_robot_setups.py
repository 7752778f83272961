"""Robots from files as scenes: our hopper and walker have Gymnasium's parameters, our quadruped stands; ground is added where it
is needed."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.errors import InputError
from pbfd_torch.loading import Robot, load_robot
from pbfd_torch.models import SCENES, file_setup, robot_setup
from pbfd_torch.simulator import Simulator
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.tree.kinematics import place
from tests.gymnasium_files import gymnasium_file
from tests.scene_contacts import contact_of, depth, mu

ROOT = Path(__file__).parent.parent
ARM = Path(__file__).parent / "data" / "arm_description" / "arm.urdf"
pytestmark = pytest.mark.filterwarnings("ignore::pbfd_torch.errors.NotModelledWarning")


@pytest.fixture
def _no_log_file() -> Iterator[None]:
    """MuJoCo would log its warnings into the working directory."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    yield
    mujoco.set_mju_user_warning(before)


SAME = ["body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat", "body_parentid", "opt.gravity"]
SAME += ["jnt_type", "jnt_axis", "jnt_pos", "jnt_range", "jnt_limited", "jnt_stiffness", "jnt_bodyid", "qpos0"]
SAME += ["dof_damping", "dof_armature", "dof_frictionloss", "geom_type", "geom_pos", "geom_quat", "geom_bodyid"]
SAME += ["actuator_gear", "actuator_trnid", "actuator_ctrlrange", "actuator_ctrllimited", "actuator_gainprm", "actuator_biasprm"]


def compiled(file: Path) -> Any:
    return mujoco.MjSpec.from_file(str(file)).compile()


@pytest.mark.usefixtures("_no_log_file")
@pytest.mark.parametrize(("ours", "theirs"), [("hopper", "hopper"), ("walker", "walker2d_v5")])
def test_physical_parameters_are_gymnasiums(ours: str, theirs: str) -> None:
    """Compiled by MuJoCo, both files have the same bodies, joints, actuators, sizes of geoms, sliding friction and gravity."""
    file = gymnasium_file(theirs)
    a, b = compiled(ROOT / "models" / f"{ours}.xml"), compiled(file)
    for field in SAME:
        x, y = a, b
        for part in field.split("."):
            x, y = getattr(x, part), getattr(y, part)
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-14, err_msg=field)
    np.testing.assert_allclose(a.geom_size[1:], b.geom_size[1:], rtol=1e-12)  # geom 0 is the floor, whose size is for the eye
    np.testing.assert_array_equal(a.geom_friction[:, 0], b.geom_friction[:, 0])


@pytest.mark.parametrize(("ours", "theirs"), [("hopper", "hopper"), ("walker", "walker2d_v5")])
def test_loaded_as_gymnasiums(ours: str, theirs: str) -> None:
    """What we make of both files agrees too: inertia, limits, contact points, friction of every pair, actuators; at rest with the
    feet 4 cm above the ground."""
    a, b = SCENES[ours](), file_setup(gymnasium_file(theirs))
    for field in ("pseudo_inertia", "lower", "upper", "rest", "joint_axis", "joint_frame", "joint_ref"):
        x, y = getattr(a.scene.articulation, field), getattr(b.scene.articulation, field)
        torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(contact_of(a).position, contact_of(b).position, rtol=0, atol=1e-12)
    torch.testing.assert_close(contact_of(a).radius, contact_of(b).radius)
    assert mu(a) == mu(b)
    drives = [next(term for term in x.scene.terms if isinstance(term, Actuators)) for x in (a, b)]
    for name in (f.name for f in dataclasses.fields(Actuators)):
        x, y = (getattr(drive, name) for drive in drives)
        if isinstance(x, Tensor):
            torch.testing.assert_close(x, y)
    assert drives[0].nu == drives[1].nu == (3 if ours == "hopper" else 6)
    torch.testing.assert_close(depth(a).amax(-1), depth(a).new_tensor([-0.04]), rtol=0, atol=1e-12)
    assert not a.v.any()
    assert a.notes == []


def test_friction_of_feet_and_bodies() -> None:
    """A pair has the larger μ of its two sides: hopper's foot 2 and body 1 (the floor's), walker's feet 1.9 and bodies .9."""
    for name, foot, body in (("hopper", 2.0, 1.0), ("walker", 1.9, 0.9)):
        setup = SCENES[name]()
        found = dict(zip((part for part, _ in contact_of(setup).pairs), mu(setup), strict=True))
        assert found == {part: foot if part.startswith("foot") else body for part in found}


PAIRS = [(3, 0, 3), (3, 0, 1), (1, 0, 3), (1, 0, 1), (3, 1, 1), (1, 1, 3)]


@pytest.mark.usefixtures("_no_log_file")
@pytest.mark.parametrize(("floor_condim", "floor_priority", "ball_condim"), PAIRS)
def test_friction_of_a_pair_is_mujocos(tmp_path: Path, floor_condim: int, floor_priority: int, ball_condim: int) -> None:
    """A ball with μ = 2 on a floor with μ = .5, either of which may be frictionless (condim 1) or have priority: MuJoCo's μ."""
    file = tmp_path / "ball.xml"
    floor = f"<geom name='floor' type='plane' size='1 1 1' friction='0.5' condim='{floor_condim}' priority='{floor_priority}'/>"
    ball = f"<body pos='0 0 0.09'><freejoint/><geom size='0.1' friction='2' condim='{ball_condim}'/></body>"
    file.write_text(f"<mujoco><worldbody>{floor}{ball}</worldbody></mujoco>")
    model = compiled(file)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 1
    expected = float(data.contact.friction[0, 0]) if data.contact.dim[0] > 1 else 0.0
    assert mu(file_setup(file)) == [expected]


def loaded(text: str, folder: Path) -> Robot:
    file = folder / "robot.xml"
    file.write_text(f"<mujoco>{text}</mujoco>")
    return load_robot(file)


BALL = "<body pos='0 0 3'>{}<geom size='0.1' {}/></body>"
FREE, HINGED = BALL.format("<freejoint/>", ""), BALL.format("<joint name='j'/>", "")
GHOST = BALL.format("<freejoint/>", "contype='0' conaffinity='0'")
PLANE = "<geom type='plane' size='1 1 1' pos='0 0 -7'/>"


def test_ground_below_a_free_robot() -> None:
    """A robot that can fall, from a file without ground, starts on level ground that its lowest point just touches; the notes say
    so. Told to be fixed, the same robot gets none."""
    setup = robot_setup(load_robot(ARM, free_base=True))
    (ground,) = setup.scene.obstacles
    assert isinstance(ground, HalfSpace)
    assert ground.normal == (0.0, 0.0, 1.0)
    assert f"the file has no ground: a level one was added at z = {ground.offset:.4g} m" in setup.notes
    torch.testing.assert_close(depth(setup).amax(-1), torch.zeros(1, dtype=torch.float64), rtol=0, atol=1e-12)

    fixed = robot_setup(load_robot(ARM, free_base=False))
    assert len(fixed.scene.obstacles) == 0
    assert not any("ground" in x for x in fixed.notes)
    assert not any(isinstance(term, Contact) for term in fixed.scene.terms)


@pytest.mark.parametrize(
    ("text", "heights"),
    [
        (f"<worldbody>{FREE}</worldbody>", [2.9]),
        (f"<worldbody>{PLANE}{FREE}</worldbody>", [-7]),
        (f"<option gravity='0 0 0'/><worldbody>{FREE}</worldbody>", []),
        (f"<worldbody>{HINGED}</worldbody>", []),
        (f"<worldbody>{GHOST}</worldbody>", []),
    ],
    ids=["free", "own ground", "weightless", "hinged", "without colliders"],
)
def test_where_ground_is_added(tmp_path: Path, text: str, heights: list[float]) -> None:
    """Only where a free robot would fall onto nothing although it could touch something; a file's own ground stays alone."""
    setup = robot_setup(loaded(text, tmp_path))
    assert [x.offset for x in setup.scene.obstacles if isinstance(x, HalfSpace)] == pytest.approx(heights)
    assert len(setup.scene.obstacles) == len(heights)
    assert any("ground" in x for x in setup.notes) == (heights == [2.9])


def test_robot_setup_takes_keyframes(tmp_path: Path) -> None:
    """A keyframe gives configuration, velocity and held control of every world; an unknown one is refused with the known names."""
    text = (
        f"<worldbody>{HINGED}</worldbody><actuator><motor joint='j'/></actuator>"
        "<keyframe><key name='moving' qpos='0.5' qvel='2' ctrl='3'/></keyframe>"
    )
    robot = loaded(text, tmp_path)
    setup = robot_setup(robot, worlds=2, keyframe="moving")
    assert (setup.q.tolist(), setup.v.tolist()) == ([[0.5], [0.5]], [[2], [2]])
    assert setup.controls(3).tolist() == [[[3], [3]]] * 3
    setup = robot_setup(robot)
    assert (setup.q.tolist(), setup.v.tolist(), setup.controls(1).tolist()) == ([[0]], [[0]], [[[0]]])
    with pytest.raises(InputError, match="no keyframe named 'home': the keyframes are moving"):
        robot_setup(robot, keyframe="home")


def test_quadruped_stands() -> None:
    """Twelve servos with a largest force, each within its joint's range, hold 12.2 kg: dropped by 2 cm, after 1 s it stands on its
    four feet, its hinges within .15 rad of where they are told to be, and hardly moves."""
    setup = SCENES["quadruped"]()
    model = compiled(ROOT / "models" / "quadruped.xml")
    assert model.body_mass.sum() == pytest.approx(12.2)
    np.testing.assert_allclose(model.actuator_ctrlrange, model.jnt_range[1:], rtol=1e-15)
    assert (model.actuator_forcerange[:, 1] > 0).all()
    simulator = Simulator(setup.scene, setup.dt)
    controls = setup.controls(125)
    rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v, controls[0]), controls)
    assert bool(rollout.solved.all())
    q, v = rollout.q[-1], rollout.v[-1]
    assert 0.28 < float(q[0, 2]) < 0.32
    assert float((q[0, 7:] - controls[0, 0]).abs().max()) < 0.15
    assert float(v.abs().max()) < 0.1
    deep = contact_of(setup).depth(place(setup.scene.articulation, q))[0] > 0
    found = [part for (part, _), touches in zip(contact_of(setup).pairs, deep.tolist(), strict=True) if touches]
    assert [name.removesuffix("_foot") for name in found] == ["front_left", "front_right", "rear_left", "rear_right"]
