"""URDF files: what a robot becomes, what is left out and said so, and the words about files that cannot be used."""

from __future__ import annotations

import math
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from pbfd_torch.contact.shapes import Box, Capsule, ConvexHull, Cylinder, Sphere
from pbfd_torch.errors import ModelError, NotModelledWarning
from pbfd_torch.loading import Robot, load_robot
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import JointDamping
from pbfd_torch.tree.articulation import JointKind
from pbfd_torch.tree.kinematics import place
from pbfd_torch.tree.rotations import quaternion_matrix

ARM = Path(__file__).parent / "data" / "arm_description" / "arm.urdf"
LIMIT = '<limit lower="-9" upper="9"/>'
SOLID = '<inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'


def link(name: str, content: str = SOLID) -> str:
    return f'<link name="{name}">{content}</link>\n'


def joint(name: str, parent: str, child: str, kind: str = "continuous", content: str = "") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{content}</joint>\n'


def write(folder: Path, *parts: str) -> Path:
    file = folder / "robot.urdf"
    file.write_text("<robot name='r'>\n" + "".join(parts) + "</robot>")
    return file


def loaded(folder: Path, *parts: str, free_base: bool | None = None) -> Robot:
    return load_robot(write(folder, *parts), free_base=free_base)


@pytest.fixture(scope="module")
def arm() -> Robot:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotModelledWarning)
        return load_robot(ARM)


# what a robot becomes -----------------------------------------------------------------------------------------------------


def test_links_come_parents_first(arm: Robot) -> None:
    assert arm.name == "arm"
    assert arm.articulation.link_names == ("base", "upper", "slider", "tool")
    assert arm.articulation.joint_names == ("base_free", "shoulder", "extend", "wrist")
    assert arm.articulation.topology.joint_sizes[0] == (JointKind.FREE.nq, JointKind.FREE.nv)


def test_numbers_keep_64_bits(arm: Robot) -> None:
    assert arm.articulation.joint_frame[1, 0, 3].item() == 0.123456789012345678


def test_roll_pitch_yaw_turn_about_fixed_axes(arm: Robot) -> None:
    half = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64) / 2
    x, y, z = (
        quaternion_matrix(torch.cat((half[i : i + 1].cos(), torch.eye(3, dtype=torch.float64)[i] * half[i].sin())))
        for i in range(3)
    )
    torch.testing.assert_close(arm.articulation.joint_frame[1, :3, :3], z @ y @ x, rtol=0, atol=1e-15)


def test_axes_default_to_x_and_are_scaled_to_one(arm: Robot) -> None:
    assert arm.articulation.joint_axis[1:].tolist() == [[0, 1, 0], [1, 0, 0], [0, 0, 1]]


def test_limits(arm: Robot) -> None:
    assert arm.articulation.lower.tolist() == [-math.inf] * 6 + [-1.25, 0, -math.inf]
    assert arm.articulation.upper.tolist() == [math.inf] * 6 + [2.5, 0.4, math.inf]


def test_missing_limits_are_none_and_one_alone_makes_the_other_zero(tmp_path: Path) -> None:
    limits = ['<limit upper="1.5"/>', '<limit effort="1" velocity="0"/>', ""]
    parts = [link(f"l{k}") + joint(f"j{k}", "world", f"l{k}", "revolute", text) for k, text in enumerate(limits)]
    with pytest.warns(NotModelledWarning, match=r"without limits move without \(2\): j1, j2"):
        robot = loaded(tmp_path, link("world"), *parts)
    assert robot.articulation.lower.tolist() == [0, -math.inf, -math.inf]
    assert robot.articulation.upper.tolist() == [1.5, math.inf, math.inf]


