"""MJCF files: what a robot becomes, and the words about files that cannot be used.

Kinematics, dynamics and joint forces of MJCF robots are compared with MuJoCo in test_against_mujoco.py; obstacles and
who touches whom are in test_loading_collisions.py, what is left out in test_loading_left_out.py."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import pytest
import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.pairing import touch
from pbfd_torch.contact.shapes import Box, Capsule, ConvexHull, Cylinder, Ellipsoid, Sphere
from pbfd_torch.errors import InputError, ModelError, NotModelledWarning
from pbfd_torch.loading import Robot, load_mjcf, load_robot
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.tree.rotations import quaternion_matrix
from tests.mjcf_texts import BODY, loaded, write

JOINTS = Path(__file__).parent / "data" / "joints.xml"


@pytest.fixture(scope="module")
def robot() -> Robot:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotModelledWarning)
        return load_robot(JOINTS)


# what a robot becomes -----------------------------------------------------------------------------------------------------


def test_names(robot: Robot) -> None:
    assert robot.name == "joints"
    assert robot.articulation.link_names == ("stand", "arm", "hand", "finger", "base", "leg")
    assert robot.articulation.joint_names == ("slide", "hinge", "ball", "knuckle", "root", "hip_x", "hip_y", "hip_z")
    assert robot.gravity == (0.3, -0.2, -9.5)


def test_elements_without_a_name_are_numbered(tmp_path: Path) -> None:
    bodies = "<body><joint/><geom size='1'/></body><body><freejoint/><geom size='1'/></body>"
    found = loaded(tmp_path, bodies)
    assert found.articulation.link_names == ("body1", "body2")
    assert found.articulation.joint_names == ("joint0", "joint1")
    assert [x.name for x in found.colliders] == ["geom0", "geom1"]


def test_terms_that_no_joint_asks_for_are_absent(tmp_path: Path, robot: Robot) -> None:
    assert [type(x).__name__ for x in robot.joint_terms] == [
        "Armature",
        "JointDamping",
        "JointSprings",
        "JointDryFriction",
        "JointLimits",
    ]
    assert loaded(tmp_path).joint_terms == ()


def test_limits_are_as_stiff_as_gravity_asks(tmp_path: Path) -> None:
    body = BODY.replace("<joint", "<joint range='-1 2'")
    found = loaded(tmp_path, body, "<compiler angle='radian'/><option gravity='0 3 4'/>")
    (limits,) = found.joint_terms
    assert isinstance(limits, JointLimits)
    torch.testing.assert_close(limits.stiffness, JointLimits.for_articulation(found.articulation, 5.0).stiffness)


def test_actuators(robot: Robot) -> None:
    a = robot.actuators
    assert a is not None
    assert a.names == ("torque", "servo", "speed", "affine")
    assert a.gear.tolist() == [3, 1.5, 1, 0.5]
    assert a.gain.tolist() == [1, 40, 7, 2]
    assert a.bias.tolist() == [0, 0, 0, 0.3]
    assert a.stiffness.tolist() == [0, 40, 0, 1]
    assert a.damping.tolist() == [0, 2, 7, 0.2]
    assert a.control_range.tolist() == [[-1, 1]] + [[-math.inf, math.inf]] * 3
    assert a.force_range.tolist() == [[-0.5, 0.6], [-math.inf, math.inf], [-4, 4], [-math.inf, math.inf]]


def test_limit_of_a_joints_total_actuator_force_is_before_the_gear(tmp_path: Path) -> None:
    body = BODY.replace("<joint", "<joint actuatorfrcrange='-6 3'")
    found = loaded(tmp_path, body, "<actuator><motor joint='j' gear='-2' forcerange='-1 5'/></actuator>")
    assert found.actuators is not None
    assert found.actuators.force_range.tolist() == [[-1, 3]]


def test_keyframes_hold_the_controls_of_modelled_actuators(robot: Robot) -> None:
    assert list(robot.keyframes) == ["bent"]
    key = robot.keyframes["bent"]
    assert key.control.tolist() == [1, 2, 3, 4]
    assert key.v.tolist() == [0] * robot.articulation.nv
    half = math.sqrt(0.5)
    expected = [0.1, 0.5, 1, 0, 0, 0, 0.3, 0, 0, 2, half, half, 0, 0, 0.1, 0.2, 0.3]
    torch.testing.assert_close(key.q, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-15)


def test_colliders(robot: Robot) -> None:
    found = {x.name: x for x in robot.colliders}
    assert list(found) == ["upper", "palm", "tip", "trunk", "wedge", "shin"]
    assert isinstance(found["upper"].shape, Capsule)
    assert found["upper"].shape.half_length == pytest.approx(math.hypot(0.3, 0.1) / 2)
    assert found["palm"].shape == Ellipsoid((0.1, 0.06, 0.04))
    assert found["tip"].shape == Box((0.02, 0.03, 0.06))
    assert found["tip"].link == "finger"
    assert found["trunk"].shape == Cylinder(0.2, 0.1)
    assert (found["trunk"].group, found["trunk"].mask) == (2, 4)
    assert found["shin"].shape == Sphere(0.05)


def test_mesh_stands_where_the_file_says(tmp_path: Path) -> None:
    """MuJoCo moves meshes to their centre of mass and principal axes."""
    corners = [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.5]]
    text = " ".join(str(x) for corner in corners for x in corner)
    body = "<body name='b'><joint/><geom type='mesh' mesh='m' pos='1 2 3'/></body>"
    (collider,) = loaded(tmp_path, body, f"<asset><mesh name='m' vertex='{text}'/></asset>").colliders
    assert isinstance(collider.shape, ConvexHull)
    turn = quaternion_matrix(torch.tensor(collider.quaternion, dtype=torch.float64))
    placed = torch.from_numpy(collider.shape.vertices) @ turn.T + torch.tensor(collider.position, dtype=torch.float64)
    expected = torch.tensor(corners, dtype=torch.float64) + torch.tensor([1.0, 2, 3])
    gaps = torch.cdist(placed, expected)
    assert float(gaps.amin(1).max()) < 1e-6
    assert float(gaps.amin(0).max()) < 1e-6


def test_friction_and_condim(tmp_path: Path) -> None:
    geoms = "<geom name='a' size='1' friction='0.3'/><geom name='b' size='1' condim='1'/>"
    found = loaded(tmp_path, f"<body><joint/>{geoms}</body>").colliders
    assert [(x.friction, x.frictionless) for x in found] == [(0.3, False), (1, True)]


def test_planes_on_the_world_are_obstacles(robot: Robot) -> None:
    floor, ramp = robot.obstacles
    assert isinstance(floor, HalfSpace)
    assert isinstance(ramp, HalfSpace)
    assert (floor.name, floor.friction, floor.priority) == ("floor", 0.7, 0)
    assert floor.normal == pytest.approx((math.sin(0.2), -math.sin(0.1) * math.cos(0.2), math.cos(0.1) * math.cos(0.2)))
    assert floor.offset == pytest.approx(-0.5 * math.cos(0.1) * math.cos(0.2))
    assert (ramp.name, ramp.friction, ramp.priority) == ("ramp", 0.5, 2)
    assert ramp.normal == pytest.approx((-math.sin(0.3), 0, math.cos(0.3)))
    assert ramp.offset == pytest.approx(-math.sin(0.3))


def test_explicit_pairs_touch_whatever_their_bits(robot: Robot) -> None:
    shin = next(x for x in robot.colliders if x.name == "shin")
    floor, ramp = robot.obstacles
    assert isinstance(floor, HalfSpace)
    assert isinstance(ramp, HalfSpace)
    assert (touch(shin, ramp), touch(shin, floor)) == (True, False)
    assert [x.name for x in robot.colliders if touch(x, ramp)] == ["upper", "palm", "tip", "wedge", "shin"]


@pytest.mark.parametrize(
    ("flag", "lost"),
    [
        ("gravity", "gravity"),
        ("contact", "colliders"),
        ("limit", "JointLimits"),
        ("spring", "JointSprings"),
        ("damper", "JointDamping"),
        ("frictionloss", "JointDryFriction"),
        ("actuation", "actuators"),
    ],
)
def test_disabled_features_are_off(tmp_path: Path, flag: str, lost: str) -> None:
    def present(robot: Robot) -> set[str]:
        names = [name for name in ("colliders", "obstacles", "actuators") if getattr(robot, name)]
        return {type(x).__name__ for x in robot.joint_terms} | {*names} | ({"gravity"} if any(robot.gravity) else set())

    body = BODY.replace("<joint", "<joint range='-1 1' stiffness='1' damping='1' frictionloss='1'")
    world, motor = body + "<geom type='plane' size='1 1 1'/>", "<actuator><motor joint='j'/></actuator>"
    everything = present(loaded(tmp_path, world, motor))
    rest = present(loaded(tmp_path, world, f"{motor}<option><flag {flag}='disable'/></option>"))
    assert everything - rest == ({"colliders", "obstacles"} if flag == "contact" else {lost})


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype(dtype: torch.dtype) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotModelledWarning)
        found = load_mjcf(JOINTS, dtype=dtype)
    assert found.articulation.dtype == found.keyframes["bent"].q.dtype == dtype
    assert found.actuators is not None
    assert found.actuators.gain.dtype == dtype


# files that cannot be used ------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*MuJoCo says")
@pytest.mark.parametrize(
    ("bodies", "words"),
    [
        ("<body name='b'><joint foo='1'/><geom size='1'/></body>", r"'foo'; Element 'joint', line 3"),
        ("<body name='b'><joint type='turn'/><geom size='1'/></body>", r"invalid keyword: 'turn'; Element 'joint', line 3"),
        ("<body name='b'>", r":\d: malformed XML: Opening and ending tag mismatch"),
        ("<body name='b'><joint/></body>", r"mass and inertia of moving bodies .* 'b'"),
        ("<body name='b'><joint/><inertial pos='0 0 0' mass='-1' diaginertia='1 1 1'/></body>", r"mass .* 'b'"),
        ("<body name='b'><joint/><inertial pos='0 0 0' mass='1' diaginertia='1 -1 1'/></body>", r"inertia .* 'b'"),
        (BODY.replace("<joint", "<joint limited='true' range='2 1'"), r"range.* 'j'"),
        (BODY.replace("<joint", "<joint pos='nan 0 0'"), r":3: joint 'j': pos of <joint> is 'nan 0 0': must be finite"),
        (BODY.replace("<joint", "<joint damping='-1'"), r"joint 'j': damping is -1\.0: must be ≥ 0"),
        (BODY.replace("<joint", "<joint stiffness='-2'"), r"joint 'j': stiffness is -2\.0: must be ≥ 0"),
        (BODY.replace("<geom", "<geom friction='-1'"), r"geom 'g': friction of collider 'g' is -1\.0"),
        (BODY + BODY, r"repeated name 'b'"),
        ("<body name='b'><geom size='1'/></body>", r"no link can move"),
        (
            "<body><joint/><geom type='mesh' mesh='m'/></body></worldbody><asset><mesh name='m' file='no.stl'/></asset><worldbody>",
            r"'no\.stl'",
        ),
    ],
)
def test_bad_content(tmp_path: Path, bodies: str, words: str) -> None:
    file = write(tmp_path, bodies)
    with pytest.raises(ModelError, match=words) as error:
        load_mjcf(file)
    assert str(error.value).startswith(f"{file}:")


@pytest.mark.filterwarnings("ignore:.*MuJoCo says")
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty"),
        ("not XML", "malformed XML"),
        ("<model/>", "root element is <model>: must be <robot>"),
        (
            "<mujoco>\n<option gravity='nan 0 0'/><worldbody>" + BODY + "</worldbody></mujoco>",
            r":2: gravity of <option> is 'nan 0 0': must be finite",
        ),
    ],
)
def test_bad_file(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "robot.xml"
    file.write_text(text)
    with pytest.raises(ModelError, match=words) as error:
        load_robot(file)
    assert str(file) in str(error.value)


def test_warnings_of_mujoco_are_passed_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = write(tmp_path, BODY, "<custom><numeric name='x' data='nan'/></custom>")
    with pytest.warns(UserWarning, match=r"robot\.xml: MuJoCo says: XML contains a 'NaN'"):
        load_mjcf(file)
    assert [x.name for x in tmp_path.iterdir()] == ["robot.xml"]
    assert capfd.readouterr() == ("", "")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"none\.xml: no such file"):
        load_mjcf(tmp_path / "none.xml")


def test_free_base_is_for_urdf(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="free_base is True: an MJCF file says itself what is free"):
        load_robot(write(tmp_path, BODY), free_base=True)
