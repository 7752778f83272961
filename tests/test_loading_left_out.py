"""What an MJCF file asks for and the simulation leaves out is listed by name."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

from pbfd_torch.errors import NotModelledWarning
from pbfd_torch.loading import load_robot
from tests.mjcf_texts import BODY, loaded, write

JOINTS = Path(__file__).parent / "data" / "joints.xml"


def test_left_out_features_are_listed_and_warned_about() -> None:
    with pytest.warns(NotModelledWarning) as caught:
        robot = load_robot(JOINTS)
    assert robot.not_modelled == (
        "actuators with activation dynamics (1), they do nothing: filtered",
        "actuators with transmission site (1), they do nothing: site_thrust",
        "friction of contact pairs: that of their geoms is used",
        "<site> (1)",
    )
    assert [str(w.message) for w in caught] == [f"{JOINTS}: not modelled: {line}" for line in robot.not_modelled]


@pytest.mark.parametrize(
    ("bodies", "more", "line"),
    [
        (BODY, "<option density='1'/>", "fluid forces (density, viscosity, wind)"),
        (BODY.replace("<body", "<body gravcomp='1'"), "", "gravity compensation (1): b"),
        (BODY + "<body name='m' mocap='true'/>", "", "mocap bodies stand still (1): m"),
        (BODY, "<equality><weld name='w' body1='b'/></equality>", "equality constraints, type weld (1): w"),
        (BODY, "<tendon><fixed name='t' stiffness='1'><joint joint='j' coef='1'/></fixed></tendon>", "tendons (1): t"),
        (
            BODY,
            "<tendon><fixed name='t'><joint joint='j' coef='1'/></fixed></tendon><actuator><motor name='a' tendon='t'/></actuator>",
            "actuators with transmission tendon (1), they do nothing: a",
        ),
        (
            BODY,
            "<actuator><general name='a' joint='j' biastype='affine' biasprm='0 1 0'/></actuator>",
            "actuators with a bias that pushes away (negative stiffness or damping) (1), they do nothing: a",
        ),
        (
            BODY,
            "<actuator><general name='a' joint='j' gaintype='affine'/></actuator>",
            "actuators with a gain that is not fixed (1), they do nothing: a",
        ),
        (
            BODY.replace("<joint", "<joint type='ball'"),
            "<actuator><motor name='a' joint='j'/></actuator>",
            "actuators with a ball or free joint (1), they do nothing: a",
        ),
        (
            BODY.replace("<joint", "<joint actuatorfrcrange='-1 1'"),
            "<actuator><motor joint='j'/><motor joint='j'/></actuator>",
            "actuatorfrcrange of joints with several actuators (1): j",
        ),
        (BODY.replace("<joint", "<joint type='ball' range='0 1'"), "", "limits of ball joints (1): j"),
        (BODY.replace("<joint", "<joint type='ball' frictionloss='1'"), "", "friction loss of ball and free joints (1): j"),
        (BODY.replace("<joint", "<joint stiffness='1 2'"), "", "springs that are not linear (1): j"),
        (BODY.replace("<joint", "<joint damping='1 2'"), "", "damping that is not linear (1): j"),
        (BODY.replace("<geom", "<geom condim='4'"), "", "torsional and rolling friction (condim 4, 6) (1): g"),
        (BODY, "<option><flag filterparent='disable'/></option>", "contact between a body and its parent (filterparent is off)"),
        (
            BODY.replace("<geom", "<geom name='hill' type='hfield' hfield='h'/><geom"),
            "<asset><hfield name='h' nrow='2' ncol='2' size='1 1 1 1'/></asset>",
            "geoms that cannot collide: hill (hfield)",
        ),
        (
            BODY + "<geom name='wall' type='box' size='1 1 1'/>",
            "<contact><pair geom1='wall' geom2='g'/></contact>",
            "friction of contact pairs: that of their geoms is used",
        ),
    ],
)
def test_left_out(tmp_path: Path, bodies: str, more: str, line: str) -> None:
    assert loaded(tmp_path, bodies, more).not_modelled == (line,)


def test_pairs_that_other_rules_bar_are_listed(tmp_path: Path) -> None:
    """MuJoCo lets an explicit pair touch even between a body and its parent, or where it is excluded."""
    bodies = BODY.replace("</body>", "<body name='c'><joint/><geom name='h' size='1'/></body></body>")
    bodies += "<body name='d'><joint/><geom name='i' size='1'/></body>"
    pairs = "<pair name='p' geom1='g' geom2='h'/><pair name='q' geom1='h' geom2='i'/><pair name='r' geom1='g' geom2='i'/>"
    found = loaded(tmp_path, bodies, f"<contact>{pairs}<exclude body1='c' body2='d'/></contact>").not_modelled
    assert found == (
        "friction of contact pairs: that of their geoms is used",
        "contact pairs of bodies that are joined or excluded (2): p, q",
    )


def test_what_has_no_effect_is_not_listed(tmp_path: Path) -> None:
    """Walls and links that cannot touch, excluded pairs, idle tendons, constraints that are off, cameras, lights, looks."""
    bodies = (
        "<geom name='wall' size='1' contype='2' conaffinity='2' rgba='1 0 0 1'/><light/>"
        "<body name='b'><joint name='j'/><geom size='1'/><camera/>"
        "<body name='c'><joint/><geom size='1'/></body></body>"
        "<body name='d'><joint/><geom size='1'/></body>"
    )
    more = (
        "<tendon><fixed name='t'><joint joint='j' coef='1'/></fixed></tendon>"
        "<equality><weld body1='b' active='false'/></equality>"
        "<contact><exclude body1='b' body2='d'/><exclude body1='c' body2='d'/></contact>"
        "<visual><map znear='0.1'/></visual><statistic extent='2'/><size nuserdata='3'/><custom><text name='x' data='y'/></custom>"
        "<asset><texture name='t' type='2d' builtin='flat' width='2' height='2'/><material name='m' texture='t'/></asset>"
        "<default><site size='0.1'/><motor gear='2'/></default>"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_robot(write(tmp_path, bodies, more)).not_modelled == ()


UNREAD = {
    "sensors": ("", "<sensor><gyro site='s'/><gyro site='s'/><jointpos joint='j'/></sensor>", "<sensor>: gyro (2), jointpos (1)"),
    "method": (
        "",
        "<option integrator='RK4' cone='elliptic'><flag island='disable'/></option>",
        "attributes of <flag>: island (1)",
    ),
    "option": ("", "<option integrator='RK4' cone='elliptic'/>", "attributes of <option>: cone (1), integrator (1)"),
    "geoms": ("<geom size='1' margin='0.1' gap='0.1'/><geom size='1' solref='0.01 1' margin='0'/>", "", "margin (2), solref (1)"),
    "fluid": ("<geom size='1' fluidshape='ellipsoid'/>", "", "attributes of <geom>: fluidshape (1)"),
    "joints": ("<body><joint solreflimit='0.01 1' margin='1'/><geom size='1'/></body>", "", "<joint>: margin (1), solreflimit (1)"),
    "defaults": ("", "<default><geom solimp='0.8 0.9 0.01'/></default>", "attributes of <geom>: solimp (1)"),
    "pairs": (
        "<geom name='w' size='1'/>",
        "<contact><pair geom1='w' geom2='g' gap='0' solref='1 1'/></contact>",
        "gap (1), solref (1)",
    ),
    "keys": ("", "<keyframe><key time='1'/></keyframe>", "attributes of <key>: time (1)"),
    "frames": ("<frame><geom size='1' solmix='2'/></frame>", "", "attributes of <geom>: solmix (1)"),
}


@pytest.mark.parametrize("what", UNREAD)
def test_what_is_not_read_is_listed(tmp_path: Path, what: str) -> None:
    """Whatever is in the file, by name and how often."""
    bodies, more, words = UNREAD[what]
    body = BODY.replace("<geom", "<site name='s'/><geom")
    lines = loaded(tmp_path, body + bodies, more).not_modelled
    assert "<site> (1)" in lines
    assert any(words in line for line in lines), lines


def test_what_an_included_file_says_is_listed(tmp_path: Path) -> None:
    (tmp_path / "sensors.xml").write_text("<mujocoinclude><sensor><jointpos joint='j'/></sensor></mujocoinclude>")
    assert loaded(tmp_path, BODY, "<include file='sensors.xml'/>").not_modelled == ("<sensor>: jointpos (1)",)
