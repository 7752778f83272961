"""Reads a URDF file into parsed links and joints, with what it holds beside them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pbfd_torch.errors import ModelError
from pbfd_torch.loading.bounds import require_link_count
from pbfd_torch.loading.report import naming
from pbfd_torch.loading.xml_file import read_xml, require_finite, require_root

JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
_WORDS = ("name", "type", "link", "joint", "filename")  # attributes that hold no numbers
_ENDLESS = ("lower", "upper", "effort", "velocity")  # infinite: there is no limit
_ONCE = ("inertial", "parent", "child", "origin", "axis", "limit", "dynamics", "mimic")
_NEEDED = {"axis": "xyz", "mass": "value", "parent": "link", "child": "link", "mesh": "filename"}


@dataclass(frozen=True)
class Parsed:
    """A link or joint as pytorch-kinematics' parser gives it (64-bit numbers), and where it stands in the file, «path:line»."""

    data: Any
    place: str
    collision_names: tuple[str, ...] = ()


@dataclass
class UrdfFile:
    """`left_out`: what the file holds beside links and joints and how often, as lines for the reader."""

    path: Path
    name: str
    links: dict[str, Parsed] = field(default_factory=dict)
    joints: dict[str, Parsed] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


def read_urdf(path: Path) -> UrdfFile:
    """Raises `ModelError` naming file, line and element for what is malformed, misses an attribute or has a name twice."""
    from pytorch_kinematics.urdf_parser_py import urdf

    root = root_of(path)
    with naming(str(path)):
        require_link_count(len(root.findall("link")))
    file = UrdfFile(path, root.get("name", path.stem))
    others: Counter[str] = Counter()
    with complaints() as heard:
        for node in root:
            if node.tag in ("link", "joint"):
                found, kind = (file.links, urdf.Link) if node.tag == "link" else (file.joints, urdf.Joint)
                name = node.get("name")
                with naming(f"{path}:{node.sourceline}", f"{node.tag} '{name}'"):
                    if not name:
                        raise ModelError("needs a name")
                    if name in found:
                        raise ModelError("the name is used twice")
                    found[name] = _parse(node, kind, path)
            elif node.tag != "material":
                others[node.tag] += 1
    file.left_out += [f"<{tag}> ({count})" for tag, count in sorted(others.items())]
    file.left_out += [f"{what} ({count})" for what, count in sorted(Counter(heard).items())]
    return file


def root_of(path: Path) -> Any:
    """The <robot> element; raises `ModelError` for what is none, and for numbers that are not finite."""
    root = read_xml(path)
    require_root(root, "robot", path)
    for node in root.iter("{*}*"):
        if node.prefix == "xacro":
            raise ModelError("holds xacro macros: expand it with the xacro command first", file=f"{path}:{node.sourceline}")
    for part in ("link", "joint", "material"):
        for node in root.findall(part):
            require_finite(node, path, _WORDS, _ENDLESS)
    return root


def _parse(node: Any, kind: Any, path: Path) -> Parsed:
    from pytorch_kinematics.urdf_parser_py import xml_reflection

    for child in list(node.iter(*_NEEDED)):
        if child.get(_NEEDED[child.tag]) is None:
            raise ModelError(f"<{child.tag}> needs the attribute {_NEEDED[child.tag]}")
    if node.tag == "joint" and node.get("type") not in JOINT_TYPES:
        raise ModelError(f"type is '{node.get('type')}': must be one of {', '.join(JOINT_TYPES)}")
    for tag in _ONCE:
        if len(node.findall(tag)) > 1:
            raise ModelError(f"<{tag}> is there {len(node.findall(tag))} times: must be there once")
    for child in node.findall("visual"):
        node.remove(child)
    for child in node.findall("collision/material"):
        child.getparent().remove(child)
    for limit in node.findall("limit"):  # what is missing is no limit; but one of lower and upper alone makes the other 0
        ranged = "lower" in limit.attrib or "upper" in limit.attrib
        for what, missing in {"effort": "inf", "velocity": "inf", "lower": "-inf", "upper": "inf"}.items():
            limit.set(what, limit.get(what, "0" if ranged and what in ("lower", "upper") else missing))
    names = tuple(child.attrib.pop("name", "") for child in node.findall("collision"))
    try:
        data = kind.from_xml(node, xml_reflection.core.Path(node.tag))
    except xml_reflection.core.ParseError as error:
        raise ModelError(f"{error.e} (at {error.path})") from None
    except Exception as error:  # the parser raises plain ones too
        raise ModelError(str(error)) from error
    return Parsed(data, f"{path}:{node.sourceline}", names)


@contextmanager
def complaints() -> Iterator[list[str]]:
    """Collects what the parser would print on stderr about tags and attributes it does not know."""
    from pytorch_kinematics.urdf_parser_py.xml_reflection import core

    found: list[str] = []

    def keep(message: str) -> None:
        unknown = re.match(r'Unknown (tag|attribute) "(.+?)" in .*?(\w+)(?:\[[^/]*\])?$', message)
        found.append(f"{unknown[1]} {unknown[2]} of <{unknown[3]}>" if unknown else message)

    printing, core.on_error = core.on_error, keep
    try:
        yield found
    finally:
        core.on_error = printing
