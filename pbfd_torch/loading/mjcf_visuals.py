"""What the bodies of an MJCF file look like: its geoms in MuJoCo's visible groups, read only when a picture is made."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pbfd_torch.loading.mjcf_colliders import primitive
from pbfd_torch.loading.mjcf_model import CompiledModel, compile_mjcf
from pbfd_torch.looks.appearance import WORLD, Color, Visual
from pbfd_torch.looks.painting import STONE, link_color, visual_of

_VISIBLE = 3  # groups 0, 1 and 2 are shown by default
_UNPAINTED = (0.5, 0.5, 0.5, 1.0)  # what a geom has whose file says nothing


@functools.lru_cache(maxsize=4)
def mjcf_visuals(path: Path) -> tuple[Visual, ...]:
    """Of all bodies. What stands still and can collide is drawn as an obstacle instead, and planes are never drawn here."""
    return tuple(_visuals(compile_mjcf(path)))


def _visuals(model: CompiledModel) -> Iterator[Visual]:
    m = model.data
    for g in range(m.ngeom):
        body = int(m.geom_bodyid[g])
        collides = bool(m.geom_contype[g] or m.geom_conaffinity[g])
        rgba = m.mat_rgba[m.geom_matid[g]] if m.geom_matid[g] >= 0 else m.geom_rgba[g]
        if m.geom_group[g] >= _VISIBLE or rgba[3] == 0 or (model.standing[body] and collides):
            continue
        shape = _shape(model, g)
        if shape is None:
            continue
        link = body - 1 if body else WORLD
        painted = m.geom_matid[g] >= 0 or not np.allclose(rgba, _UNPAINTED)
        plain = STONE if link == WORLD else link_color(link)
        color: Color = (float(rgba[0]), float(rgba[1]), float(rgba[2])) if painted else plain
        yield visual_of(model.geom(g), link, shape, m.geom_pos[g].tolist(), m.geom_quat[g].tolist(), color)


def _shape(model: CompiledModel, g: int) -> Any:
    import trimesh

    m = model.data
    if model.geom_type(g) != "mesh":
        return primitive(model.geom_type(g), *m.geom_size[g].tolist())
    mesh = int(m.geom_dataid[g])
    vertices = m.mesh_vert[m.mesh_vertadr[mesh] :][: m.mesh_vertnum[mesh]]
    return trimesh.Trimesh(vertices, m.mesh_face[m.mesh_faceadr[mesh] :][: m.mesh_facenum[mesh]], process=False)
