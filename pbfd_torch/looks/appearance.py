"""What a scene looks like: surfaces that bodies carry, planes and joints, as plain arrays that a record can hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbfd_torch.errors import InputError

Color = tuple[float, float, float]
WORLD = -1


@dataclass(frozen=True, eq=False)
class Visual:
    """A coloured surface in the frame of the body that carries it.

    Attributes:
        name: for lists.
        body: index of the link; from the number of links on: of an obstacle; `WORLD`: none.
        vertices: `[n, 3]` float32 [m].
        faces: `[m, 3]` int32, counterclockwise seen from outside.
        color: red, green, blue from 0 to 1.
    """

    name: str
    body: int
    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    color: Color


@dataclass(frozen=True)
class Plane:
    """A plane normal · p = offset [m] in the frame of a `body` (as in `Visual`)."""

    name: str
    body: int
    normal: tuple[float, float, float]
    offset: float


@dataclass(frozen=True)
class JointMark:
    """A joint in the frame of the link that it carries. `axis`: unit vector, None for ball and free joints. Its coordinates are the
    `size` entries of q from `first` on."""

    name: str
    link: int
    first: int
    size: int
    anchor: tuple[float, float, float]
    axis: tuple[float, float, float] | None


@dataclass(frozen=True, eq=False)
class Appearance:
    """All that is drawn of a scene, and `up`, the unit vector against gravity (+z without any)."""

    visuals: tuple[Visual, ...]
    planes: tuple[Plane, ...]
    joints: tuple[JointMark, ...]
    up: tuple[float, float, float]


def packed(seen: Appearance) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """An appearance as a part of a JSON text, and arrays: the vertices and faces of all visuals one after the other."""
    words = {
        "visuals": [
            {"name": x.name, "body": x.body, "color": list(x.color), "vertices": len(x.vertices), "faces": len(x.faces)}
            for x in seen.visuals
        ],
        "planes": [dataclasses.asdict(x) for x in seen.planes],
        "joints": [dataclasses.asdict(x) for x in seen.joints],
        "up": list(seen.up),
    }
    none = np.zeros((0, 3))
    vertices = np.concatenate([none.astype(np.float32), *(x.vertices for x in seen.visuals)])
    faces = np.concatenate([none.astype(np.int32), *(x.faces for x in seen.visuals)])
    return words, {"visual_vertices": vertices, "visual_faces": faces}


def unpacked(words: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], links: int, bodies: int) -> Appearance:
    """What `packed` made, for so many links, and bodies in all. Raises `InputError` where the parts do not fit each other; other
    exceptions where they are of the wrong kind."""
    vertices, faces = arrays["visual_vertices"], arrays["visual_faces"]
    if vertices.dtype != np.float32 or faces.dtype != np.int32 or vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise InputError("visual_vertices and visual_faces must be float32 and int32 with three columns")
    visuals, first, begun = [], 0, 0
    for entry in words["visuals"]:
        last, ended = first + int(entry["vertices"]), begun + int(entry["faces"])
        mine, corners = vertices[first:last], faces[begun:ended]
        name, body, color = str(entry["name"]), int(entry["body"]), _three(entry["color"])
        if len(mine) != last - first or len(corners) != ended - begun or not np.isfinite(mine).all():
            raise InputError(f"visual '{name}' lacks vertices or faces, or has some that are not finite")
        if len(corners) and not (corners.min() >= 0 and corners.max() < len(mine)):
            raise InputError(f"visual '{name}' has faces with other vertices than its own")
        visuals.append(Visual(name, _within(body, bodies), mine, corners, color))
        first, begun = last, ended
    planes = [
        Plane(str(x["name"]), _within(int(x["body"]), bodies), _three(x["normal"]), float(x["offset"])) for x in words["planes"]
    ]
    joints = [
        JointMark(
            str(x["name"]),
            _within(int(x["link"]), links),
            int(x["first"]),
            int(x["size"]),
            _three(x["anchor"]),
            None if x["axis"] is None else _three(x["axis"]),
        )
        for x in words["joints"]
    ]
    return Appearance(tuple(visuals), tuple(planes), tuple(joints), _three(words["up"]))


def _three(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    if not np.isfinite((x, y, z)).all():
        raise InputError(f"{values} must be three finite numbers")
    return x, y, z


def _within(index: int, count: int) -> int:
    if not WORLD <= index < count:
        raise InputError(f"body {index} does not exist: there are {count}")
    return index
