"""Draws what links and obstacles look like: every distinct surface once, with one instance for each body and world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from pbfd_torch.looks.appearance import Color, Visual
from pbfd_torch.viewer.film import Array, Film, quaternions


@dataclass(frozen=True)
class Paint:
    """How a film's bodies are coloured: one `color` for all links instead of their own, and an `opacity` from 0 to 1."""

    color: Color | None = None
    opacity: float | None = None


OWN = Paint()
GHOST = Paint((0.85, 0.2, 0.55), 0.35)


@dataclass(frozen=True, eq=False)
class _Surface:
    handle: viser.BatchedMeshHandle
    bodies: NDArray[np.int64]


class Bodies:
    """The bodies of some worlds of a film, drawn at `places` `[worlds, 3]` below the scene node `root`."""

    def __init__(self, scene: viser.SceneApi, root: str, film: Film, paint: Paint = OWN, obstacles: bool = True) -> None:
        self._film, self._scene, self._root, self._paint = film, scene, root, paint
        self._surfaces: list[_Surface] = []
        self._links = film.links.shape[2]
        seen = [x for x in film.appearance.visuals if len(x.faces) and (obstacles or 0 <= x.body < self._links)]
        self._alike: dict[tuple[bytes, bytes], list[Visual]] = {}
        for visual in seen:
            self._alike.setdefault((visual.vertices.tobytes(), visual.faces.tobytes()), []).append(visual)

    def place(self, worlds: list[int], places: Array) -> None:
        """Draws these worlds from now on."""
        self.remove()
        self._worlds, self._places = worlds, places
        count = len(worlds)
        for k, visuals in enumerate(self._alike.values()):
            bodies = np.array([self._film.body(x.body) for x in visuals])
            colors = np.tile([self._color(x) for x in visuals], (count, 1)).astype(np.uint8)
            handle = self._scene.add_batched_meshes_simple(
                f"{self._root}/surface{k}",
                visuals[0].vertices,
                visuals[0].faces.astype(np.uint32),
                batched_wxyzs=np.tile((1.0, 0.0, 0.0, 0.0), (count * len(bodies), 1)),
                batched_positions=np.zeros((count * len(bodies), 3)),
                batched_colors=colors,
                opacity=self._paint.opacity,
                flat_shading=_edged(visuals[0]),
                lod="off",
                cast_shadow=self._paint.opacity is None,
            )
            self._surfaces.append(_Surface(handle, bodies))

    def _color(self, visual: Visual) -> tuple[int, ...]:
        own = self._paint.color if self._paint.color is not None and 0 <= visual.body < self._links else visual.color
        return tuple(round(255 * x) for x in own)

    def show(self, poses: Array) -> None:
        """Moves all instances to the poses `[worlds, nbody + 1, 3, 4]` of a frame."""
        turns = quaternions(poses[..., :3])
        for surface in self._surfaces:
            where = poses[:, surface.bodies][..., 3] + self._places[:, None]
            surface.handle.batched_positions = where.reshape(-1, 3)
            surface.handle.batched_wxyzs = turns[:, surface.bodies].reshape(-1, 4)

    def remove(self) -> None:
        """Takes everything out of the scene."""
        for surface in self._surfaces:
            surface.handle.remove()
        self._surfaces.clear()


def _edged(visual: Visual) -> bool:
    """Whether its corners are sharp, so that it is shaded face by face: a box rather than a sphere."""
    return len(visual.faces) <= 200
