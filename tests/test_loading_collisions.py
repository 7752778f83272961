"""What robot files say about collisions: obstacles, who touches whom, and links that overlap from the start."""

from __future__ import annotations

import itertools
import math
import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.height_field import HeightField
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Capsule, ConvexHull, Cylinder, Sphere
from pbfd_torch.errors import InputError, ModelError, NotModelledWarning
from pbfd_torch.loading import Robot, load_mjcf, load_robot, load_srdf_exclusions
from pbfd_torch.loading.scene import robot_scene
from pbfd_torch.models.robots import robot_setup
from pbfd_torch.simulator import Simulator
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms

pytestmark = pytest.mark.filterwarnings("ignore::pbfd_torch.errors.NotModelledWarning")
BODY = "<body name='b'><joint name='j'/><geom name='g' size='1'/></body>"


def write(folder: Path, bodies: str, more: str = "") -> Path:
    file = folder / "robot.xml"
    file.write_text(f"<mujoco>\n<worldbody>\n{bodies}\n</worldbody>\n{more}\n</mujoco>")
    return file


def loaded(folder: Path, bodies: str, more: str = "") -> Robot:
    return load_robot(write(folder, bodies, more))


def names_met(robot: Robot) -> set[frozenset[str]]:
    """Who can meet whom by the robot's colliders, obstacles and excluded pairs; for the only plane say «floor»."""
    names = [*robot.articulation.link_names, *(x.name for x in robot.obstacles if isinstance(x, Obstacle))]
    link = {x.name: x.link for x in robot.colliders}
    found = set()
    for term in contact_terms(robot.articulation, robot.colliders, robot.obstacles, ContactRules(excluded=robot.excluded)):
        if isinstance(term, BodyContact):
            finder: Any = term.finder
            of_bodies = finder.body if hasattr(finder, "body") else torch.arange(len(names))
            first, second = (of_bodies[x].tolist() for x in (finder.first, finder.second))
            found |= {frozenset((names[a], names[b])) for a, b in zip(first, second, strict=True)}
        elif isinstance(term, Contact):
            found |= {frozenset((link[name], "floor")) for name, _ in term.pairs}
    return found


# MJCF ---------------------------------------------------------------------------------------------------------------------


def test_solids_on_the_world_are_obstacles(tmp_path: Path) -> None:
    """Of the world itself and of bodies fixed to it, where MuJoCo puts them."""
    geoms = (
        "<geom name='a' size='0.3' friction='0.4' contype='2' conaffinity='6' priority='3' condim='1'/>"
        "<body name='table' pos='1 2 3' euler='0 0 90'>"
        "<geom name='slab' type='box' size='1 2 3' pos='1 0 0'/><geom name='c' type='capsule' size='0.1 0.2'/>"
        "<geom name='d' type='cylinder' size='0.1 0.2'/><geom name='e' type='ellipsoid' size='0.1 0.2 0.3'/>"
        "<geom name='f' type='mesh' mesh='m'/><geom name='ghost' size='1' contype='0' conaffinity='0'/></body>"
    )
    mesh = "<asset><mesh name='m' vertex='0 0 0  1 0 0  0 1 0  0 0 1'/></asset>"
    robot = loaded(tmp_path, geoms + BODY, mesh)
    found = {x.name: x for x in robot.obstacles if isinstance(x, Obstacle)}
    assert list(found) == ["a", "slab", "c", "d", "e", "f"]
    assert (found["a"].friction, found["a"].group, found["a"].mask, found["a"].priority) == (0.4, 2, 6, 3)
    assert (found["a"].frictionless, found["slab"].frictionless) == (True, False)
    assert found["a"].shape == Sphere(0.3)
    assert found["slab"].shape == Box((1, 2, 3))
    assert found["c"].shape == Capsule(0.1, 0.2)
    assert found["d"].shape == Cylinder(0.1, 0.2)
    ellipsoid, hull = found["e"].shape, found["f"].shape
    assert isinstance(ellipsoid, ConvexHull)
    assert ellipsoid.vertices.max(0) == pytest.approx([0.1, 0.2, 0.3])
    assert isinstance(hull, ConvexHull)
    frame = found["f"].carrier(torch.float64, torch.device("cpu")).start
    corners = torch.from_numpy(hull.vertices) @ frame[:3, :3].T + frame[:3, 3]
    expected = torch.tensor([[1.0, 2, 3], [1, 3, 3], [0, 2, 3], [1, 2, 4]], dtype=torch.float64)
    assert float(torch.cdist(corners, expected).amin(1).max()) < 1e-6
    assert found["slab"].position == pytest.approx((1, 3, 3))
    assert found["slab"].quaternion == pytest.approx((math.sqrt(0.5), 0, 0, math.sqrt(0.5)))
    assert [x.name for x in robot.colliders] == ["g"]
    assert robot.not_modelled == ()


