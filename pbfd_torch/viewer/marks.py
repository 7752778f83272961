"""Draws what helps to read a motion: link frames, joint axes, centres of mass and their trails."""

from __future__ import annotations

import numpy as np
import trimesh
import viser

from pbfd_torch.viewer.film import Array, Film, quaternions

_TRAIL = 300  # pieces of a trail at most
_CENTER, _AXIS = (200, 40, 140), (120, 60, 190)


class Marks:
    """Marks on some worlds of a film, below the scene node `root`; `frames`, `axes`, `centers` and `trails` say which."""

    def __init__(self, scene: viser.SceneApi, root: str, film: Film) -> None:
        self._scene, self._root, self._film = scene, root, film
        self.frames = self.axes = self.centers = self.trails = False
        self._handles: list[viser.SceneNodeHandle] = []

    def place(self, worlds: list[int], places: Array) -> None:
        """Marks these worlds from now on, with what is wanted now."""
        self.remove()
        self._worlds, self._places = worlds, places
        film, size, count = self._film, self._film.scale, len(worlds)
        links = film.links.shape[2]
        none = np.tile((1.0, 0.0, 0.0, 0.0), (count * links, 1)), np.zeros((count * links, 3))
        self._frames = self._axes = self._centers = None
        if self.frames:
            self._frames = self._scene.add_batched_axes(
                f"{self._root}/frames", *none, axes_length=0.12 * size, axes_radius=0.006 * size
            )
            self._handles.append(self._frames)
        if self.axes and film.appearance.joints:
            still = np.zeros((count * len(film.appearance.joints), 2, 3), np.float32)
            self._axes = self._scene.add_line_segments(f"{self._root}/axes", still, _AXIS, thickness=3.0, thickness_units="screen")
            self._handles.append(self._axes)
        if self.centers:
            ball = trimesh.creation.icosphere(subdivisions=2, radius=0.03 * size)
            self._centers = self._scene.add_batched_meshes_simple(
                f"{self._root}/centers", ball.vertices, ball.faces.astype(np.uint32), none[0][:count], none[1][:count],
                batched_colors=_CENTER,
            )  # fmt: skip
            self._handles.append(self._centers)
        if self.trails:
            self._add_trails()

    def _add_trails(self) -> None:
        """The path of every centre of mass from start to end."""
        film = self._film
        frames = np.unique(np.linspace(0, film.frames - 1, min(film.frames, _TRAIL + 1)).astype(int))
        path = np.nan_to_num(film.center[frames][:, self._worlds].cpu().numpy().astype(np.float32)) + self._places
        pieces = np.stack((path[:-1], path[1:]), -2).reshape(-1, 2, 3)
        if len(pieces):
            self._handles.append(
                self._scene.add_line_segments(f"{self._root}/trails", pieces, _CENTER, thickness=2.0, thickness_units="screen")
            )

    def show(self, frame: int, poses: Array) -> None:
        """Moves the marks to the poses `[worlds, nbody + 1, 3, 4]` of a frame."""
        film, links = self._film, self._film.links.shape[2]
        mine, places = poses[:, :links], self._places[:, None]
        if self._frames is not None:
            self._frames.batched_positions = (mine[..., 3] + places).reshape(-1, 3)
            self._frames.batched_wxyzs = quaternions(mine[..., :3]).reshape(-1, 4)
        if self._axes is not None:
            joints = film.appearance.joints
            carried = mine[:, [x.link for x in joints]]
            anchor = np.array([x.anchor for x in joints], np.float32)
            half = 0.1 * film.scale * np.array([x.axis or (0.0, 0.0, 0.0) for x in joints], np.float32)
            at = (carried[..., :3] @ anchor[..., None])[..., 0] + carried[..., 3] + places
            along = (carried[..., :3] @ half[..., None])[..., 0]
            self._axes.points = np.stack((at - along, at + along), -2).reshape(-1, 2, 3)
        if self._centers is not None:
            center = film.center[frame][self._worlds].cpu().numpy().astype(np.float32)
            self._centers.batched_positions = np.nan_to_num(center) + self._places

    def remove(self) -> None:
        """Takes everything out of the scene."""
        for handle in self._handles:
            handle.remove()
        self._handles.clear()
