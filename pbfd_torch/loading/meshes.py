"""Mesh files become convex hulls of few vertices."""

from __future__ import annotations

import importlib.util
import math
import os
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

import numpy as np

from pbfd_torch.contact.shapes import ConvexHull, Points
from pbfd_torch.errors import ModelError
from pbfd_torch.loading.bounds import TRIANGLES, require_count, require_file_size
from pbfd_torch.loading.report import first_bytes, naming

MAX_VERTICES = 64
MESHES = (".stl", ".obj", ".ply", ".dae")


@dataclass(frozen=True, eq=False)
class ReducedHull:
    """`loss` [m]: how far the surface moved inwards at most, 0 if every vertex was kept."""

    shape: ConvexHull
    loss: float


@dataclass
class HullLosses:
    """Remembers which hulls of a robot lost vertices."""

    metres: dict[str, float] = field(default_factory=dict)

    def keep(self, mesh: str, hull: ReducedHull) -> ConvexHull:
        if hull.loss > 0:
            self.metres[mesh] = max(hull.loss, self.metres.get(mesh, 0.0))
        return hull.shape

    def lines(self) -> list[str]:
        """One line that says how much, or none."""
        if not self.metres:
            return []
        worst = max(self.metres, key=lambda mesh: self.metres[mesh])
        lost = f"{1e3 * self.metres[worst]:.2g} mm"
        return [f"convex hulls are cut to {MAX_VERTICES} vertices ({len(self.metres)}): at most {lost} lost ({worst})"]


def require_triangles(file: Path) -> None:
    """Raises `ModelError` for a mesh file that is too large, before it is read."""
    require_file_size(file)
    head = first_bytes(file, 84)
    if file.suffix.lower() == ".stl" and len(head) == 84:
        (count,) = struct.unpack("<I", head[80:])
        if file.stat().st_size == 84 + 50 * count:  # it is not one in text
            _require_few(file, count)


def _require_few(file: Path, triangles: int) -> None:
    with naming("", f"mesh '{file}'"):
        require_count("triangles", triangles, TRIANGLES, "simplify it")


def load_hull(file: Path, scale: tuple[float, float, float] = (1.0, 1.0, 1.0), max_vertices: int = MAX_VERTICES) -> ReducedHull:
    """Convex hull of a mesh file (STL, OBJ, PLY, COLLADA) in metres, with at most `max_vertices` vertices. Of a COLLADA file the
    unit is applied and the up-axis is not, as everywhere in ROS. Raises `ModelError` for a file that holds no usable mesh."""
    vertices: Points = np.asarray(read_mesh(file).vertices, np.float64)
    if not np.isfinite(scale).all():
        raise ModelError(f"mesh '{file}': scale is {scale}: must be finite")
    return reduced_hull(vertices * np.array(scale), max_vertices, name=str(file))