def test_height_field(tmp_path: Path) -> None:
    """Rows along y, columns along x, heights scaled to the field's own, at the geom's place."""
    field = "<hfield name='h' nrow='2' ncol='3' size='2 1 0.5 0.1' elevation='0 1 2  3 4 4'/>"
    world = "<geom type='hfield' name='hill' hfield='h' pos='1 0 0.25' friction='0.3'/>"
    (hill,) = loaded(tmp_path, world + BODY, f"<asset>{field}</asset>").obstacles
    assert isinstance(hill, Obstacle)
    assert isinstance(hill.shape, HeightField)
    assert hill.shape.spacing == pytest.approx((2, 2))
    assert hill.position == pytest.approx((1, 0, 0.25))
    assert hill.friction == 0.3
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def height(x: float, y: float) -> float:
        """Of MuJoCo's field, where a ray from above meets it, just inside its border."""
        start, down = np.array([1 + 0.9999 * x, 0.9999 * y, 9.0]), np.array([0, 0, -1.0])
        return 9.0 - float(mujoco.mj_ray(model, data, start, down, None, 1, 1, np.zeros(1, np.int32))) - 0.25

    expected = np.array([[height(x, y) for y in (-1, 1)] for x in (-2, 0, 2)])
    assert np.ptp(expected) == pytest.approx(0.5, abs=1e-3)
    np.testing.assert_allclose(hill.shape.heights, expected, rtol=0, atol=2e-4)


WORLD = """
<geom name='stone' type='sphere' size='1'/>
<geom name='floor' type='plane' size='1 1 1'/>
<body name='table'><geom name='top' type='box' size='1 1 1'/>
  <body name='upper'><joint/><geom name='upper_g' type='capsule' size='1 1'/>
    <body name='plate'><geom name='plate_g' type='capsule' size='1 1'/>
      <body name='lower'><joint axis='1 0 0'/><joint axis='0 1 0'/><joint/><geom name='lower_g' type='capsule' size='1 1'/>
        <body name='bar'><geom name='bar_g' type='capsule' size='1 1' contype='2' conaffinity='4'/>
          <body name='foot'><joint/><geom name='foot_g' type='capsule' size='1 1' contype='4' conaffinity='3'/></body>
        </body>
      </body>
    </body>
    <body name='hand'><joint type='ball'/><geom name='hand_g' type='capsule' size='1 1'/></body>
  </body>
</body>
<body name='free'><freejoint/><geom name='free_g' type='capsule' size='1 1'/></body>
<body name='ghost'><freejoint/><geom name='ghost_g' type='capsule' size='1 1' contype='0' conaffinity='0'/></body>
"""
RULES = [
    "",
    "<exclude body1='hand' body2='foot'/><exclude body1='free' body2='table'/><exclude body1='world' body2='lower'/>",
    "<pair geom1='ghost_g' geom2='bar_g'/><pair geom1='top' geom2='ghost_g'/><pair geom1='ghost_g' geom2='floor'/>",
]


@pytest.mark.parametrize("rules", RULES, ids=["bits", "excludes", "pairs"])
def test_who_meets_whom_is_as_in_mujoco(tmp_path: Path, rules: str) -> None:
    """All geoms are in one place, so MuJoCo's contacts are all that its rules let touch: several joints on one body, bodies fixed
    to each other and to the world, bits, excludes and pairs."""
    file = write(tmp_path, WORLD, f"<contact>{rules}</contact>")
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    expected = {frozenset((model.geom(a).name, model.geom(b).name)) for a, b in data.contact.geom}

    robot = load_mjcf(file)
    geom = {x.link: x.name for x in robot.colliders}
    assert {frozenset(geom.get(x, x) for x in pair) for pair in names_met(robot)} == expected
    assert len(expected) > 10


def test_obstacle_with_the_name_of_a_link(tmp_path: Path) -> None:
    """Excluded pairs know both by their names."""
    world = "<geom name='b' type='box' size='1 1 1'/>" + BODY
    assert [x.name for x in loaded(tmp_path, world).obstacles] == ["b (geom)"]


def test_scene_on_other_obstacles_drops_pairs_with_the_files_own(tmp_path: Path) -> None:
    more = "<contact><exclude body1='world' body2='b'/></contact>"
    robot = loaded(tmp_path, "<geom name='wall' type='box' size='1 1 1'/>" + BODY, more)
    assert robot.excluded == (("wall", "b"),)
    assert not any(isinstance(x, Contact) for x in robot_scene(robot).terms)
    assert any(isinstance(x, Contact) for x in robot_scene(robot, [HalfSpace()]).terms)


# URDF ---------------------------------------------------------------------------------------------------------------------

