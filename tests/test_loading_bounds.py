"""Robot files that are too large, damaged or hostile are refused within seconds, with file, element, value and range."""

from __future__ import annotations

import struct
import time
from pathlib import Path

import pytest
import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Sphere
from pbfd_torch.errors import InputError, ModelError, NotModelledWarning
from pbfd_torch.loading import bounds, load_robot, load_srdf_exclusions, report
from pbfd_torch.models import file_setup

pytestmark = pytest.mark.filterwarnings("ignore::pbfd_torch.errors.NotModelledWarning")
SOLID = '<inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
LINK = (
    f'<link name="a">{SOLID}<collision name="c"><origin xyz="0 0 0"/><geometry><sphere radius="0.1"/></geometry></collision></link>'
)
BODY = "<body name='b'><joint name='j'/><geom name='g' size='1'/></body>"


def refused(file: Path, text: str | bytes, words: str) -> None:
    """The file is refused with these words, its own name and in less than five seconds."""
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    start = time.process_time()
    with pytest.raises(ModelError, match=words) as error:
        load_robot(file)
    assert str(error.value).startswith(str(file))
    assert time.process_time() - start < 5


URDF = {
    "long cylinder": (
        '<sphere radius="0.1"/>',
        '<cylinder radius="1" length="1e20"/>',
        r"link 'a', collision 'c': Cylinder measures 5e\+19 m",
    ),
    "large sphere": ('radius="0.1"', 'radius="1e8"', r"Sphere measures 1e\+08 m .* from 1e-09 to 1000 m"),
    "small sphere": ('radius="0.1"', 'radius="1e-300"', r"Sphere measures 1e-300 m"),
    "far shape": ('xyz="0 0 0"', 'xyz="0 1e7 0"', r"position is 0, 1e\+07, 0 m: must be within 100000 m"),
    "infinite angle": ('xyz="0 0 0"', 'rpy="0 inf 0"', r":2: collision 'c': rpy of <origin> is '0 inf 0': must be finite numbers"),
    "overflow": ('xyz="0 0 0"', 'xyz="0 1e999 0"', r":2: collision 'c': xyz of <origin> is '0 1e999 0'"),
    "light": ('mass value="2"', 'mass value="1e-300"', r"link 'a': mass is 1e-300 kg: must be 0 or from 1e-15 to 1e\+13"),
    "heavy": ('mass value="2"', 'mass value="1e300"', r"link 'a': mass is 1e\+300 kg"),
    "massless": ('mass value="2"', 'mass value="0"', r"no link can move"),
    "large moment": ('ixx="1"', 'ixx="1e30"', r"link 'a': moment of inertia is 1e\+30 kg m²: must be at most 1e\+20"),
    "no number": ('radius="0.1"', 'radius=""', r":2: link 'a'"),
}


POINT = "<link name='world'/><link name='b'><inertial><origin xyz='0.1 0 0'/><mass value='1'/></inertial></link>"
URDF_MORE = {
    "point mass": (
        f"{POINT}<joint name='j' type='planar'><parent link='world'/><child link='b'/><axis xyz='0 0 1'/></joint>",
        r"joint 'j_turn' can move against those before it so that no mass moves: link 'b', or what it carries, needs inertia",
    ),
    "twice": (LINK.replace("</link>", f"{SOLID}</link>"), r":2: link 'a': <inertial> is there 2 times: must be there once"),
    "endless the wrong way": (
        LINK + LINK.replace('"a"', '"b"') + '<joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
        '<limit lower="inf" upper="inf"/></joint>',
        r"joint 'j': reference is 0 and limits are inf, inf",
    ),
}


@pytest.mark.parametrize("what", URDF_MORE)
def test_urdf_robots_that_cannot_move(tmp_path: Path, what: str) -> None:
    links, words = URDF_MORE[what]
    refused(tmp_path / "robot.urdf", f"<robot name='r'>\n{links}</robot>", words)


@pytest.mark.parametrize("what", URDF)
def test_numbers_of_a_urdf(tmp_path: Path, what: str) -> None:
    old, new, words = URDF[what]
    assert old in LINK
    refused(tmp_path / "robot.urdf", f"<robot name='r'>\n{LINK.replace(old, new)}</robot>", words)


