"""Draws planes as grids on plates: one endless grid for all worlds where they share the plane, else a patch below each."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import viser

from pbfd_torch.looks.appearance import Plane
from pbfd_torch.viewer.film import Array, Film, quaternions

_CELLS = 4  # per body size, about
_PATCH, _PLATE = 6.0, 80.0  # sides of a patch and of an endless plane's plate, in the film's scale
_BELOW = 2e-3  # of the scale: how far a plate lies below its lines
_WHITE = (250, 252, 255)


@dataclass(frozen=True, eq=False)
class _Drawn:
    plane: Plane
    world: int
    place: Array
    lines: viser.GridHandle
    plate: viser.MeshHandle
    endless: bool


class Ground:
    """The planes of a film, at `places` `[worlds, 3]` below the scene node `root`."""

    def __init__(self, scene: viser.SceneApi, root: str, film: Film) -> None:
        self._scene, self._root, self._film = scene, root, film
        self._drawn: list[_Drawn] = []

    def place(self, worlds: list[int], places: Array) -> None:
        """Draws the ground of these worlds from now on."""
        self.remove()
        step = places.max(0) - places.min(0)
        size = self._film.scale
        cell = 10 ** math.floor(math.log10(size / _CELLS)) if size > 0 else 0.1
        for plane in self._film.appearance.planes:
            shared = not np.abs(np.array(plane.normal) * step).sum() > 1e-6 * size
            for k, world in enumerate(worlds[:1] if shared else worlds):
                lines = self._scene.add_grid(
                    f"{self._root}/{plane.name}_{k}",
                    width=_PATCH * size,
                    height=_PATCH * size,
                    infinite_grid=shared,
                    fade_distance=40 * size,
                    cell_size=cell,
                    section_size=10 * cell,
                    cell_color=(196, 200, 205),
                    section_color=(150, 157, 168),
                    shadow_opacity=0.0,
                    plane_opacity=0.0,
                )
                corners = 0.5 * (_PLATE if shared else _PATCH) * size * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
                plate = self._scene.add_mesh_simple(
                    f"{self._root}/{plane.name}_plate_{k}",
                    corners,
                    np.array([(0, 1, 2), (0, 2, 3)]),
                    color=_WHITE,
                    cast_shadow=False,
                )
                self._drawn.append(_Drawn(plane, world, places[k], lines, plate, shared))

    def show(self, frame: int, moved: Array) -> None:
        """Moves the planes to where they are at a frame; what has no end stays below a camera that has `moved` `[3]`."""
        for x in self._drawn:
            pose = self._film.poses(frame, [x.world])[0, self._film.body(x.plane.body)]
            normal = pose[:, :3] @ np.array(x.plane.normal, np.float32)
            point = pose[:, :3] @ (np.array(x.plane.normal, np.float32) * x.plane.offset) + pose[:, 3] + x.place
            x.lines.wxyz = x.plate.wxyz = quaternions(_turn_to(normal))
            x.lines.position = point
            along = (moved - (moved @ normal) * normal) if x.endless else 0.0
            x.plate.position = point - _BELOW * self._film.scale * normal + along

    def remove(self) -> None:
        """Takes everything out of the scene."""
        for x in self._drawn:
            x.lines.remove()
            x.plate.remove()
        self._drawn.clear()


def _turn_to(normal: Array) -> Array:
    """A rotation matrix that takes z to a unit vector, about an axis in the x–y plane."""
    x, y, z = (float(c) for c in normal)
    if z < -0.999:
        return np.diag((1.0, -1.0, -1.0)).astype(np.float32)
    k = 1 / (1 + z)
    return np.array([[1 - x * x * k, -x * y * k, x], [-x * y * k, 1 - y * y * k, y], [-x, -y, z]], np.float32)