SOLID = '<inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'


def link(name: str, *shapes: str, at: str = "0 0 0", rpy: str = "0 0 0", mass: str = SOLID) -> str:
    where = f'<origin xyz="{at}" rpy="{rpy}"/>'
    return (
        f'<link name="{name}">{mass}'
        + "".join(f"<collision>{where}<geometry>{x}</geometry></collision>" for x in shapes)
        + "</link>"
    )


def joint(parent: str, child: str, kind: str = "continuous", at: str = "0 0 0", rpy: str = "0 0 0") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{at}" rpy="{rpy}"/>'
    return f'<joint name="{parent}_{child}" type="{kind}">{ends}</joint>'


def urdf(folder: Path, *parts: str, **options: Any) -> Robot:
    file = folder / "robot.urdf"
    file.write_text("<robot name='r'>\n" + "\n".join(parts) + "</robot>")
    return load_robot(file, **options)


BALL, BOX, CYLINDER, CAPSULE = (
    '<sphere radius="0.1"/>',
    '<box size="2 4 6"/>',
    '<cylinder radius="0.1" length="0.4"/>',
    '<capsule radius="0.1" length="0.4"/>',
)
QUARTER = "0 0 1.5707963267948966"
ARM_ON_TABLE = (
    link("world"),
    link("table", BOX, CYLINDER, at="1 0 0", rpy="0 0 0.4"),
    joint("world", "table", "fixed", "0 0 5", QUARTER),
    link("mount", CAPSULE),
    joint("table", "mount", "fixed", "0 0 9"),
    link("arm", BALL),
    joint("mount", "arm", at="0 0 0.35"),
    link("hand", BALL),
    joint("arm", "hand", at="0 0 0.3"),
    link("tip", BALL),
    joint("hand", "tip", at="0 0 0.3"),
)


def test_links_fixed_to_the_world_are_obstacles(tmp_path: Path) -> None:
    robot = urdf(tmp_path, *ARM_ON_TABLE)
    table, leg, mount = robot.obstacles
    assert isinstance(table, Obstacle)
    assert isinstance(leg, Obstacle)
    assert isinstance(mount, Obstacle)
    assert [table.shape, leg.shape, mount.shape] == [Box((1, 2, 3)), Cylinder(0.1, 0.2), Capsule(0.1, 0.2)]
    assert [x.name for x in robot.obstacles] == ["table", "table", "mount"]
    assert table.position == pytest.approx((0, 1, 5))
    angle = 0.5 * (math.pi / 2 + 0.4)
    assert table.quaternion == pytest.approx((math.cos(angle), 0, 0, math.sin(angle)))
    assert mount.position == pytest.approx((0, 0, 14))
    assert [x.link for x in robot.colliders] == ["arm", "hand", "tip"]
    assert robot.not_modelled == ()


def test_links_joined_to_a_fixed_one_do_not_touch_it(tmp_path: Path) -> None:
    """The arm meets the table, but not the mount that it turns on; links joined by a joint do not meet either."""
    parts = [x.replace(BALL, CAPSULE) for x in ARM_ON_TABLE]
    parts = [x.replace('length="0.4"', 'length="0.05"') for x in parts]
    robot = urdf(tmp_path, *parts)
    assert robot.excluded == (("mount", "arm"),)
    expected = "arm-tip arm-table hand-table tip-table hand-mount tip-mount"
    assert names_met(robot) == {frozenset(x.split("-")) for x in expected.split()}


def test_excluded_pairs(tmp_path: Path) -> None:
    parts = [x.replace(BALL, CAPSULE).replace('length="0.4"', 'length="0.05"') for x in ARM_ON_TABLE]
    robot = urdf(tmp_path, *parts, excluded=[("tip", "arm"), ("table", "hand")])
    expected = "arm-table tip-table hand-mount tip-mount"
    assert names_met(robot) == {frozenset(x.split("-")) for x in expected.split()}
    assert len(robot_scene(robot).terms) > 1
    with pytest.raises(InputError, match=r"excluded pairs name 'nose': the links are world, table"):
        urdf(tmp_path, *parts, excluded=[("tip", "nose")])
    with pytest.raises(InputError, match="an MJCF file says itself what never touches"):
        load_robot(write(tmp_path, BODY), excluded=[("b", "c")])