TEXTS = {
    "no text": (b"<robot name='r'><link name='\xff\xfe'/></robot>", r":1: malformed XML: Invalid bytes"),
    "zeros": (b"<robot>\0\0</robot>", r":1: malformed XML"),
    "binary": (bytes(range(1, 256)) * 9, r":1: malformed XML"),
    "cut off": (b"<robot name='r'>\n<link name='a'", r":2: malformed XML"),
    "unknown encoding": (b"<?xml version='1.0' encoding='klingon'?><robot/>", r"malformed XML: Unsupported encoding"),
    "twice": (b"<robot name='r' name='s'/>", r"malformed XML: Attribute name redefined"),
    "deep": (b"<robot>" * 3000, r"malformed XML: Excessive depth"),
    "entities": (b"<!DOCTYPE r [<!ENTITY a 'x'><!ENTITY b '&a;&a;'>]><robot name='&b;'/>", r"declares the entities a, b"),
    "foreign file": (b"<!DOCTYPE r [<!ENTITY a SYSTEM 'file:///etc/passwd'>]><robot>&a;</robot>", r"declares the entities a"),
}
TEXTS["many laughs"] = (
    b"<!DOCTYPE r [<!ENTITY x0 'ha'>"
    + b"".join(b"<!ENTITY x%d '%s'>" % (k, b"&x%d;" % (k - 1) * 10) for k in range(1, 30))
    + b"]><robot name='&x29;'/>",
    r"malformed XML: .*(entity|amplification)",
)


@pytest.mark.parametrize("suffix", [".urdf", ".xml"])
@pytest.mark.parametrize("what", TEXTS)
def test_what_is_no_xml(tmp_path: Path, what: str, suffix: str) -> None:
    refused(tmp_path / f"robot{suffix}", *TEXTS[what])


def test_any_version_of_xml_is_read(tmp_path: Path) -> None:
    file = tmp_path / "robot.urdf"
    for head in ('<?xml version="0.0" ?>', "<?xml version='2.0'?>\n", '\ufeff<?xml version="0.0" encoding="utf-8"?>', ""):
        file.write_text(f"{head}<robot name='r'>{LINK}</robot>")
        assert load_robot(file).articulation.link_names == ("a",)


def chain(count: int) -> str:
    links = "".join(f'<link name="l{k}">{SOLID}</link>' for k in range(count))
    joint = '<joint name="j{}" type="continuous"><parent link="l{}"/><child link="l{}"/></joint>'
    return f"<robot name='r'>{links}{''.join(joint.format(k, k - 1, k) for k in range(1, count))}</robot>"


def balls(count: int) -> str:
    bodies = "".join(f"<body pos='{k} 0 0'><freejoint/><geom size='.1'/></body>" for k in range(count))
    return f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"


def mjcf(bodies: str = BODY, more: str = "") -> str:
    return f"<mujoco>\n<worldbody>{bodies}</worldbody>{more}</mujoco>"


FIELD = "<geom type='hfield' hfield='h'/>" + BODY
LARGE = {
    "chain": (chain(3000), r"has 3000 links: at most 1000 are possible; join those"),
    "balls": (balls(2000), r"has 2000 links: at most 1000"),
    "degrees of freedom": (balls(400), r"has 2400 degrees of freedom: at most 2000 are possible; fix joints"),
    "geoms": (mjcf("<geom size='1'/>" * 1500 + BODY), r"has 1500 shapes of the world: at most 1000"),
    "pairs": (
        mjcf(("<body><joint/>" + "<geom size='.1'/>" * 100 + "</body>") * 6),
        r"has 150000 pairs of shapes that may touch: at most 50000",
    ),
    "elements": (mjcf("<site/>" * 200_000 + BODY), r"has \d+ elements: at most 100000"),
    "planes": (mjcf("<geom type='plane' size='1 1 1'/>" * 101 + BODY), r"has 101 planes and height fields: at most 100"),
    "copied bodies": (mjcf(f"<replicate count='1999'>{BODY}</replicate>"), r"has 1999 links: at most 1000"),
    "gear": (
        mjcf(BODY, "<actuator><motor joint='j' gear='1e300'/></actuator>"),
        r"actuator 'actuator0': gear is 1e\+300: must be from",
    ),
    "stiff": (
        mjcf(BODY.replace("<joint", "<joint damping='1e300'")),
        r"joint 'j': damping is 1e\+300: must be ≥ 0 and at most 1e\+20",
    ),
    "actuator": (mjcf(BODY, "<actuator><position joint='j' kp='1e300' kv='1e300'/></actuator>"), r"actuator 'actuator0': "),
    "copies": (
        mjcf(f"<replicate count='1000'><replicate count='1000'>{BODY}</replicate></replicate>"),
        r"has 1000000 links",
    ),
    "copied sites": (
        mjcf(f"<replicate count='100'><replicate count='100'><site/></replicate></replicate>{BODY}"),
        r":2: replicate: has 10000 copies: at most 2000",
    ),
    "points": (
        mjcf(FIELD, "<asset><hfield name='h' nrow='100000' ncol='100000' size='1 1 1 1'/></asset>"),
        r":2: hfield 'h': has 10000000000 points",
    ),
    "pixels": (
        mjcf(BODY, "<asset><texture name='t' type='2d' builtin='flat' width='100000' height='100000'/></asset>"),
        r"texture 't': has 10000000000 pixels of a texture",
    ),
    "keys": (mjcf(BODY, "<size nkey='100000000'/>"), r"size: has 100000000 entries of nkey: at most 10000"),
    "large geom": (mjcf(BODY.replace("'1'", "'1e8' mass='1'")), r"geom 'g': Sphere measures 1e\+08 m"),
    "far geom": (mjcf("<geom name='w' type='box' size='1 1 1' pos='1e9 0 0'/>" + BODY), r"geom 'w': position is 1e\+09, 0, 0 m"),
    "infinite geom": (mjcf(BODY.replace("'1'", "'inf'")), r":2: geom 'g': size of <geom> is 'inf': must be finite"),
    "infinite option": (mjcf(BODY, "<option viscosity='inf'/>"), r"viscosity of <option> is 'inf'"),
    "NaN range": (mjcf(BODY.replace("<joint", "<joint range='0 nan'")), r"range of <joint> is '0 nan': must be numbers"),
    "heavy": (
        mjcf("<body name='b'><joint/><inertial pos='0 0 0' mass='1e14' diaginertia='1 1 1'/></body>"),
        r"link 'b': mass is 1e\+14 kg",
    ),
}


