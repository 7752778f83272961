"""A closed triangle mesh as an obstacle: its exact signed distance at the nodes of a grid, computed once and kept on disk."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import sys
import tempfile
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from pbfd_torch.contact.distance_grid import DistanceGrid
from pbfd_torch.contact.shapes import Points
from pbfd_torch.errors import InputError

Faces = NDArray[np.int64]

_FORMAT = 1  # of the cache files, and of the numbers in them
_MOST_NODES = 2**26
_CHUNK = 2**14


@dataclass(frozen=True)
class Nodes:
    """A regular grid: nodes at origin + cell · (i, j, k) [m], `shape` of them."""

    origin: tuple[float, float, float]
    cell: float
    shape: tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Mesh:
    """The solid inside a closed mesh: `vertices` `[n, 3]` [m], `faces` `[m, 3]`, counterclockwise seen from outside.

    cell [m]: spacing of the distance grid, the longest side/64 if None. What is thinner than about two cells is lost, and edges are
    rounded over about a cell. margin [m]: how far the grid reaches beyond the mesh, at least 2 cells; 4 cells if None. It must
    exceed the radius of the largest sphere or capsule that touches the mesh.

    Raises `InputError` for a mesh that is empty, not finite, not closed, not consistently wound, flat or inside out."""

    vertices: Points
    faces: Faces
    cell: float | None = None
    margin: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", np.array(self.vertices, np.float64))
        object.__setattr__(self, "faces", np.array(self.faces, np.int64))
        _require_closed(self.vertices, self.faces)
        _ = self._nodes  # refuses what cannot be used

    @classmethod
    def from_file(
        cls,
        file: str | Path,
        scale: float | tuple[float, float, float] = 1.0,
        cell: float | None = None,
        margin: float | None = None,
    ) -> Self:
        """The mesh of a file (STL, OBJ, PLY, COLLADA and what else trimesh reads), its parts together. scale: metres per unit of
        the file (a unit that the file itself names is not applied), along x, y, z if three; a negative one mirrors."""
        import trimesh

        try:
            mesh: Any = trimesh.load_mesh(file, skip_materials=True)
            mesh.merge_vertices(merge_tex=True, merge_norm=True)
            vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        except Exception as error:  # trimesh raises whatever its readers raise
            raise InputError(f"mesh '{file}' cannot be read: {error}") from error
        if not np.isfinite(scale).all() or not np.all(scale):
            raise InputError(f"scale of mesh '{file}' is {scale}: must be finite and not zero")
        factors = np.broadcast_to(np.asarray(scale, np.float64), 3)
        try:
            return cls(vertices * factors, faces[:, :: 1 if factors.prod() > 0 else -1], cell, margin)
        except InputError as error:
            raise InputError(f"mesh '{file}': {error}") from error

    def surface(self, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> DistanceGrid:
        """Its signed distance on tensors: exact at the nodes, a tricubic spline between them. The first call for a mesh computes
        the nodes (some seconds, with a progress bar on a terminal) and keeps them in the folder $PBFD_TORCH_CACHE, else
        $XDG_CACHE_HOME/pbfd_torch, else ~/.cache/pbfd_torch, where it can be written."""
        return DistanceGrid.through(self._distances, self._nodes.origin, self._nodes.cell, dtype, device)

    def reaching(self, distance: float) -> Self:
        """The same mesh with a grid that reaches `distance` [m] beyond it and two cells more, or itself where it does already: for
        spheres of that radius."""
        margin = distance + 2 * self._cell
        return self if self._margin >= margin else dataclasses.replace(self, margin=margin)

    @property
    def _margin(self) -> float:
        return 4 * self._cell if self.margin is None else self.margin

    @cached_property
    def _cell(self) -> float:
        corners = self.vertices[self.faces]
        return float((corners.max((0, 1)) - corners.min((0, 1))).max()) / 64 if self.cell is None else self.cell

    @cached_property
    def _nodes(self) -> Nodes:
        corners = self.vertices[self.faces]
        low, high = corners.min((0, 1)), corners.max((0, 1))
        cell = self._cell
        if not (math.isfinite(cell) and cell > 0):
            raise InputError(f"cell of a mesh is {cell} m: must be > 0 and finite")
        margin = self._margin
        if not (math.isfinite(margin) and margin >= 2 * cell):
            raise InputError(f"margin of a mesh is {margin} m: must be finite and at least 2 cells, {2 * cell:.4g} m")
        count = np.ceil((high - low + 2 * margin) / cell - 1e-9) + 1
        if count.prod() > _MOST_NODES:
            raise InputError(f"cell of a mesh is {cell} m: gives {count.prod():.2g} nodes, at most {_MOST_NODES:.2g} are allowed")
        x, y, z = (0.5 * (low + high) - 0.5 * cell * (count - 1)).tolist()
        nx, ny, nz = count.astype(np.int64).tolist()
        return Nodes((x, y, z), cell, (nx, ny, nz))

    @cached_property
    def _distances(self) -> NDArray[np.float64]:
        key = hashlib.sha256(repr((_FORMAT, self._nodes, len(self.vertices), len(self.faces))).encode())
        key.update(self.vertices.tobytes())
        key.update(self.faces.tobytes())
        name = f"mesh-{key.hexdigest()}.npz"
        found = _read(name, self._nodes.shape)
        if found is None:
            found = signed_distances(self.vertices, self.faces, self._nodes)
            _write(name, found)
        return found


def _require_closed(vertices: Points, faces: Faces) -> None:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(f"mesh has vertices {vertices.shape} and faces {faces.shape}: must be [n, 3] and [m, 3]")
    if not len(vertices) or not len(faces):
        raise InputError(f"mesh is empty: it has {len(vertices)} vertices and {len(faces)} faces")
    if not np.isfinite(vertices).all():
        raise InputError("vertices of a mesh must be finite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"faces of a mesh name vertices {faces.min()} to {faces.max()}: must be 0 to {len(vertices) - 1}")
    start, end = faces.ravel(), np.roll(faces, -1, 1).ravel()
    real = start != end
    edges = np.minimum(start, end)[real] * len(vertices) + np.maximum(start, end)[real]
    _, edge, uses = np.unique(edges, return_inverse=True, return_counts=True)
    excess = np.bincount(edge, np.where((start < end)[real], 1, -1))
    if (uses % 2).any():
        raise InputError(f"mesh is not closed: {(uses % 2).sum()} of {len(uses)} edges are open")
    if excess.any():
        raise InputError(f"mesh is wound inconsistently: at {(excess != 0).sum()} of {len(uses)} edges the faces do not match")
    corners = vertices[faces] - vertices[faces].mean((0, 1))
    volume = float(np.linalg.det(corners).sum()) / 6
    if abs(volume) <= 1e-12 * np.linalg.norm(np.ptp(corners, axis=(0, 1))) ** 3:
        raise InputError("mesh is flat: it encloses no volume")
    if volume < 0:
        raise InputError(f"mesh is inside out: its volume is {volume:.4g} m³, must be > 0; reverse the vertex order of its faces")


def signed_distances(vertices: Points, faces: Faces, nodes: Nodes) -> NDArray[np.float64]:
    """Signed distances [m], of the nodes' shape, to a closed mesh inside the grid, < 0 where the mesh winds about the node: exact
    within 4 cells of the surface, and beyond at most a cell too large."""
    distances = np.empty(math.prod(nodes.shape))
    distance = _Distance(vertices[faces], nodes.cell)
    with tqdm(total=len(distances), unit="node", desc="mesh distance", disable=not sys.stderr.isatty(), leave=False) as bar:
        for start in range(0, len(distances), _CHUNK):
            chunk = np.arange(start, min(start + _CHUNK, len(distances)))
            place = np.stack(np.unravel_index(chunk, nodes.shape), -1)
            distances[chunk] = distance(np.array(nodes.origin) + nodes.cell * place)
            bar.update(len(chunk))
    inside = _inside((vertices - np.array(nodes.origin)) / nodes.cell, faces, nodes.shape)
    return np.where(inside, -1.0, 1.0) * distances.reshape(nodes.shape)


class _Distance:
    """Distance to triangles `[m, 3, 3]`, found through pieces of them of about a cell."""

    def __init__(self, corners: Points, cell: float) -> None:
        from scipy.spatial import cKDTree  # takes .3 s, and few scenes need it

        self.cell = cell
        edges = np.roll(corners, -1, 1) - corners
        normal = np.cross(edges[:, 0], edges[:, 1])
        area = np.linalg.norm(normal, axis=-1, keepdims=True)
        self.corners, self.edges = corners, edges
        self.normal = normal / np.where(area > 0, area, 1)
        self.inward = np.cross(self.normal[:, None], edges)
        square = (edges * edges).sum(-1)
        self.per_square = 1 / np.where(square > 0, square, 1)
        middles, self.triangle, self.radius = _pieces(corners, 1.4 * cell)
        self.tree = cKDTree(middles)

    def __call__(self, points: Points) -> NDArray[np.float64]:
        """Distances `[n]` at points `[n, 3]`, as in `signed_distances`."""
        reach, near = self.tree.query(points, min(8, self.tree.n))
        near, reach = near.reshape(len(points), -1), reach.reshape(len(points), -1)
        best = self._to_triangles(points[:, None], self.triangle[near]).min(1)
        # Triangles of which no piece is among the nearest are at least `bound` away, and `best` is at most 2 radii too large.
        bound = reach[:, -1] - self.radius
        open_ = np.flatnonzero(best > np.where(best <= 4 * self.cell + 2 * self.radius, bound, bound + self.cell))
        if len(open_):
            found = self.tree.query_ball_point(points[open_], best[open_] + self.radius * (1 + 1e-9))
            count = np.array([len(each) for each in found])
            triangle = self.triangle[np.fromiter(chain.from_iterable(found), np.int64, count.sum())]
            every = self._to_triangles(np.repeat(points[open_], count, 0), triangle)
            best[open_] = np.minimum.reduceat(every, np.cumsum(count) - count)
        return best

    def _to_triangles(self, points: Points, triangle: NDArray[np.int64]) -> NDArray[np.float64]:
        """Distance of each of points `[*, 3]` to its triangle `[*]`."""
        to = points[..., None, :] - self.corners[triangle]
        edges = self.edges[triangle]
        share = np.clip((to * edges).sum(-1) * self.per_square[triangle], 0, 1)
        off = to - share[..., None] * edges
        border = (off * off).sum(-1).min(-1)
        height = (to[..., 0, :] * self.normal[triangle]).sum(-1)
        above = ((to * self.inward[triangle]).sum(-1) > 0).all(-1)
        return np.sqrt(np.where(above, height * height, border))


def _pieces(corners: Points, size: float) -> tuple[Points, NDArray[np.int64], float]:
    """Triangles laid out in rectangles of at most size × size along their longest edges: the rectangles' middles `[n, 3]`, the
    triangle that each is a piece of, and the distance from any point of a triangle within which one of its middles is."""
    length = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=-1)
    turn = (length.argmax(1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(corners, turn[..., None], 1).swapaxes(0, 1)
    base = length.max(1)
    x = (b - a) / np.where(base > 0, base, 1)[:, None]
    foot = ((c - a) * x).sum(-1)
    y = c - a - foot[:, None] * x
    height = np.linalg.norm(y, axis=-1)
    columns, rows = (np.maximum(np.ceil(extent / size), 1) for extent in (base, height))
    width, depth = base / columns, 1 / rows
    triangle, k = _runs((columns * rows).astype(np.int64))
    row, column = np.divmod(k, columns[triangle])
    low = row * depth[triangle]  # as a share of the height; the triangle's widest place in the row
    within = (column + 1) * width[triangle] >= low * foot[triangle]
    within &= column * width[triangle] <= base[triangle] - low * (base - foot)[triangle]
    triangle, row, column = triangle[within], row[within], column[within]
    middles = a[triangle] + ((column + 0.5) * width[triangle])[:, None] * x[triangle]
    middles += ((row + 0.5) * depth[triangle])[:, None] * y[triangle]
    return middles, triangle, 0.5 * float(np.hypot(width, height * depth).max())


def _runs(count: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Each i repeated count[i] times, and the numbers from 0 to count[i] − 1 beside them."""
    each = np.repeat(np.arange(len(count)), count)
    return each, np.arange(len(each)) - (np.cumsum(count) - count)[each]


