"""Damaged robot files: the package's own error, or a run that stays finite; never another exception, and never a long wait."""

from __future__ import annotations

import math
import signal
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

from pbfd_torch import Simulator
from pbfd_torch.errors import PbfdError
from pbfd_torch.loading import load_srdf_exclusions
from pbfd_torch.models import file_setup

ROOT = Path(__file__).parents[2]
PATIENCE = 30  # [s] after which an example counts as one that hangs; the deadline of the profiles is what it may take
EVALUATIONS = 200  # that a step may spend, so that one that cannot be solved is short

INERTIA = "<inertia ixx='.01' ixy='0' ixz='0' iyy='.02' iyz='0' izz='.02'/>"
SOLID = "<inertial><origin xyz='.01 0 0' rpy='.1 0 0'/><mass value='{}'/>" + INERTIA + "</inertial>"
ROVER = f"""<?xml version="1.0"?><robot name="rover"><material name="red"><color rgba="1 0 0 1"/></material>
<link name="chassis">{SOLID.format(4)}<visual><geometry><box size=".4 .25 .08"/></geometry><material name="red"/></visual>
 <collision name="body"><geometry><box size=".4 .25 .08"/></geometry></collision></link>
<link name="wheel">{SOLID.format(0.5)}<collision><origin xyz="0 0 0" rpy="1.57 0 0"/>
 <geometry><sphere radius=".08"/></geometry></collision></link>
<link name="arm">{SOLID.format(0.3)}<collision><geometry><capsule radius=".03" length=".1"/></geometry></collision></link>
<link name="caster"><collision><geometry><sphere radius=".03"/></geometry></collision></link>
<joint name="axle" type="continuous"><parent link="chassis"/><child link="wheel"/><origin xyz="-.1 .15 -.04"/><axis xyz="0 1 0"/>
 <dynamics damping=".1" friction=".05"/></joint>
<joint name="shoulder" type="revolute"><parent link="chassis"/><child link="arm"/><origin xyz="0 0 .1"/><axis xyz="0 1 0"/>
 <limit lower="-1" upper="1" effort="5" velocity="3"/><mimic joint="axle" multiplier="2" offset="0"/></joint>
<joint name="fixed" type="fixed"><parent link="chassis"/><child link="caster"/><origin xyz=".15 0 -.09"/></joint>
<transmission name="t"><joint name="axle"/></transmission></robot>"""
LIFT = f"""<robot name="lift"><link name="world"/><link name="table">{SOLID.format(1)}<collision><geometry>
<mesh filename="part.obj" scale="1 1 -1"/></geometry></collision></link>
<link name="tool">{SOLID.format(0.1)}<collision><geometry><cylinder radius=".08" length=".04"/></geometry></collision></link>
<joint name="z" type="prismatic"><parent link="world"/><child link="table"/><axis xyz="0 0 1"/><limit lower="0" upper=".5"/></joint>
<joint name="plane" type="planar"><parent link="table"/><child link="tool"/><axis xyz="0 0 1"/></joint></robot>"""
PEN = """<mujoco model="pen"><compiler angle="radian"/><option gravity="0 0 -9" timestep="0.01"/><size memory="1M"/>
<default><geom friction="0.8" solref="0.02 1"/><default class="soft"><geom margin="0.01"/></default></default>
<asset><hfield name="hill" nrow="3" ncol="4" size="3 3 .1 .1" elevation="0 1 0 1 0 0 1 0 0 1 0 1"/>
 <mesh name="m" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1" scale="1 1 1"/>
 <texture name="t" type="2d" builtin="flat" width="8" height="8"/></asset>
<worldbody><geom name="hill" type="hfield" hfield="hill" pos="0 0 -1"/><geom name="floor" type="plane" size="1 1 1"/>
<replicate count="2" offset="0 0.5 0"><geom type="box" size=".1 .1 .1" pos="1 0 0"/></replicate>
<body name="a" pos="0 0 .5"><joint name="s" type="slide" axis="1 0 0" range="-1 1" damping="1" stiffness="2"/>
 <geom class="soft" size=".1"/><site name="here"/>
 <body name="b" pos="0 0 .3" euler="0 .3 0"><joint name="h" axis="0 1 0" armature=".01" frictionloss=".1" ref=".1"/>
 <geom name="rod" type="capsule" fromto="0 0 0 0 0 .2" size=".03"/></body></body>
<body name="c" pos="0 .5 .2"><freejoint name="f"/><geom name="lump" type="mesh" mesh="m" density="500"/></body>
<body name="d" pos="0 -.5 .2"><joint name="ball" type="ball"/><inertial pos="0 0 .1" mass="1" diaginertia=".1 .1 .1"/>
 <geom type="sphere" size=".1" pos="0 0 .2"/></body></worldbody>
<contact><exclude body1="a" body2="b"/><pair geom1="rod" geom2="floor"/></contact>
<tendon><fixed name="ten"><joint joint="s" coef="1"/></fixed></tendon>
<equality><joint joint1="s" joint2="h" active="false"/></equality>
<actuator><motor name="m" joint="s" gear="2" ctrlrange="-1 1"/><position joint="h" kp="5" forcerange="-3 3"/></actuator>
<sensor><gyro site="here"/></sensor><keyframe><key name="k" qpos="0 .1 0 .5 .2 1 0 0 0 1 0 0 0"/></keyframe></mujoco>"""
SRDF = "<robot name='r'><disable_collisions link1='a' link2='b' reason='Never'/><group name='g'><link name='a'/></group></robot>"
URDFS = (ROVER, LIFT, (ROOT / "tests/data/arm_description/arm.urdf").read_text())
MJCFS = (PEN, *((ROOT / f"models/{name}.xml").read_text() for name in ("hopper", "cart_pole", "push_box", "reacher")))
PART = (ROOT / "tests/data/arm_description/meshes/tetrahedron.obj").read_bytes()