@pytest.mark.parametrize(("distance", "overlap"), [(0.25, False), (0.2, False), (0.1995, False), (0.1985, True), (0.05, True)])
@pytest.mark.parametrize("shape", [BALL, '<box size="0.2 0.2 0.2"/>', '<cylinder radius="0.1" length="0.4"/>'])
def test_links_that_overlap_at_rest_do_not_touch(tmp_path: Path, shape: str, distance: float, overlap: bool) -> None:
    """By more than a millimetre; said by name, and the rest of the robot still touches itself."""
    far = link("far", BALL) + joint("b", "far", at="0 0 3")
    parts = (
        link("a", shape),
        link("between"),
        link("b", shape),
        joint("a", "between"),
        joint("between", "b", at=f"{distance} 0 0"),
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", NotModelledWarning)
        robot = urdf(tmp_path, *parts, far)
    line = "contact of links that overlap in the rest configuration (1): a and b"
    assert robot.not_modelled == ((line,) if overlap else ())
    assert [line in str(x.message) for x in caught] == [True] * overlap
    assert robot.excluded == ((("a", "b"),) if overlap else ())
    assert names_met(robot) == {frozenset(x) for x in [("a", "far"), *([] if overlap else [("a", "b")])]}


def test_no_pair_of_many_is_missed(tmp_path: Path) -> None:
    """More overlaps than a world has slots: all pairs of 14 boxes in one place but those that are joined."""
    names = [f"l{k}" for k in range(14)]
    boxes = [link(name, '<box size="0.2 0.2 0.2"/>') for name in names]
    chain = [joint(a, b) for a, b in itertools.pairwise(names)]
    robot = urdf(tmp_path, *boxes, *chain)
    assert len(robot.excluded) == 14 * 13 // 2 - 13
    assert names_met(robot) == set()


def test_an_arm_lies_on_its_table(tmp_path: Path) -> None:
    """A hinged bar falls onto the table that it is not joined to and stays on it."""
    parts = (
        link("world"),
        link("table", '<box size="2 2 0.1"/>'),
        joint("world", "table", "fixed"),
        link("post"),
        joint("table", "post", "fixed", "0 0 0.3"),
        link("bar", BALL, at="0.5 0 0", mass=SOLID.replace("<mass", '<origin xyz="0.5 0 0"/><mass')),
        joint("post", "bar").replace("</joint>", '<axis xyz="0 1 0"/></joint>'),
    )
    setup = robot_setup(urdf(tmp_path, *parts))
    simulator = Simulator(setup.scene, 0.01)
    rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=100)
    assert bool(rollout.solved.all())
    tip = rollout.link_poses[-1, 0, -1] @ rollout.q.new_tensor([0.5, 0, 0, 1])
    assert float(tip[2]) == pytest.approx(0.15, abs=2e-3)


def test_flat_shapes_of_fixed_links_are_listed(tmp_path: Path) -> None:
    """A mesh without an inside has no signed distance."""
    (tmp_path / "sheet.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")
    sheet = '<mesh filename="sheet.obj"/>'
    robot = urdf(tmp_path, link("world", sheet, BALL), link("b", BALL), joint("world", "b"))
    assert len(robot.obstacles) == 1
    assert robot.not_modelled == ("flat shapes of links fixed to the world are no obstacles (1): world_0",)


# SRDF ---------------------------------------------------------------------------------------------------------------------


def test_srdf_exclusions(tmp_path: Path) -> None:
    file = tmp_path / "robot.srdf"
    file.write_text(
        "<?xml version='1.0'?><robot name='r'><!-- <disable_collisions link1='x' link2='y'/> --><group name='g'/>"
        "<disable_collisions link1='arm' link2='tip' reason='Never'/><disable_collisions link1='table' link2='hand'/></robot>"
    )
    pairs = load_srdf_exclusions(file)
    assert pairs == (("arm", "tip"), ("table", "hand"))
    assert set(pairs) <= set(urdf(tmp_path, *ARM_ON_TABLE, excluded=pairs).excluded)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<robot>", r"malformed XML"),
        ("<mujoco/>", r"root element is <mujoco>: must be <robot>"),
        (
            "<robot>\n<disable_collisions link1='a'/></robot>",
            r"bad\.srdf:2: <disable_collisions> needs the attributes link1 and link2",
        ),
        ("", r"the file is empty"),
    ],
)
def test_bad_srdf(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "bad.srdf"
    file.write_text(text)
    with pytest.raises(ModelError, match=words):
        load_srdf_exclusions(file)


def test_friction_of_a_robot_scene(tmp_path: Path) -> None:
    """The law is the one that is given, the μ of every pair the file's."""
    file = tmp_path / "box.xml"
    file.write_text(
        "<mujoco><worldbody><geom type='plane' size='1 1 1' friction='.3'/>"
        "<body><freejoint/><geom type='box' size='.1 .1 .1' friction='.4'/></body></worldbody></mujoco>"
    )
    law = AnchoredFriction(1.0)
    (contact,) = (x for x in robot_scene(load_robot(file), friction=law).terms if isinstance(x, Contact))
    assert contact.friction is law
    assert contact.grip is not None
    assert contact.grip.tolist() == [0.4] * 8