def _inside(vertices: Points, faces: Faces, shape: tuple[int, int, int]) -> NDArray[np.bool_]:
    """Whether a closed mesh, in cells from the first node, winds about the nodes: by its crossings with the grid's lines along z,
    each counted with the direction in which it is crossed."""
    # Off the nodes by an odd little, so that no line meets an edge or a vertex that lies in a plane of nodes.
    flat = vertices[:, :2] + 1e-7 * np.array([math.sqrt(2) - 1, math.sqrt(3) - 1])
    low = np.ceil(flat[faces].min(1)).astype(np.int64)
    size = np.maximum(np.floor(flat[faces].max(1)).astype(np.int64) - low + 1, 0)
    count = size.prod(1)
    crossings = np.zeros(shape, np.int64)
    portion = np.cumsum(count) // 2**20
    for some in np.split(np.arange(len(faces)), np.flatnonzero(np.diff(portion)) + 1):
        run, k = _runs(count[some])
        face = some[run]
        column = low[face] + np.stack((k // size[face, 1], k % size[face, 1]), -1)
        sides = np.stack([_side(flat, faces[face, edge], faces[face, (edge + 1) % 3], column) for edge in range(3)], -1)
        left = np.signbit(sides)
        hit = left.all(-1) | ~left.any(-1)
        share = np.abs(sides[hit])[:, [1, 2, 0]]  # of the corner opposite each edge
        z = (share * vertices[faces[face[hit]], 2]).sum(-1) / share.sum(-1)
        node = np.ceil(z).astype(np.int64) - 1  # the last one below
        np.add.at(crossings, (*column[hit].T, node), np.where(left[hit, 0], -1, 1))
    return np.flip(np.cumsum(np.flip(crossings, 2), 2), 2) > 0


def _side(flat: Points, start: NDArray[np.int64], end: NDArray[np.int64], column: NDArray[np.int64]) -> NDArray[np.float64]:
    """Twice the area from edges to columns `[n]`, > 0 to the left: the two triangles at an edge get the same number, negated."""
    first, second = flat[np.minimum(start, end)], flat[np.maximum(start, end)]
    along, to = second - first, column - first
    area = along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]
    return np.where(start < end, area, -area)


def _cache() -> Path:
    if folder := os.environ.get("PBFD_TORCH_CACHE"):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pbfd_torch"


def _read(name: str, shape: tuple[int, int, int]) -> NDArray[np.float64] | None:
    try:
        with np.load(_cache() / name, allow_pickle=False) as file:
            distances: NDArray[np.float64] = file["distances"]
    except Exception:  # absent, or damaged in any way: it is computed again
        return None
    usable = distances.shape == shape and distances.dtype == np.float64 and np.isfinite(distances).all()
    return distances if usable else None


def _write(name: str, distances: NDArray[np.float64]) -> None:
    """Written beside and renamed: other processes see a whole file or none."""
    try:
        folder = _cache()
        folder.mkdir(parents=True, exist_ok=True)
        handle, part = tempfile.mkstemp(dir=folder, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, distances=distances)
            os.replace(part, folder / name)
        finally:
            Path(part).unlink(missing_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: there is no home folder
        return
