"""A rollout as the viewer sees it: one axis of worlds, frames as small arrays, and how large everything is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.looks.appearance import WORLD, Appearance
from pbfd_torch.records.rollout import Rollout

Array = NDArray[np.float32]
SLIDING = 1e-3  # [m/s] of slip from which on a contact counts as sliding
_SAMPLES = 200  # frames that the size of a motion is taken from


@dataclass(frozen=True, eq=False)
class Touches:
    """The contacts of some worlds at one frame that carry a force: `point`, `normal`, `push` (normal part of the force on the
    body), `grip` (tangential part) `[n, 3]`, `depth` `[n]` > 0 inside, `slides` `[n]` bool, and the index `world` `[n]`."""

    point: Array
    normal: Array
    push: Array
    grip: Array
    depth: Array
    slides: NDArray[np.bool_]
    world: NDArray[np.int64]


class Film:
    """A rollout with its batch as one axis. Nothing is copied: frames are cut out when they are asked for. `home`: the centre of
    mass where the motion began `[worlds, 3]`."""

    def __init__(self, rollout: Rollout) -> None:
        self.rollout = rollout
        self.home = self.center[0]

    def renew(self, rollout: Rollout) -> None:
        """Goes on with another record of the same scene; what is known of sizes, and where it began, stays."""
        self.rollout = rollout
        for name in ("links", "center", "_obstacles"):
            self.__dict__.pop(name, None)

    def _flat(self, value: Tensor, inner: int) -> Tensor:
        """`[time, *batch, …] → [time, worlds, …]` with `inner` dimensions after the batch."""
        shape = value.shape[value.ndim - inner :] if inner else ()
        return value.reshape(len(value), self.worlds, *shape)

    @property
    def appearance(self) -> Appearance:
        return self.rollout.appearance

    @property
    def frames(self) -> int:
        return self.rollout.steps + 1

    @cached_property
    def worlds(self) -> int:
        return math.prod(self.rollout.q.shape[1:-1])

    @property
    def dt(self) -> float:
        """[s] from frame to frame."""
        return self.rollout.dt

    @cached_property
    def links(self) -> Tensor:
        """`[frames, worlds, nlink, 3, 4]`."""
        return self._flat(self.rollout.link_poses, 3)

    @cached_property
    def _obstacles(self) -> Tensor:
        return self._flat(self.rollout.obstacle_poses, 3)

    @cached_property
    def center(self) -> Tensor:
        """Centre of mass `[frames, worlds, 3]`."""
        return self._flat(self.rollout.center_of_mass, 1)

    def poses(self, frame: int, worlds: Sequence[int]) -> Array:
        """Of all bodies, links first, `[len(worlds), nbody + 1, 3, 4]`; the last one is the world itself. Poses that are not finite
        shrink to nothing at the origin."""
        index = torch.as_tensor(worlds, dtype=torch.long)
        still = min(frame, len(self._obstacles) - 1)
        parts = [self.links[frame][index], self._obstacles[still][index]]
        parts.append(parts[0].new_tensor(np.eye(3, 4)).expand(len(index), 1, 3, 4))
        poses: Array = np.nan_to_num(torch.cat([x.cpu() for x in parts], 1).numpy().astype(np.float32))
        return poses

    @property
    def bodies(self) -> int:
        """Links and obstacles."""
        return self.links.shape[2] + self._obstacles.shape[2]

    def body(self, index: int) -> int:
        """Where in `poses` a body of the appearance is."""
        return self.bodies if index == WORLD else index

    def touches(self, frame: int, worlds: Sequence[int]) -> Touches:
        """The contacts at a frame; there are none before the first step."""
        r = self.rollout
        if frame == 0 or r.contact_depth.shape[-1] == 0:
            none = np.zeros((0, 3), np.float32)
            empty = np.zeros(0, np.int64)
            return Touches(none, none, none, none, none[:, 0], empty.astype(bool), empty)
        index = torch.as_tensor(worlds, dtype=torch.long)

        def cut(value: Tensor) -> Array:
            at = value[frame - 1].reshape(self.worlds, *value.shape[value.ndim - (1 if value is r.contact_depth else 2) :])
            array: Array = at[index].cpu().numpy().astype(np.float32)
            return array

        point, normal, force, slip = (cut(x) for x in (r.contact_point, r.contact_normal, r.contact_force, r.contact_slip))
        depth = cut(r.contact_depth)
        carries = (np.abs(force).max(-1) > 0) & np.isfinite(force).all(-1) & np.isfinite(point).all(-1)
        world = np.broadcast_to(np.arange(len(index))[:, None], carries.shape)[carries]
        normal, force, slip = normal[carries], force[carries], slip[carries]
        push = (normal * force).sum(-1, keepdims=True) * normal
        slides = np.linalg.norm(slip, axis=-1) > SLIDING * self.dt
        return Touches(point[carries], normal, push, force - push, depth[carries], slides, world)

    @cached_property
    def size(self) -> float:
        """Extent of one world's bodies at the start [m]: of what is drawn of links, at least 1 cm."""
        low, high = self.bounds(0)
        return float(max(np.max(high - low), 1e-2))

    @cached_property
    def scale(self) -> float:
        """Length [m] that marks and arrows are measured by: the size, or five links where bodies lie far apart."""
        extents = [float(np.ptp(corners, 0).max()) for _, corners in self._boxes]
        return min(self.size, 5 * float(np.median(extents))) if extents else self.size

    @cached_property
    def _boxes(self) -> list[tuple[int, Array]]:
        """The corners of each link's visuals, in its frame."""
        corners = []
        for visual in self.appearance.visuals:
            if 0 <= visual.body < self.links.shape[2] and len(visual.vertices):
                low, high = visual.vertices.min(0), visual.vertices.max(0)
                corners.append((visual.body, np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(8, 3)))
        return corners

    def bounds(self, frame: int, world: int = 0) -> tuple[Array, Array]:
        """Lowest and highest coordinates of what is drawn of a world's links, `[3]` each."""
        poses = self.poses(frame, [world])[0]
        points = [poses[: self.links.shape[2], :, 3]]
        points += [corners @ poses[body, :, :3].T + poses[body, :, 3] for body, corners in self._boxes]
        every = np.concatenate(points)
        return every.min(0), every.max(0)

    @cached_property
    def path_bounds(self) -> tuple[Array, Array]:
        """`bounds` over the whole motion of all worlds, from some of its frames and worlds."""
        return self._over_time(np.zeros(3))

    @cached_property
    def reach(self) -> Array:
        """How much room a world takes along each axis `[3]` [m]: where it travels, what its bodies take around their centre."""
        low, high = self._over_time(np.ones(3)) if self.travels else self.path_bounds
        return high - low

    def _over_time(self, held: NDArray[np.float64]) -> tuple[Array, Array]:
        """Lowest and highest coordinates over time; `held`: 1 where the centre of mass is held in its place."""
        center = np.nan_to_num(self.center.cpu().numpy())
        frames = np.unique(np.linspace(0, self.frames - 1, min(self.frames, _SAMPLES)).astype(int))
        worlds = np.unique(np.linspace(0, self.worlds - 1, min(self.worlds, 4)).astype(int))
        lows, highs = [], []
        for w in worlds:
            for f in frames[:: len(worlds)]:
                low, high = self.bounds(int(f), int(w))
                shift = held * (center[f, w] - center[0, w])
                lows.append(low - shift)
                highs.append(high - shift)
        return np.min(lows, 0).astype(np.float32), np.max(highs, 0).astype(np.float32)

    @cached_property
    def travels(self) -> bool:
        """Whether the motion leads so far away that a camera has to follow."""
        low, high = self.path_bounds
        return bool(np.max(high - low) > 4 * self.size)

    @cached_property
    def strongest(self) -> float:
        """A large but usual contact force [N], for the scale of arrows; 1 without contact."""
        force = torch.linalg.vector_norm(self.rollout.contact_force[:: max(1, self.rollout.steps // _SAMPLES)].double(), dim=-1)
        force = force[torch.isfinite(force) & (force > 0)]
        return float(force[:: max(1, len(force) // 10**6)].quantile(0.9)) if len(force) else 1.0


def quaternions(rotations: Array) -> Array:
    """Unit quaternions (w, x, y, z) of rotation matrices `[*, 3, 3]`, by the largest of the four (Shepperd); (1, 0, 0, 0) for what
    is no rotation."""
    m = rotations
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = np.stack((1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz), -1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    p, q, r = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    rows = np.stack(
        (
            np.stack((squares[..., 0], a, b, c), -1),
            np.stack((a, squares[..., 1], p, q), -1),
            np.stack((b, p, squares[..., 2], r), -1),
            np.stack((c, q, r, squares[..., 3]), -1),
        ),
        -2,
    )
    best = np.take_along_axis(rows, squares.argmax(-1)[..., None, None], -2)[..., 0, :]
    length = np.linalg.norm(best, axis=-1, keepdims=True)
    fine = np.isfinite(length) & (length > 0)
    unit: Array = np.where(fine, best / np.where(fine, length, 1), np.array((1, 0, 0, 0), np.float32)).astype(np.float32)
    return unit