@pytest.mark.parametrize("what", LARGE)
def test_what_is_too_large(tmp_path: Path, what: str) -> None:
    text, words = LARGE[what]
    refused(tmp_path / "robot.xml", text, words)


def test_files_that_are_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounds, "FILE_BYTES", 2**20)
    refused(tmp_path / "robot.urdf", "<robot>" + " " * 2**21, r"has 2 MiB: at most 1 are read")


def test_endless_ranges_are_no_limits(tmp_path: Path) -> None:
    file = tmp_path / "robot.xml"
    file.write_text(mjcf(BODY.replace("<joint", "<joint range='-inf inf'")))
    assert load_robot(file).articulation.lower.tolist() == [-float("inf")]


# meshes -------------------------------------------------------------------------------------------------------------------


def stl(triangles: int) -> bytes:
    return b" " * 80 + struct.pack("<I", triangles) + b"\0" * (50 * triangles)


MESHES = {
    "many triangles": (
        "part.stl",
        stl(600_000),
        r"mesh '.*part\.stl': has 600000 triangles: at most 500000 are possible; simplify it",
    ),
    "empty": ("part.stl", b"", r"part\.stl' (cannot be read|holds no)"),
    "binary": ("part.obj", bytes(range(256)) * 9, r"part\.obj' (cannot be read|holds no)"),
    "one point": ("part.stl", stl(5), r"1 distinct vertices: a convex hull needs at least 4"),
    "no XML": ("part.dae", b"not XML", r"part\.dae' cannot be read"),
    "other kind": ("part.step", b"x", r"part\.step': extension must be one of \.stl, \.obj, \.ply, \.dae"),
    "not finite": (
        "part.obj",
        b"v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n",
        r"part\.obj': vertices must be finite, three numbers each",
    ),
    "plane": ("part.obj", b"v 0 0\nv 1 0\nv 0 1\nv 1 1\nf 1 2 3\nf 2 3 4\n", r"vertices must be finite, three numbers each"),
    "folder": ("part", None, r"mesh 'part' not found"),
    "no address": ("http://[x", None, r"mesh 'http://\[x' cannot be looked for"),
    "long": ("x" * 9000, None, r"mesh 'x{60}…' cannot be looked for: File name too long"),
    "missing": ("no.stl", None, r"mesh 'no\.stl' not found"),
}


@pytest.mark.parametrize("what", MESHES)
def test_meshes_that_cannot_be_used(tmp_path: Path, what: str) -> None:
    name, content, words = MESHES[what]
    (tmp_path / "part").mkdir()
    if content is not None:
        (tmp_path / name).write_bytes(content)
    link = LINK.replace('<sphere radius="0.1"/>', f'<mesh filename="{name}"/>')
    text = f"<robot name='r'>\n{link}</robot>"
    refused(tmp_path / "robot.urdf", text, rf"link 'a', collision 'c': {words}|{words}")


def test_a_mesh_with_many_triangles_in_an_mjcf(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "m.stl").write_bytes(stl(600_000))
    more = "<compiler meshdir='parts'/><asset><mesh name='m' file='m.stl'/></asset>"
    refused(tmp_path / "robot.xml", mjcf(BODY, more), r"mesh '.*m\.stl': has 600000 triangles")


