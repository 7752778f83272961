"""Draws planes as grids: one endless grid for all worlds where they share the plane, else a patch below each."""

from __future__ import annotations

import math

import numpy as np
import viser

from pbfd_torch.appearance import Plane
from pbfd_torch.viewer.film import Array, Film, quaternions

_CELLS = 4  # per body size, about
_PATCH = 6.0  # body sizes


class Ground:
    """The planes of a film, at `places` `[worlds, 3]` below the scene node `root`."""

    def __init__(self, scene: viser.SceneApi, root: str, film: Film) -> None:
        self._scene, self._root, self._film = scene, root, film
        self._grids: list[tuple[Plane, int, Array, viser.GridHandle]] = []

    def place(self, worlds: list[int], places: Array) -> None:
        """Draws the ground of these worlds from now on."""
        self.remove()
        step = places.max(0) - places.min(0)
        size = self._film.scale
        cell = 10 ** math.floor(math.log10(size / _CELLS)) if size > 0 else 0.1
        for plane in self._film.appearance.planes:
            shared = not np.abs(np.array(plane.normal) * step).sum() > 1e-6 * size
            for k, world in enumerate(worlds[:1] if shared else worlds):
                handle = self._scene.add_grid(
                    f"{self._root}/{plane.name}_{k}",
                    width=_PATCH * size,
                    height=_PATCH * size,
                    infinite_grid=shared,
                    fade_distance=40 * size,
                    cell_size=cell,
                    section_size=10 * cell,
                    cell_color=(214, 217, 221),
                    section_color=(168, 174, 183),
                    shadow_opacity=0.25,
                    plane_color=(240, 241, 243),
                    plane_opacity=1.0,
                )
                self._grids.append((plane, world, places[k], handle))

    def show(self, frame: int) -> None:
        """Moves the grids to where they are at a frame."""
        for plane, world, place, handle in self._grids:
            pose = self._film.poses(frame, [world])[0, self._film.body(plane.body)]
            normal = pose[:, :3] @ np.array(plane.normal, np.float32)
            point = pose[:, :3] @ (np.array(plane.normal, np.float32) * plane.offset) + pose[:, 3]
            handle.wxyz = quaternions(_turn_to(normal))
            handle.position = point + place

    def remove(self) -> None:
        """Takes everything out of the scene."""
        for *_, handle in self._grids:
            handle.remove()
        self._grids.clear()


def _turn_to(normal: Array) -> Array:
    """A rotation matrix that takes z to a unit vector, about an axis in the x–y plane."""
    x, y, z = (float(c) for c in normal)
    if z < -0.999:
        return np.diag((1.0, -1.0, -1.0)).astype(np.float32)
    k = 1 / (1 + z)
    return np.array([[1 - x * x * k, -x * y * k, x], [-x * y * k, 1 - y * y * k, y], [-x, -y, z]], np.float32)