def test_inertia_is_turned_into_the_link_axes(arm: Robot) -> None:
    """∫ρ x xᵀ of the upper arm's own frame, from that of the frame in which its inertia is given."""
    given = torch.tensor([[0.01, 0.001, 0], [0.001, 0.02, -0.002], [0, -0.002, 0.015]], dtype=torch.float64)
    turns = []
    for axis, angle in enumerate((0.3, -0.2, 0.7)):
        quaternion = torch.zeros(4, dtype=torch.float64)
        quaternion[0], quaternion[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
        turns.append(quaternion_matrix(quaternion))
    turn = turns[2] @ turns[1] @ turns[0]
    com = torch.tensor([0.1, 0.02, 0], dtype=torch.float64)
    second = 0.5 * given.trace() * torch.eye(3, dtype=torch.float64) - given
    expected = turn @ second @ turn.T + 1.5 * com[:, None] * com
    torch.testing.assert_close(arm.articulation.pseudo_inertia[1, :3, :3], expected, rtol=0, atol=1e-16)
    torch.testing.assert_close(arm.articulation.pseudo_inertia[1, :3, 3], 1.5 * com, rtol=0, atol=1e-16)
    assert arm.articulation.mass.tolist() == [3, 1.5, 0.5, 0.2]


def test_joint_terms(arm: Robot) -> None:
    damping, friction, limits = arm.joint_terms
    assert isinstance(damping, JointDamping)
    assert damping.damping.tolist() == [0] * 6 + [0.7, 0, 0]
    assert isinstance(friction, JointDryFriction)
    assert friction.torque.tolist() == [0] * 6 + [0.3, 0, 0]
    assert isinstance(limits, JointLimits)


def test_terms_that_no_joint_asks_for_are_absent(tmp_path: Path) -> None:
    assert loaded(tmp_path, link("a"), link("b"), joint("j", "a", "b")).joint_terms == ()


def test_motors_have_the_effort_limits(arm: Robot) -> None:
    assert arm.actuators is not None
    assert arm.actuators.names == ("shoulder", "extend", "wrist")
    assert arm.actuators.force_range.tolist() == [[-40, 40], [-120, 120], [-math.inf, math.inf]]
    assert arm.actuators.gain.tolist() == [1, 1, 1]
    assert arm.actuators.stiffness.tolist() == [0, 0, 0]


def test_colliders(arm: Robot) -> None:
    shapes = {x.name: (x.link, x.shape) for x in arm.colliders}
    assert shapes["ball"] == ("tool", Sphere(0.03))
    assert shapes["tool_1"] == ("tool", Capsule(0.02, 0.05))
    assert shapes["bar"] == ("upper", Cylinder(0.04, 0.15))
    assert shapes["cube"] == ("upper", Box((0.1, 0.05, 0.2)))
    hull = shapes["hull"][1]
    assert isinstance(hull, ConvexHull)
    assert sorted(hull.vertices.tolist()) == [[0, 0, 0], [0, 0, 0.05], [0, 0.2, 0], [0.1, 0, 0]]
    bar = next(x for x in arm.colliders if x.name == "bar")
    assert bar.quaternion == pytest.approx((math.sqrt(0.5), 0, math.sqrt(0.5), 0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype(dtype: torch.dtype) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotModelledWarning)
        robot = load_robot(ARM, dtype=dtype)
    assert robot.articulation.dtype == dtype
    assert robot.actuators is not None
    assert robot.actuators.gain.dtype == dtype
    assert isinstance(robot.joint_terms[0], JointDamping)
    assert robot.joint_terms[0].damping.dtype == dtype


# the base -----------------------------------------------------------------------------------------------------------------


def test_base_with_mass_is_free(tmp_path: Path) -> None:
    assert loaded(tmp_path, link("a"), link("b"), joint("j", "a", "b")).articulation.nv == 7


@pytest.mark.parametrize("parts", [(link("world"), link("b")), (link("world", ""), link("b")), (link("a", ""), link("b"))])
def test_base_without_mass_or_named_world_is_fixed(tmp_path: Path, parts: tuple[str, str]) -> None:
    parent = "world" if "world" in parts[0] else "a"
    assert loaded(tmp_path, *parts, joint("j", parent, "b")).articulation.nv == 1


def test_mass_of_what_is_fixed_to_the_base_counts(tmp_path: Path) -> None:
    parts = (link("a", ""), link("b"), link("c"), joint("f", "a", "b", "fixed"), joint("j", "b", "c"))
    assert loaded(tmp_path, *parts).articulation.nv == 7


def test_free_base_can_be_chosen(tmp_path: Path) -> None:
    assert loaded(tmp_path, link("a"), link("b"), joint("j", "a", "b"), free_base=False).articulation.nv == 1
    assert loaded(tmp_path, link("world"), link("b"), joint("j", "world", "b"), free_base=True).articulation.nv == 7


# planar and floating joints -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("axis", "pose"),
    [
        ("0 0 2", [[0, -1, 0, 3], [1, 0, 0, 4], [0, 0, 1, 0]]),
        ("1 0 0", [[1, 0, 0, 0], [0, 0, -1, 3], [0, 1, 0, 4]]),
        ("0 1 0", [[0, 0, 1, 4], [0, 1, 0, 0], [-1, 0, 0, 3]]),
    ],
)
def test_planar_joint_slides_in_its_plane_and_turns_about_its_normal(tmp_path: Path, axis: str, pose: list[list[float]]) -> None:
    robot = loaded(tmp_path, link("world"), link("b"), joint("j", "world", "b", "planar", f'<axis xyz="{axis}"/>'))
    assert robot.articulation.joint_names == ("j_1", "j_2", "j_turn")
    placed = place(robot.articulation, torch.tensor([3, 4, math.pi / 2], dtype=torch.float64)).poses[1]
    torch.testing.assert_close(placed[:3], torch.tensor(pose, dtype=torch.float64), rtol=0, atol=1e-15)


def test_plane_that_is_not_aligned(tmp_path: Path) -> None:
    robot = loaded(tmp_path, link("world"), link("b"), joint("j", "world", "b", "planar", '<axis xyz="1 2 3"/>'))
    axes = robot.articulation.joint_axis
    torch.testing.assert_close(axes @ axes.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-15)
    torch.testing.assert_close(torch.linalg.cross(axes[0], axes[1]), axes[2], rtol=0, atol=1e-15)


def test_floating_joint_on_what_stands_is_free_in_the_world(tmp_path: Path) -> None:
    lifted = joint("f", "world", "a", "fixed", '<origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>')
    floating = joint("j", "a", "b", "floating", '<origin xyz="1 0 0"/>')
    robot = loaded(tmp_path, link("world"), link("a"), link("b"), lifted, floating)
    assert robot.articulation.joint_names == ("j",)
    expected = [0, 1, 1, math.sqrt(0.5), 0, 0, math.sqrt(0.5)]
    torch.testing.assert_close(robot.articulation.rest, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-15)
    assert robot.actuators is None


def test_floating_joint_on_a_moving_link_is_three_slides_and_a_ball(tmp_path: Path) -> None:
    floating = joint("j", "a", "b", "floating", '<origin xyz="1 0 0" rpy="0 0 1.5707963267948966"/>')
    robot = loaded(tmp_path, link("world"), link("a"), link("b"), joint("k", "world", "a", "prismatic", LIMIT), floating)
    assert robot.articulation.joint_names == ("k", "j_x", "j_y", "j_z", "j_turn")
    q = robot.articulation.rest.clone()
    q[:4] = torch.tensor([10, 0.5, 0, 2], dtype=torch.float64)
    assert place(robot.articulation, q).poses[2, :3, 3].tolist() == pytest.approx([11, 0.5, 2])


# meshes -------------------------------------------------------------------------------------------------------------------


def mesh_robot(folder: Path, filename: str) -> Robot:
    hull = f'<collision name="shell"><geometry><mesh filename="{filename}"/></geometry></collision>'
    return loaded(folder, link("world"), link("b", SOLID + hull), joint("j", "world", "b"))


def put_mesh(folder: Path) -> Path:
    folder.mkdir(parents=True)
    target = folder / "part.obj"
    target.write_bytes((ARM.parent / "meshes" / "tetrahedron.obj").read_bytes())
    return target


def test_package_is_a_folder_above(tmp_path: Path) -> None:
    put_mesh(tmp_path / "my_robot" / "meshes")
    (tmp_path / "my_robot" / "urdf").mkdir()
    assert len(mesh_robot(tmp_path / "my_robot" / "urdf", "package://my_robot/meshes/part.obj").colliders) == 1


def test_package_is_a_neighbour_of_a_folder_above(tmp_path: Path) -> None:
    put_mesh(tmp_path / "my_meshes" / "parts")
    (tmp_path / "my_robot" / "urdf").mkdir(parents=True)
    assert len(mesh_robot(tmp_path / "my_robot" / "urdf", "package://my_meshes/parts/part.obj").colliders) == 1


def test_package_is_found_through_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put_mesh(tmp_path / "elsewhere" / "my_meshes")
    (tmp_path / "robot").mkdir()
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{tmp_path / 'elsewhere'}")
    assert len(mesh_robot(tmp_path / "robot", "package://my_meshes/part.obj").colliders) == 1


def test_absolute_and_relative_paths(tmp_path: Path) -> None:
    target = put_mesh(tmp_path / "with space")
    for filename in ("with space/part.obj", str(target), target.as_uri()):
        assert len(mesh_robot(tmp_path, filename).colliders) == 1


def test_missing_mesh_says_where_it_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(
        ModelError, match=r"link 'b', collision 'shell': mesh 'package://my_robot/part\.obj' not found; looked at"
    ) as error:
        mesh_robot(tmp_path, "package://my_robot/part.obj")
    assert str(tmp_path / "my_robot" / "part.obj") in str(error.value)
    assert str(tmp_path / "robot.urdf:3") in str(error.value)


def test_visual_meshes_are_not_read(arm: Robot) -> None:
    assert "not_there.stl" in ARM.read_text()
    assert not any("not_there" in line for line in arm.not_modelled)


# what is left out ---------------------------------------------------------------------------------------------------------


def test_left_out_features_are_listed_with_counts(arm: Robot) -> None:
    assert set(arm.not_modelled) == {
        "mimic, these joints move freely (1): wrist",
        "velocity limits (3): wrist, shoulder, extend",
        "<safety_controller> (1): shoulder",
        "<transmission> (1)",
        "<gazebo> (2)",
        "tag contact of <link> (1)",
    }


def test_left_out_features_are_warned_about_and_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.warns(NotModelledWarning) as caught:
        robot = load_robot(ARM)
    assert sorted(str(w.message) for w in caught) == sorted(f"{ARM}: not modelled: {line}" for line in robot.not_modelled)
    assert capfd.readouterr() == ("", "")


def test_a_plain_robot_leaves_nothing_out(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert loaded(tmp_path, link("a"), link("b"), joint("j", "a", "b")).not_modelled == ()


# beside ---------------------------------------------------------------------------------------------------------------------


def test_inertia_is_checked_before_rounding_to_32_bits(tmp_path: Path) -> None:
    """A light finger far from the origin: in 32 bits its inertia about its axis is below the rounding error."""
    inertia = '<inertia ixx="1e-9" ixy="0" ixz="0" iyy="1e-9" iyz="0" izz="1e-9"/>'
    finger = link("finger", f'<inertial><mass value="0.01"/>{inertia}</inertial>')
    hinge = joint("j", "world", "finger", content='<origin xyz="3 7 5"/>')
    assert load_robot(write(tmp_path, link("world"), finger, hinge), dtype=torch.float32).articulation.nv == 1


def test_importing_the_loaders_does_not_import_what_only_loading_needs() -> None:
    code = "import sys, pbfd_torch.loading; print({'mujoco', 'pytorch_kinematics', 'trimesh', 'lxml'} & {*sys.modules} or 'none')"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1])
    assert found.stdout.strip() == "none"