NUMBERS = [
    "nan",
    "inf",
    "-inf",
    "0",
    "-1",
    "-0.0",
    "1e300",
    "-1e300",
    "1e-300",
    "1e999",
    "1e20",
    "1e8",
    "1e-9",
    "99999999999",
    "0.5",
]
WORDS = [
    "",
    " ",
    "x",
    "nan 0 0",
    "1 2",
    "0 0 0",
    "0 0 0 0",
    "1 2 3 4 5 6 7 8 9",
    "world",
    "true",
    "a\nb",
    "é",
    "9" * 400,
    "1 " * 999,
]
TAGS = ["link", "joint", "body", "geom", "visual", "gazebo", "mesh", "freejoint", "inertial", "include", "default", "frame", "x-y"]
VALUES = st.sampled_from(NUMBERS + WORDS) | st.floats().map(str) | st.text(max_size=8)
CHANGES = st.tuples(
    st.sampled_from(["drop", "double", "rename", "move", "number", "value", "value", "take", "give"]),
    st.integers(0, 10**6),
    st.integers(0, 10**6),
    VALUES,
)


@pytest.fixture(scope="module", autouse=True)
def _first_imports(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What is imported when first used is no part of an example."""
    for suffix, text in ((".urdf", ROVER), (".xml", PEN)):
        run(text.encode(), suffix, tmp_path_factory.mktemp("first"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("robots")
    (place / "part.obj").write_bytes(PART)
    return place


@contextmanager
def patience() -> Iterator[None]:
    def stop(signal_number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"takes more than {PATIENCE} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(PATIENCE)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def run(text: bytes, suffix: str, folder: Path) -> None:
    """Loads a file and makes two steps."""
    file = folder / f"robot{suffix}"
    file.write_bytes(text)
    with warnings.catch_warnings(), patience():
        warnings.simplefilter("ignore")
        try:
            setup = file_setup(file)
            simulator = Simulator(setup.scene, setup.dt, evaluations=EVALUATIONS)
            state = simulator.initial_state(setup.q, setup.v)
            for _ in range(2):
                state, _ = simulator.step(state)
        except PbfdError:
            return
    assert bool(torch.isfinite(state.q).all())
    assert bool(torch.isfinite(state.v).all())


def changed(text: str, changes: Sequence[tuple[str, int, int, str]]) -> bytes:
    """The XML with elements and attributes dropped, doubled, renamed, moved and replaced."""
    root = etree.fromstring(text.encode(), etree.XMLParser(remove_comments=True))
    for change in changes:
        change_one(root, *change)
    return bytes(etree.tostring(root))


def change_one(root: Any, kind: str, where: int, which: int, value: str) -> None:
    nodes = list(root.iter())
    node, parent = nodes[where % len(nodes)], nodes[where % len(nodes)].getparent()
    keys = sorted(node.attrib)
    value = "".join(x for x in value if x in "\n" or x.isprintable())
    if kind == "number":
        places = [(x, key) for x in nodes for key, words in x.attrib.items() if numeric(words)]
        if places:
            node, key = places[where % len(places)]
            words = node.get(key).split()
            words[which % len(words)] = value if numeric(value) else NUMBERS[which % len(NUMBERS)]
            node.set(key, " ".join(words))
    elif kind == "value" and keys:
        node.set(keys[which % len(keys)], value)
    elif kind == "take" and keys:
        del node.attrib[keys[which % len(keys)]]
    elif kind == "give":
        names = sorted({key for x in nodes for key in x.attrib})
        node.set(names[which % len(names)], value)
    elif kind == "rename":
        node.tag = TAGS[which % len(TAGS)]
    elif kind == "drop" and parent is not None:
        parent.remove(node)
    elif kind == "double" and parent is not None:
        parent.append(etree.fromstring(etree.tostring(node)))
    elif kind == "move" and parent is not None:
        other = nodes[which % len(nodes)]
        if node not in (other, *other.iterancestors()):
            other.append(node)


def numeric(text: str) -> bool:
    try:
        return bool([float(x) for x in text.split()])
    except ValueError:
        return False


@given(st.sampled_from(URDFS), st.lists(CHANGES, min_size=1, max_size=4))
def test_damaged_urdf(folder: Path, text: str, changes: list[tuple[str, int, int, str]]) -> None:
    run(changed(text, changes), ".urdf", folder)


@given(st.sampled_from(MJCFS), st.lists(CHANGES, min_size=1, max_size=4))
def test_damaged_mjcf(folder: Path, text: str, changes: list[tuple[str, int, int, str]]) -> None:
    run(changed(text, changes), ".xml", folder)


BYTES = st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255))


@given(st.sampled_from(URDFS + MJCFS), st.lists(BYTES, max_size=5), st.floats(0, 1) | st.just(1.0))
def test_damaged_bytes(folder: Path, text: str, bytes_: list[tuple[float, int]], kept: float) -> None:
    """Some bytes replaced, and the end cut off."""
    damaged = bytearray(text.encode())
    for where, byte in bytes_:
        damaged[math.floor(where * len(damaged))] = byte
    run(bytes(damaged[: math.ceil(kept * len(damaged))]), ".urdf" if "<robot" in text else ".xml", folder)


@given(st.lists(BYTES, max_size=8))
def test_damaged_meshes(folder: Path, bytes_: list[tuple[float, int]]) -> None:
    damaged = bytearray(PART)
    for where, byte in bytes_:
        damaged[math.floor(where * len(damaged))] = byte
    (folder / "part.obj").write_bytes(damaged)
    try:
        run(LIFT.encode(), ".urdf", folder)
    finally:
        (folder / "part.obj").write_bytes(PART)


@given(st.lists(CHANGES, min_size=1, max_size=3), st.floats(0, 1) | st.just(1.0))
def test_damaged_srdf(folder: Path, changes: list[tuple[str, int, int, str]], kept: float) -> None:
    text = changed(SRDF, changes)
    file = folder / "robot.srdf"
    file.write_bytes(text[: math.ceil(kept * len(text))])
    try:
        pairs = load_srdf_exclusions(file)
    except PbfdError:
        return
    assert all(len(pair) == 2 for pair in pairs)
