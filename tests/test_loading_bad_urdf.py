"""URDF files that cannot be used: the words name the file, the line and the element."""

from __future__ import annotations

from pathlib import Path

import pytest

from pbfd_torch.errors import ModelError
from pbfd_torch.loading import load_robot, load_urdf

SOLID = '<inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'


def link(name: str, content: str = SOLID) -> str:
    return f'<link name="{name}">{content}</link>\n'


def joint(name: str, parent: str, child: str, kind: str = "continuous", content: str = "") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{content}</joint>\n'


def write(folder: Path, *parts: str) -> Path:
    file = folder / "robot.urdf"
    file.write_text("<robot name='r'>\n" + "".join(parts) + "</robot>")
    return file


MASS = '<inertial><mass value="{mass}"/><inertia ixx="{ixx}" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
PAIR = link("a") + link("b")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (link("a") + link("b", MASS.format(mass=-1, ixx=1)) + joint("j", "a", "b"), r"link 'b': mass is -1\.0 kg: must be ≥ 0"),
        (
            link("a") + link("b", MASS.format(mass=1, ixx=-2)) + joint("j", "a", "b"),
            r"link 'b': inertia is not positive semi-definite",
        ),
        (link("a") + link("b", MASS.format(mass="nan", ixx=1)) + joint("j", "a", "b"), r":3: link 'b': value of <mass> is 'nan'"),
        (link("a") + link("b", MASS.format(mass="inf", ixx=1)) + joint("j", "a", "b"), r"link 'b': .* must be finite"),
        (link("a") + link("b", MASS.format(mass="heavy", ixx=1)) + joint("j", "a", "b"), r":3: link 'b': .*'heavy'"),
        (
            link("a") + link("b", "") + joint("j", "a", "b"),
            r"link 'b' and everything it carries have no mass: joint 'j' has no inertia",
        ),
        (
            link("a") + link("b", '<inertial><mass value="1"/></inertial>') + joint("j", "a", "b"),
            r"link 'b' .* all their mass on the axis .* joint 'j' has no inertia",
        ),
        (PAIR + joint("j", "a", "b", "spin"), r":4: joint 'j': type is 'spin': must be one of revolute, continuous"),
        (PAIR + joint("j", "x", "b"), r":4: joint 'j': parent link 'x' does not exist"),
        (PAIR + joint("j", "a", "x"), r":4: joint 'j': child link 'x' does not exist"),
        (PAIR + '<joint name="j" type="fixed"><child link="b"/></joint>', r":4: joint 'j': .* parent"),
        (PAIR + joint("j", "a", "b", content="<axis/>"), r":4: joint 'j': <axis> needs the attribute xyz"),
        (PAIR + joint("j", "a", "b", content='<axis xyz="0 0 0"/>'), r"joint 'j': axis is .* must not be zero"),
        (
            PAIR + joint("j", "a", "b", "revolute", '<limit lower="1" upper="-1"/>'),
            r"joint 'j': lower limit 1\.0 is above upper limit -1",
        ),
        (PAIR + joint("j", "a", "b", "revolute", '<limit lower="nan" upper="1"/>'), r":4: joint 'j': lower of <limit> is 'nan'"),
        (PAIR + joint("j", "a", "b", content='<dynamics damping="-1"/>'), r"joint 'j': damping is -1\.0: must be ≥ 0"),
        (PAIR + joint("j", "a", "b") + joint("k", "b", "a"), r"parents of links a, b form a closed loop"),
        (link("a") + joint("j", "a", "a"), r"parents of links a form a closed loop"),
        (PAIR + link("c") + joint("j", "a", "c") + joint("k", "b", "c"), r":6: joint 'k': its child 'c' is also that of joint 'j'"),
        (PAIR, r"has 2 root links, a, b"),
        (link("a") + link("a"), r":3: link 'a': the name is used twice"),
        (PAIR + link("c") + joint("j", "a", "b") + joint("j", "a", "c"), r":6: joint 'j': the name is used twice"),
        ("<link/>", r":2: link 'None': needs a name"),
        ("", r"holds no <link>"),
        (link("world"), r"no link can move"),
        (PAIR[:-1] + "<xacro:macro xmlns:xacro='x'/>", r":3: holds xacro macros"),
        (link("a", "<collision><geometry><cone/></geometry></collision>"), r":2: link 'a': .*cone"),
        (
            link("a", SOLID + "<collision name='c'><geometry><sphere radius='0'/></geometry></collision>"),
            r":2: link 'a', collision 'c': sphere radius is 0\.0: must be > 0",
        ),
    ],
)
def test_bad_content(tmp_path: Path, content: str, words: str) -> None:
    file = write(tmp_path, content)
    with pytest.raises(ModelError, match=words) as error:
        load_urdf(file)
    assert str(error.value).startswith(str(file))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r"robot\.urdf: the file is empty"),
        ("<robot>\n<link name='a'>\n</robot>", r"robot\.urdf:3: malformed XML"),
        ("not XML", r"robot\.urdf:1: malformed XML"),
        ("<mujoco/>", r"robot\.urdf:1: root element is <mujoco>: must be <robot>"),
    ],
)
def test_bad_file(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    with pytest.raises(ModelError, match=words):
        load_robot(file)


def test_bad_paths(tmp_path: Path) -> None:
    (tmp_path / "robot.obj").write_text("x")
    (tmp_path / "robot.urdf.xacro").write_text("x")
    for name, words in {
        "none.urdf": "no such file",
        "": "is a directory",
        "robot.obj": "must be .urdf, .xml or .mjcf",
        "robot.urdf.xacro": "expand it with the xacro command",
    }.items():
        with pytest.raises(ModelError, match=words) as error:
            load_robot(tmp_path / name)
        assert str(tmp_path / name) in str(error.value)


def test_urdf_in_an_xml_file(tmp_path: Path) -> None:
    file = tmp_path / "robot.xml"
    file.write_text(f"<robot name='r'>{link('a')}</robot>")
    assert load_robot(file).articulation.joint_names == ("a_free",)
