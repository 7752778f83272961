"""Where worlds stand beside each other, and where the camera looks from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbfd_torch.viewer.film import Array, Film

MOST = 64  # worlds beside each other
_GAP = 0.25  # of a world's size, between neighbours
_SIDE = np.array((0.45, -1.0, 0.0))  # planar robots move in x and z
_RISE = 0.34  # of the camera per metre of distance
_FILL = 0.85  # of the distance at which a ball around everything just fits


def offsets(film: Film, count: int) -> Array:
    """Places of `count` worlds `[count, 3]` on a grid in the x–y plane, about as long as wide, the first at the origin."""
    pitch = [float(film.reach[k]) + _GAP * film.size for k in (0, 1)]
    columns = min(count, max(1, math.ceil(math.sqrt(count * pitch[1] / pitch[0]))))  # along x
    index = np.arange(count)
    places: Array = np.stack((pitch[0] * (index % columns), -pitch[1] * (index // columns), 0 * index), -1).astype(np.float32)
    return places * np.array((1, -1, 1), np.float32)


@dataclass(frozen=True, eq=False)
class View:
    """A camera: where it is, what it looks at, what is up there; `[3]` each, and vertical opening angle [rad]."""

    position: NDArray[np.float64]
    target: NDArray[np.float64]
    up: NDArray[np.float64]
    angle: float = math.radians(40)


def view_of(film: Film, places: Array, follows: bool) -> View:
    """Everything in sight: the worlds at `places` at the start where the camera follows, else during the whole motion."""
    low, high = film.bounds(0) if follows else film.path_bounds
    low, high = low + places.min(0), high + places.max(0)
    up = np.array(film.appearance.up, np.float64)
    target = 0.5 * (low + high).astype(np.float64)
    side = _SIDE - (_SIDE @ up) * up
    if np.linalg.norm(side) < 0.1:  # up is where the camera would be
        side = np.array((1.0, 0.0, 0.0)) - up[0] * up
    direction = side / np.linalg.norm(side) + _RISE * up
    radius = 0.5 * float(np.linalg.norm(high - low))
    distance = max(radius, 0.75 * film.size) / math.sin(View.angle / 2) * _FILL
    return View(target + distance * direction / np.linalg.norm(direction), target, up)
