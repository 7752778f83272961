"""Shapes and meshes as coloured surfaces of bodies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from pbfd_torch.looks.appearance import Color, Visual
from pbfd_torch.looks.tessellation import tessellated
from pbfd_torch.tree.rotations import quaternion_matrix

_TONES: tuple[Color, ...] = ((0.10, 0.33, 0.60), (0.93, 0.52, 0.12))  # of links in turn, so that neighbours differ
STONE: Color = (0.62, 0.62, 0.6)


def link_color(link: int) -> Color:
    """The colour of a link that has none of its own."""
    return _TONES[link % len(_TONES)]


def visual_of(name: str, body: int, shape: Any, position: Sequence[float], quaternion: Sequence[float], color: Color) -> Visual:
    """A shape of `contact.shapes` at a place in its body's frame."""
    return surface_of(name, body, tessellated(shape), position, quaternion, color)


def surface_of(
    name: str,
    body: int,
    mesh: Any,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    color: Color = STONE,
) -> Visual:
    """A triangle mesh at a place in its body's frame, `quaternion` (w, x, y, z) of any norm."""
    turn = quaternion_matrix(torch.nn.functional.normalize(torch.tensor(quaternion, dtype=torch.float64), dim=0)).numpy()
    vertices = np.asarray(mesh.vertices, np.float64) @ turn.T + np.asarray(position, np.float64)
    return Visual(name, body, vertices.astype(np.float32), np.asarray(mesh.faces, np.int32), color)
