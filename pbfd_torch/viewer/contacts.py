"""Draws contacts: points, normal and friction forces as arrows, stick or slip by colour, penetration as red arrows."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from pbfd_torch.viewer.film import Array, Film, Touches

STICKS, SLIDES = (35, 160, 75), (235, 105, 20)
NORMAL, DEPTH = (40, 70, 160), (205, 25, 40)
_LENGTH = 0.5  # of the film's scale: an arrow of a strong but usual force, at scale 1
_LONGEST = 1.0  # of the film's scale, at scale 1: arrows of impacts are cut off there


class Contacts:
    """The contacts of some worlds of a film, below the scene node `root`. `scale` and `depth_scale` stretch the arrows;
    `points`, `forces` and `depths` say what is drawn."""

    def __init__(self, scene: viser.SceneApi, root: str, film: Film) -> None:
        self._film = film
        self.scale, self.depth_scale = 1.0, 20.0
        self.points = self.forces = self.depths = False
        size = film.scale
        none = np.zeros((1, 2, 3), np.float32)

        def arrows(name: str, color: tuple[int, int, int], width: float) -> viser.ArrowsHandle:
            return scene.add_arrows(
                f"{root}/{name}",
                none,
                color,
                shaft_radius=0.008 * width * size,
                head_radius=0.02 * width * size,
                head_length=0.05 * width * size,
                visible=False,
            )

        self._normal = arrows("normal_force", NORMAL, 1.0)
        self._grips = {slides: arrows(f"friction_{slides}", SLIDES if slides else STICKS, 1.2) for slides in (False, True)}
        self._depth = arrows("penetration", DEPTH, 0.8)
        self._points = scene.add_point_cloud(
            f"{root}/points", np.zeros((1, 3), np.float32), STICKS, point_size=0.035 * size, point_shape="circle", visible=False
        )

    def show(self, frame: int, worlds: list[int], places: Array) -> None:
        """Draws the contacts of a frame."""
        if not (self.points or self.forces or self.depths):
            for handle in (self._normal, *self._grips.values(), self._depth, self._points):
                handle.visible = False
            return
        at = self._film.touches(frame, worlds)
        start = at.point + places[at.world]
        push, grip = self._stretched(at.push), self._stretched(at.grip)
        _arrows(self._normal, self.forces, start, push)
        for slides, handle in self._grips.items():
            mine = at.slides == slides
            _arrows(handle, self.forces, start[mine], grip[mine])
        inside = at.depth > 0
        _arrows(self._depth, self.depths, start[inside], self.depth_scale * (at.depth[:, None] * at.normal)[inside])
        self._show_points(at, start)

    def _stretched(self, force: Array) -> Array:
        """Forces as arrows [m]."""
        arrows = self.scale * _LENGTH * self._film.scale / self._film.strongest * force
        longest = self.scale * _LONGEST * self._film.scale
        size = np.linalg.norm(arrows, axis=-1, keepdims=True)
        cut: Array = arrows * np.minimum(1, longest / np.maximum(size, 1e-12)).astype(np.float32)
        return cut

    def _show_points(self, at: Touches, start: Array) -> None:
        self._points.visible = self.points and len(start) > 0
        if self._points.visible:
            colors: NDArray[np.uint8] = np.where(at.slides[:, None], SLIDES, STICKS).astype(np.uint8)
            self._points.points = start
            self._points.colors = colors


def _arrows(handle: viser.ArrowsHandle, wanted: bool, start: Array, vector: Array) -> None:
    handle.visible = wanted and len(start) > 0
    if handle.visible:
        handle.points = np.stack((start, start + vector), 1)
