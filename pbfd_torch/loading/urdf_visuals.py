"""What the links of a URDF file look like: its <visual> elements, read only when a picture is made."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbfd_torch.errors import ModelError
from pbfd_torch.loading.meshes import find_mesh, read_mesh
from pbfd_torch.loading.urdf_colliders import primitive
from pbfd_torch.loading.urdf_file import complaints, root_of
from pbfd_torch.loading.urdf_placement import Placed
from pbfd_torch.looks.appearance import Color, Visual
from pbfd_torch.looks.painting import link_color, visual_of


@functools.lru_cache(maxsize=4)
def urdf_visuals(path: Path, links: Sequence[str]) -> tuple[Visual, ...]:
    """Of the links of these names, in this order. A visual that cannot be read is left out with a warning."""
    from pytorch_kinematics.urdf_parser_py import urdf, xml_reflection

    root = root_of(path)
    named = {x.get("name"): x for x in root.findall("material")}
    found = []
    with complaints():
        for link in root.findall("link"):
            if link.get("name") not in links:
                continue
            k = links.index(link.get("name"))
            for number, node in enumerate(link.findall("visual")):
                name = node.attrib.pop("name", f"{links[k]}_{number}")
                try:
                    color = _color(node.find("material"), named) or link_color(k)
                    for material in node.findall("material"):
                        node.remove(material)
                    visual = urdf.Visual.from_xml(node, xml_reflection.core.Path("visual"))
                    found.append(_visual(visual, name, k, color, path))
                except Exception as error:  # a picture must not stop a simulation; the parser and trimesh raise whatever they like
                    warnings.warn(f"{path}: visual '{name}' is not drawn: {error}", stacklevel=2)
    return tuple(found)


def _visual(visual: Any, name: str, link: int, color: Color, path: Path) -> Visual:
    import trimesh

    place = Placed.from_origin(visual.origin)
    shape: Any = primitive(visual.geometry)
    if shape is None:
        mesh = read_mesh(find_mesh(visual.geometry.filename, path))
        scale = np.array(visual.geometry.scale or (1.0, 1.0, 1.0))
        faces = mesh.faces[:, :: 1 if scale.prod() > 0 else -1]  # a mirrored mesh would be inside out
        shape = trimesh.Trimesh(mesh.vertices * scale, faces, process=False)
    return visual_of(name, link, shape, place.position, place.quaternion, color)


def _color(material: Any, named: dict[str, Any]) -> Color | None:
    """Of a <material>, which may refer to one of the robot's; None where it says nothing."""
    if material is None:
        return None
    node = material.find("color")
    if node is None:
        node = named[material.get("name")].find("color") if material.get("name") in named else None
    if node is None:
        return None
    try:
        r, g, b, *_ = (min(1.0, max(0.0, float(x))) for x in node.get("rgba", "").split())
    except ValueError:
        raise ModelError(f"rgba is '{node.get('rgba')}': must be four numbers") from None
    return r, g, b
