"""How scenes look: the visuals of robot files, links without shapes, and which way is up."""

from __future__ import annotations

import dataclasses
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pbfd_torch.loading import load_robot
from pbfd_torch.loading.scene import robot_scene
from pbfd_torch.loading.urdf_visuals import urdf_visuals
from pbfd_torch.models import SCENES, file_setup
from pbfd_torch.records.depiction import depicted


def test_up_is_against_gravity() -> None:
    """The slope is drawn inclined."""
    up = depicted(SCENES["chain-slope"]().scene).up
    np.testing.assert_allclose(up, (-0.5, 0.0, math.sqrt(0.75)), atol=1e-12)


URDF = """<robot name="arm"><material name="red"><color rgba="0.9 0.1 0.2 1"/></material>
<link name="base"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
 <visual><origin xyz="0 0 0.5" rpy="0 0 0"/><geometry><box size="0.2 0.4 1"/></geometry><material name="red"/></visual>
 <visual><geometry><mesh filename="missing.stl"/></geometry></visual>
 <collision><geometry><sphere radius="0.3"/></geometry></collision></link>
<link name="rod"><inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
 <collision><geometry><cylinder radius="0.1" length="0.6"/></geometry></collision></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
 <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def test_urdf_visuals(tmp_path: Path) -> None:
    """A link looks like its <visual>, in its colour and place; one without like its collision shape; a mesh that is missing is said
    and left out; a file that has gone leaves the collision shapes."""
    file = tmp_path / "arm.urdf"
    file.write_text(URDF)
    scene = robot_scene(load_robot(file, free_base=False))
    with pytest.warns(UserWarning, match=r"missing\.stl"):
        seen = depicted(scene)
    box, rod = seen.visuals
    assert (box.body, rod.body) == (0, 1)
    assert box.color == (0.9, 0.1, 0.2)
    np.testing.assert_allclose([box.vertices.min(0), box.vertices.max(0)], [(-0.1, -0.2, 0), (0.1, 0.2, 1)], atol=1e-6)
    np.testing.assert_allclose(rod.vertices.max(0), (0.1, 0.1, 0.3), atol=2e-3)
    (hinge,) = seen.joints
    assert (hinge.link, hinge.axis) == (1, (0.0, 1.0, 0.0))
    other = tmp_path / "other.urdf"
    other.write_text(URDF)
    gone = robot_scene(load_robot(other, free_base=False))
    other.unlink()
    with pytest.warns(UserWarning, match="colliders"):
        assert {x.name for x in depicted(gone).visuals} == {"base", "rod_0"}


def test_mirrored_visuals_are_not_inside_out(tmp_path: Path) -> None:
    """Faces of a mesh with a negative scale are counterclockwise seen from outside, as those of all others."""
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.stl")
    body = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    for scale in ("1 1 1", "-1 1 1", "1 -2 1", "-1 -1 -1", "-1 -1 1"):
        visual = f'<visual><geometry><mesh filename="box.stl" scale="{scale}"/></geometry></visual>'
        (tmp_path / "box.urdf").write_text(f'<robot name="r"><link name="a">{body}{visual}</link></robot>')
        (seen,) = load_robot(tmp_path / "box.urdf").visuals()
        urdf_visuals.cache_clear()
        assert trimesh.Trimesh(seen.vertices, seen.faces).volume == pytest.approx(12 if "-2" in scale else 6), scale


def test_mjcf_visuals(tmp_path: Path) -> None:
    """Geoms of the visible groups are drawn, in their colours; those of group 3 are not; one of the world that cannot collide
    belongs to no body."""
    file = tmp_path / "robot.xml"
    file.write_text(
        '<mujoco><worldbody><geom name="sign" type="box" size=".1 .1 .1" contype="0" conaffinity="0" rgba="0 1 0 1"/>'
        '<geom name="floor" type="plane" size="1 1 1"/><body name="ball"><freejoint/>'
        '<geom name="skin" type="sphere" size=".2" rgba="1 0 0 1" contype="0" conaffinity="0"/>'
        '<geom name="hard" type="box" size=".1 .1 .1" group="3"/></body></worldbody></mujoco>'
    )
    seen = depicted(robot_scene(load_robot(file)))
    assert {(x.name, x.body, x.color) for x in seen.visuals} == {("sign", -1, (0, 1, 0)), ("skin", 0, (1, 0, 0))}
    assert [x.name for x in seen.planes] == ["floor"]


def test_a_link_without_shapes_looks_like_its_inertia() -> None:
    """The box drawn has the inertia of the link: m(b² + c²)/3 of its half extents, about each axis."""
    scene = dataclasses.replace(SCENES["chain-fixed"]().scene, visuals=tuple)
    visual = depicted(scene).visuals[0]
    half = 0.5 * (visual.vertices.max(0) - visual.vertices.min(0)).astype(float)
    around = 0.1 * (half @ half - half**2) / 3
    np.testing.assert_allclose(around, (0.1 * 0.02**2 / 2, *2 * [0.1 * (3 * 0.02**2 + 0.1**2) / 12]), rtol=1e-4)
    np.testing.assert_allclose(visual.vertices.mean(0), (0.05, 0, 0), atol=1e-6)


def test_file_setups_are_drawn_without_warnings() -> None:
    """Our own robots' files load and are depicted without complaints."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        assert len(depicted(file_setup(Path(__file__).parents[1] / "models" / "walker.xml").scene).visuals) == 7