def read_mesh(file: Path) -> Any:
    """All parts of a mesh file as one `trimesh.Trimesh` in metres; see `load_hull`."""

    if file.suffix.lower() not in MESHES:
        raise ModelError(f"mesh '{file}': extension must be one of {', '.join(MESHES)}")
    require_triangles(file)
    if file.suffix.lower() == ".dae" and importlib.util.find_spec("collada") is None:
        raise ModelError(f"mesh '{file}': reading COLLADA files needs the package pycollada (pip install pycollada)")
    try:
        whole = _joined(file)
    except ModelError:
        raise
    except Exception as error:  # trimesh raises whatever its readers raise
        raise ModelError(f"mesh '{file}' cannot be read: {error}") from error
    vertices, faces = np.asarray(whole.vertices), np.asarray(whole.faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise ModelError(f"mesh '{file}': vertices must be finite, three numbers each")
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ModelError(f"mesh '{file}': faces name vertices {faces.min()} to {faces.max()}: must be 0 to {len(vertices) - 1}")
    return whole


def _joined(file: Path) -> Any:
    """As trimesh reads it."""
    import trimesh

    scene: Any = trimesh.load_scene(file, process=False, skip_materials=True)
    parts = [
        scene.geometry[name].copy().apply_transform(matrix)
        for matrix, name in (scene.graph[node] for node in scene.graph.nodes_geometry)
    ]
    if not sum(len(part.vertices) for part in parts):
        raise ModelError(f"mesh '{file}' holds no vertices")
    _require_few(file, sum(len(getattr(part, "faces", ())) for part in parts))
    whole: Any = trimesh.util.concatenate([trimesh.Trimesh(x.vertices, getattr(x, "faces", None), process=False) for x in parts])
    return whole.apply_scale(_collada_unit(file)) if file.suffix.lower() == ".dae" else whole


def _collada_unit(file: Path) -> float:
    """Metres per unit of a COLLADA file, which trimesh leaves unapplied."""
    import collada

    return float(collada.Collada(str(file), ignore=[collada.common.DaeError]).assetInfo.unitmeter or 1.0)


def reduced_hull(points: Points, max_vertices: int = MAX_VERTICES, name: str = "") -> ReducedHull:
    """Convex hull of `points` `[n, 3]`. Above `max_vertices` it is grown from four vertices, each time by the one that sticks out
    most, so that what is lost is small and known. Flat points give the corners of their polygon."""
    from scipy.spatial import ConvexHull as Hull
    from scipy.spatial import QhullError

    points = np.unique(points, axis=0)
    if len(points) < 4:
        raise ModelError(f"mesh '{name}' has {len(points)} distinct vertices: a convex hull needs at least 4")
    try:
        corners = points[Hull(points).vertices]
    except QhullError:
        return ReducedHull(ConvexHull(_flat_corners(points, name)), 0.0)
    if len(corners) <= max_vertices:
        return ReducedHull(ConvexHull(corners), 0.0)
    kept = _simplex(corners)
    hull = Hull(corners[kept], incremental=True)
    while len(kept) < max_vertices:
        outside = (corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max(1)
        kept.append(int(outside.argmax()))
        hull.add_points(corners[kept[-1:]])
    return ReducedHull(ConvexHull(corners[kept]), _distance(corners, corners[kept][hull.simplices]))


def _simplex(points: Points) -> list[int]:
    """Four vertices far apart: the least in x, then each time the farthest from the point, line and plane so far."""
    chosen = [int(points[:, 0].argmin())]
    rest = points - points[chosen[0]]
    for _ in range(3):
        k = int(np.linalg.norm(rest, axis=1).argmax())
        direction = rest[k] / np.linalg.norm(rest[k])
        rest = rest - np.outer(rest @ direction, direction)
        chosen.append(k)
    return chosen


def _flat_corners(points: Points, name: str) -> Points:
    """Corners of the polygon that coplanar points span, in turn."""
    from scipy.spatial import ConvexHull as Hull
    from scipy.spatial import QhullError

    centred = points - points.mean(0)
    plane = np.linalg.svd(centred, full_matrices=False)[2][:2]
    try:
        corners = points[Hull(centred @ plane.T).vertices]
    except QhullError:
        raise ModelError(f"mesh '{name}': all vertices lie on one line") from None
    return corners if len(corners) > 3 else np.concatenate((corners, corners[:1]))  # a triangle as a hull of four


def _distance(points: Points, triangles: Points) -> float:
    """Largest distance of `points`, none of them inside, from a convex surface of `triangles` `[n, 3, 3]`."""
    import trimesh

    worst = 0.0
    for some in np.array_split(points, math.ceil(len(points) / 64)):  # all at once would take much memory
        each, against = np.repeat(some, len(triangles), 0), np.tile(triangles, (len(some), 1, 1))
        gaps = np.linalg.norm(trimesh.triangles.closest_point(against, each) - each, axis=1).reshape(len(some), -1)
        worst = max(worst, float(gaps.min(1).max()))
    return worst


def find_mesh(filename: str, robot_file: Path) -> Path:
    """The file that a URDF means by `package://NAME/PATH`, `file://…` or a path relative to itself. A package is looked for above
    the robot file and in ROS_PACKAGE_PATH. Raises `ModelError` saying where it looked."""
    try:
        places = _places(filename, robot_file)
        found = next((place for place in places if place.is_file()), None)
    except (ValueError, OSError) as error:  # is no address, holds a zero byte, or is too long for a name
        shown = filename if len(filename) <= 60 else f"{filename[:60]}…"
        raise ModelError(f"mesh '{shown}' cannot be looked for: {getattr(error, 'strerror', None) or error}") from None
    if found is None:
        raise ModelError(f"mesh '{filename}' not found; looked at {', '.join(map(str, places))}")
    return found


def _places(filename: str, robot_file: Path) -> list[Path]:
    url = urlparse(filename)
    if url.scheme in ("package", "model"):
        inside = unquote(url.path).lstrip("/")
        roots = [*robot_file.absolute().parents, *(Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p)]
        return [root / inside for root in roots if root.name == url.netloc] + [root / url.netloc / inside for root in roots]
    return [robot_file.absolute().parent / (unquote(url.path) if url.scheme == "file" else filename)]