def test_a_picture_of_too_many_points(tmp_path: Path) -> None:
    """A PNG file says how large it is before it is unpacked."""
    (tmp_path / "h.png").write_bytes(b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 50_000, 50_000))
    more = "<asset><hfield name='h' file='h.png' size='1 1 1 1'/></asset>"
    refused(tmp_path / "robot.xml", mjcf(FIELD, more), r"hfield 'h': has 2500000000 points of a height field")


def test_included_files_are_checked(tmp_path: Path) -> None:
    (tmp_path / "more.xml").write_text("<mujocoinclude>\n<option gravity='0 0 inf'/></mujocoinclude>")
    (tmp_path / "robot.xml").write_text(mjcf(BODY, "<include file='more.xml'/>"))
    with pytest.raises(ModelError, match=r"more\.xml:2: gravity of <option> is '0 0 inf'"):
        load_robot(tmp_path / "robot.xml")


def test_files_that_include_each_other(tmp_path: Path) -> None:
    (tmp_path / "more.xml").write_text("<mujocoinclude><include file='robot.xml'/></mujocoinclude>")
    refused(tmp_path / "robot.xml", mjcf(BODY, "<include file='more.xml'/>"), r"nclude")


# how long it takes --------------------------------------------------------------------------------------------------------


def test_work_that_takes_a_second_is_shown(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """On a terminal only, and nothing of what is done at once."""

    def shown(count: int) -> str:
        with report.announced("contacts", count, slow_from=100):
            pass
        assert list(report.progress(range(3), "shapes")) == [0, 1, 2]
        return capsys.readouterr().err

    assert shown(1000) == ""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    assert "contacts:   0%" in shown(1000)
    assert shown(99) == ""


# beside -------------------------------------------------------------------------------------------------------------------


def test_srdf_numbers_and_entities(tmp_path: Path) -> None:
    file = tmp_path / "robot.srdf"
    for text, words in {
        "<robot><group_state><joint name='j' value='inf'/></group_state></robot>": r":1: joint 'j': value of <joint> is 'inf'",
        "<!DOCTYPE r [<!ENTITY a 'x'>]><robot/>": "declares the entities a",
        "<robot>\xff": "malformed XML",
    }.items():
        file.write_bytes(text.encode("latin-1"))
        with pytest.raises(ModelError, match=words):
            load_srdf_exclusions(file)


@pytest.mark.skipif(torch.cuda.is_available(), reason="the device is there")
@pytest.mark.parametrize("device", ["cuda", "cuda:3", "nowhere"])
def test_a_device_that_is_not_there(tmp_path: Path, device: str) -> None:
    (tmp_path / "robot.xml").write_text(mjcf())
    with pytest.raises(InputError, match=rf"device is '{device}': must be one that is there, of cpu"):
        file_setup(tmp_path / "robot.xml", device=device)


def test_moments_below_zero_by_rounding_are_zero(tmp_path: Path) -> None:
    """Down to a millionth of the robot's largest moment; what is farther below is refused."""
    bent = '<inertial><mass value="0.001"/><inertia ixx="3e-8" ixy="5e-8" ixz="0" iyy="3e-8" iyz="0" izz="5e-8"/></inertial>'
    fixed = '<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>'
    file = tmp_path / "robot.urdf"
    text = f"<robot name='r'>{LINK}<link name='b'>{bent}</link>{fixed}</robot>"
    file.write_text(text)
    line = r"principal moments below zero by rounding, down to -2e-08 kg m², are set to zero \(1\): b"
    with pytest.warns(NotModelledWarning, match=line):
        robot = load_robot(file)
    second = robot.articulation.pseudo_inertia[1, :3, :3]
    inertia = second.trace() * torch.eye(3, dtype=torch.float64) - second
    torch.testing.assert_close(
        torch.linalg.eigvalsh(inertia), torch.tensor([0, 5e-8, 8e-8], dtype=torch.float64), rtol=0, atol=1e-20
    )
    refused(file, text.replace("e-8", "e-5"), r"link 'b': inertia is not positive semi-definite: smallest principal moment -2e-05")


def test_pairs_are_counted_as_they_may_touch() -> None:
    def shape(link: str, group: int = 1, mask: int = 1) -> Collider:
        return Collider(link, link, Sphere(1.0), group=group, mask=mask)

    every = [shape("a"), shape("a"), shape("b"), shape("c", 2, 4), shape("d", 4, 0)]
    # a–b twice, c–d once; c and d touch neither a nor b
    assert bounds.pair_count(every, ()) == 3
    assert bounds.pair_count(every, [HalfSpace(), HalfSpace(name="other", group=0, mask=2)]) == 3 + 3 + 1
