"""The XML behind an MJCF file, with what it includes: checked before MuJoCo compiles it, which has no bounds of its own."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pbfd_torch.loading.bounds import GRID_POINTS, SHAPES, require_count, require_file_size, require_link_count
from pbfd_torch.loading.meshes import require_triangles
from pbfd_torch.loading.report import first_bytes, naming
from pbfd_torch.loading.xml_file import read_xml, require_finite

ELEMENTS = 100_000
COPIES = 2 * SHAPES  # that <replicate>, <composite> and <flexcomp> make
PIXELS = 2**26  # of a texture, which MuJoCo reads too
RESERVED = 10_000  # entries of what <size> makes for users
_ENDLESS = ("range", "ctrlrange", "forcerange", "actuatorfrcrange", "actrange", "lengthrange")  # infinite: there is no limit
_WORDS = [
    "name",
    "class",
    "childclass",
    "dclass",
    "file",
    "model",
    "prefix",
    "plugin",
    "instance",
    "target",
    "joint",
    "joint1",
    "joint2",
    "jointinparent",
    "body",
    "body1",
    "body2",
    "geom",
    "geom1",
    "geom2",
    "site",
    "site1",
    "site2",
    "refsite",
    "cranksite",
    "slidersite",
    "tendon",
    "tendon1",
    "tendon2",
    "actuator",
    "mesh",
    "material",
    "hfield",
    "texture",
    "objname",
    "refname",
    "key",
    "value",
    "data",
]


@dataclass(frozen=True)
class Source:
    """One file of a model and its root element."""

    path: Path
    root: Any


def mjcf_sources(path: Path) -> list[Source]:
    """The file and all that it includes or attaches. What is missing is left to MuJoCo's own words."""
    found = {path.absolute(): Source(path, read_xml(path))}
    pending = list(found.values())
    while pending:
        source = pending.pop()
        for name in (x.get("file") for x in source.root.iter("include", "model")):
            file = path.absolute().parent / (name or "")
            if file.is_file() and file not in found:
                found[file] = Source(file, read_xml(file))
                pending.append(found[file])
    return list(found.values())


def require_compilable(sources: list[Source]) -> None:
    """Raises `ModelError` naming file, line and element for numbers that are not finite and for what would take more time or memory
    than there is."""
    count = sum(sum(1 for _ in source.root.iter()) for source in sources)
    with naming(str(sources[0].path)):
        require_count("elements", count, ELEMENTS, "make it smaller")
        require_link_count(sum(_copies(body) for source in sources for body in source.root.iter("body")))
    folders = _folders(sources)
    for source in sources:
        require_finite(source.root, source.path, _WORDS, _ENDLESS)
        for node in source.root.iter():
            with naming(f"{source.path}:{node.sourceline}", f"{node.tag} '{node.get('name')}'" if node.get("name") else node.tag):
                _require_bounded(node, folders)


def _require_bounded(node: Any, folders: dict[str, list[Path]]) -> None:
    match node.tag:
        case "replicate" | "composite" | "flexcomp":
            require_count("copies", _copies(node), COPIES, "ask for fewer")
        case "size":
            for key in set(node.attrib) - {"memory", "njmax", "nconmax", "nstack"}:  # MuJoCo itself bounds these by its memory
                require_count(f"entries of {key}", _whole(node, key), RESERVED, "leave it out")
        case "hfield":
            for file in _files(node, folders):
                require_file_size(file)
                require_count("points of a height field", _image_size(file), GRID_POINTS, "use fewer")
            points = _whole(node, "nrow") * _whole(node, "ncol")
            require_count("points of a height field", points, GRID_POINTS, "use fewer")
        case "texture":
            for file in _files(node, folders):
                require_file_size(file)
                require_count("pixels of a texture", _image_size(file), PIXELS, "use fewer")
            height = _whole(node, "height") if "height" in node.attrib else _whole(node, "width")
            require_count("pixels of a texture", _whole(node, "width") * height, PIXELS, "use fewer")
        case "mesh" | "skin" | "flexcomp" if "file" in node.attrib:
            for file in _files(node, folders):
                require_triangles(file)


def _copies(node: Any) -> int:
    """How often an element is there, made by itself and by those around it."""
    return math.prod(_whole(x, "count") for x in (node, *node.iterancestors()) if x.tag in ("replicate", "composite", "flexcomp"))


def _whole(node: Any, key: str) -> int:
    """The product of an attribute's whole numbers; 1 where it says nothing that can be used, which MuJoCo then says."""
    try:
        return math.prod(max(1, int(x)) for x in node.get(key, "").split())
    except ValueError:
        return 1


def _folders(sources: list[Source]) -> dict[str, list[Path]]:
    """Where files of each kind of element may be."""
    here = sources[0].path.absolute().parent
    compilers = [x for source in sources for x in source.root.iter("compiler")]

    def folders(*keys: str) -> list[Path]:
        return [here, *(here / x.get(key) for x in compilers for key in keys if x.get(key))]

    return {"mesh": folders("meshdir", "assetdir"), "texture": folders("texturedir", "assetdir")}


def _files(node: Any, folders: dict[str, list[Path]]) -> Iterator[Path]:
    places = folders["texture" if node.tag == "texture" else "mesh"]
    names = [value for key, value in node.attrib.items() if key.startswith("file")]
    yield from (file for name in names for folder in places if (file := folder / name).is_file())


def _image_size(file: Path) -> int:
    """Pixels of a PNG file by its header, points of one in MuJoCo's own format of height fields; 0 for others."""
    head = first_bytes(file, 24)
    if head[:8] == b"\x89PNG\r\n\x1a\n" and len(head) == 24:
        width, height = struct.unpack(">II", head[16:24])
        return int(width * height)
    return 0
