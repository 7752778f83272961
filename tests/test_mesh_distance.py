"""Obstacles from meshes: distances on their grids against exact ones, the cache, files, and bad grids."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.contact import mesh_distance
from pbfd_torch.contact.distance_grid import DistanceGrid
from pbfd_torch.contact.height_field import HeightField
from pbfd_torch.contact.mesh_distance import Mesh
from pbfd_torch.errors import InputError
from tests.grid_points import node_points
from tests.random_numbers import uniform as random

Array = NDArray[np.float64]
BOX = trimesh.creation.box((1.0, 0.6, 0.8))


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv("PBFD_TORCH_CACHE", str(folder))
    return folder


def box_distance(points: Tensor, half: tuple[float, float, float] = (0.5, 0.3, 0.4)) -> Tensor:
    excess = points.abs() - torch.tensor(half, dtype=points.dtype)
    return excess.clamp(min=0).norm(dim=-1) + excess.amax(-1).clamp(max=0)


def test_distance_grid_far_outside_grows_and_points_away() -> None:
    grid = Mesh(BOX.vertices, BOX.faces, 0.1).surface()
    directions = torch.nn.functional.normalize(random(200, 3) - 0.5, dim=-1)
    distance = torch.linspace(1.1, 60, 500, dtype=torch.float64)
    field = grid.field(distance[:, None, None] * directions)
    assert (field.distance > 0.15).all()
    assert (field.distance.diff(dim=0) > 0).all()
    size = field.normal.norm(dim=-1)
    assert size.min() > 0.7
    assert size.max() < 1.5
    for dtype in (torch.float32, torch.float64):
        far = Mesh(BOX.vertices, BOX.faces, 0.1).surface(dtype).field(1e9 * torch.eye(3, dtype=dtype))
        assert far.distance.isfinite().all()
        assert (far.distance > 9e8).all()
        assert far.normal.isfinite().all()
        assert far.curvature.isfinite().all()


def hollow_box() -> trimesh.Trimesh:
    cavity = trimesh.creation.box((0.5, 0.3, 0.4))
    cavity.invert()
    return trimesh.Trimesh(np.concatenate((BOX.vertices, cavity.vertices)), np.concatenate((BOX.faces, cavity.faces + 8)))


def turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return mesh.copy().apply_transform(trimesh.transformations.rotation_matrix(0.7, (1, 2, 3)))


@pytest.mark.parametrize(
    "mesh",
    [
        BOX,
        hollow_box(),
        turned(trimesh.creation.torus(0.5, 0.2, major_sections=24, minor_sections=12)),
        trimesh.creation.annulus(0.3, 0.5, 0.4, sections=24),
        trimesh.creation.cylinder(0.2, 2.0, sections=48),
        turned(trimesh.creation.cone(0.3, 0.9, sections=5)),
    ],
    ids=["box", "hollow box", "torus", "annulus", "cylinder", "cone"],
)
def test_mesh_distance_is_exact_at_nodes(mesh: trimesh.Trimesh) -> None:
    grid = Mesh(mesh.vertices, mesh.faces, float(mesh.extents.max()) / 24).surface()
    nodes = node_points(grid)
    chosen = nodes[torch.randperm(len(nodes), generator=torch.Generator().manual_seed(0))[:400]].numpy()
    corners = mesh.triangles
    pairs = np.repeat(corners[None], len(chosen), 0).reshape(-1, 3, 3)
    closest = trimesh.triangles.closest_point(pairs, np.repeat(chosen, len(corners), 0)).reshape(len(chosen), -1, 3)
    distance = np.linalg.norm(closest - chosen[:, None], axis=-1).min(1)
    # van Oosterom and Strackee's solid angle of all triangles: 4π inside
    a, b, c = (corners[None] - chosen[:, None, None]).transpose(2, 0, 1, 3)
    la, lb, lc = (np.linalg.norm(each, axis=-1) for each in (a, b, c))
    volume = (a * np.cross(b, c)).sum(-1)
    angle = np.arctan2(volume, la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb).sum(1)
    expected = np.where(angle > np.pi, -distance, distance)
    assert (expected < 0).any()
    np.testing.assert_allclose(grid.field(torch.as_tensor(chosen)).distance, expected, rtol=0, atol=1e-12)


def test_mesh_of_a_box_between_nodes() -> None:
    cell = 1 / 40
    grid = Mesh(BOX.vertices, BOX.faces, cell).surface()
    points = (random(20000, 3) - 0.5) * (torch.tensor((1.0, 0.6, 0.8)) + 6 * cell)
    exact = box_distance(points)
    field = grid.field(points)
    assert (field.distance - exact).abs().max() < 0.3 * cell  # at edges and corners, which are rounded
    assert (field.distance * exact)[exact.abs() > 0.3 * cell].min() > 0
    face = (points.abs() < torch.tensor((0.3, 0.1, 1.0))).all(-1) & ((points[:, 2].abs() - 0.4).abs() < 0.05)  # 8 cells from edges
    upward = points[face].sign() * torch.tensor((0.0, 0.0, 1.0))
    assert face.sum() > 100
    assert (field.distance - exact)[face].abs().max() < 1e-3 * cell
    assert (field.normal[face] - upward).norm(dim=-1).max() < 5e-3


def test_mesh_of_a_sphere_is_as_good_as_its_facets() -> None:
    ball = trimesh.creation.icosphere(4)  # its facets are up to 1.2e-3 inside the sphere
    directions = torch.nn.functional.normalize(random(2000, 3) - 0.5, dim=-1)
    for cell in (0.2, 0.1):
        field = Mesh(ball.vertices, ball.faces, cell).surface().field(1.03 * directions)
        assert (field.distance - 0.03).abs().max() < 1.4e-3
        assert (field.normal - directions).norm(dim=-1).max() < 0.02


def test_sharp_and_thin_faces_at_random_angles_have_clean_signs() -> None:
    spike = turned(trimesh.creation.cone(0.05, 1.0, sections=3))
    grid = Mesh(spike.vertices, spike.faces, 0.04).surface()
    values = grid.field(node_points(grid)).distance.view(*(n - 2 for n in grid.coefficients.shape))
    for axis in range(3):  # the distance changes by no more than the way: a wrong sign would show as a leap
        assert (values.diff(dim=axis).abs() <= 0.04 + 1e-12).all()


def test_cache_is_used_repaired_and_not_required(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    compute = mesh_distance.signed_distances

    def counted(*arguments: object) -> Array:
        calls.append(1)
        return compute(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(mesh_distance, "signed_distances", counted)

    def surface(cell: float = 0.1) -> Tensor:
        return Mesh(BOX.vertices, BOX.faces, cell).surface().coefficients

    first = surface()
    (file,) = cache.iterdir()
    written = file.stat().st_mtime_ns
    assert torch.equal(surface(), first)
    assert (len(calls), file.stat().st_mtime_ns) == (1, written)
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    with np.load(file) as content:
        other = content["distances"][1:]
    for n, damage in enumerate((b"", whole[: len(whole) // 2], bytes(flipped), b"no archive", other)):
        if isinstance(damage, bytes):
            file.write_bytes(damage)
        else:
            np.savez(file, distances=damage)
        assert torch.equal(surface(), first)
        assert len(calls) == n + 2
        assert torch.equal(surface(), first)
        assert len(calls) == n + 2
    assert list(cache.iterdir()) == [file]
    surface(0.12)
    assert len(calls) == 7
    assert len(list(cache.iterdir())) == 2
    blocked = tmp_path / "file"
    blocked.touch()
    monkeypatch.setenv("PBFD_TORCH_CACHE", str(blocked / "below"))
    assert torch.equal(surface(), first)
    monkeypatch.delenv("PBFD_TORCH_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    surface()
    assert os.listdir(tmp_path / "xdg" / "pbfd_torch") == [file.name]


def test_a_grid_reaches_as_far_as_it_is_asked_to() -> None:
    """`reaching` widens the grid beyond the mesh, and is the mesh itself where it reaches far enough."""
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    mesh = Mesh(box.vertices, box.faces, cell=0.25)
    assert mesh.reaching(0.5) is mesh
    grid = mesh.reaching(1.0).surface()
    assert float(grid.origin.max()) <= -1.5
    assert float(grid.last.min()) >= 1.5


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "dae"])
@pytest.mark.parametrize("scale", [0.5, (0.5, -0.5, 0.5)])
def test_mesh_from_file(
    tmp_path: Path, suffix: str, scale: float | tuple[float, float, float], capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / f"box.{suffix}"
    BOX.export(file)
    mesh = Mesh.from_file(file, scale, cell=0.05, margin=0.2)
    grid = mesh.surface()
    nodes = node_points(grid)
    assert (nodes.amax(0) >= torch.tensor((0.45, 0.35, 0.4), dtype=torch.float64)).all()
    torch.testing.assert_close(grid.field(nodes).distance, box_distance(nodes, (0.25, 0.15, 0.2)), rtol=0, atol=1e-7)
    assert not capsys.readouterr().err  # no progress bar where there is no terminal


CLOSED = "mesh is not closed: 3 of 18 edges are open"
FLAT = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)), "mesh is empty: it has 0 vertices and 0 faces"),
        (lambda: Mesh(BOX.vertices[:, :2], BOX.faces), "must be .n, 3. and .m, 3."),
        (lambda: Mesh(BOX.vertices * np.nan, BOX.faces), "vertices of a mesh must be finite"),
        (lambda: Mesh(BOX.vertices, BOX.faces + 1), "name vertices 1 to 8: must be 0 to 7"),
        (lambda: Mesh(BOX.vertices, BOX.faces[1:]), CLOSED),
        (lambda: Mesh(BOX.vertices, np.concatenate((BOX.faces[:1, ::-1], BOX.faces[1:]))), "inconsistently: at 3 of 18 edges"),
        (lambda: Mesh(BOX.vertices, BOX.faces[:, ::-1]), "inside out: its volume is -0.48 m³"),
        (lambda: Mesh(FLAT, TETRAHEDRON), "mesh is flat"),
        (lambda: Mesh(BOX.vertices, BOX.faces, cell=0.0), "cell of a mesh is 0.0 m: must be > 0"),
        (lambda: Mesh(BOX.vertices, BOX.faces, cell=1e-4), "at most 6.7e.07 are allowed"),
        (lambda: Mesh(BOX.vertices, BOX.faces, cell=0.1, margin=0.1), "at least 2 cells, 0.2 m"),
        (lambda: Mesh.from_file("missing.stl"), "mesh 'missing.stl' cannot be read"),
        (lambda: DistanceGrid.through(np.zeros((2, 1, 3)), (0, 0, 0), 1), r"shape \(2, 1, 3\)"),
        (lambda: DistanceGrid.through(np.full((2, 2, 3), np.inf), (0, 0, 0), 1), "must be finite"),
        (lambda: DistanceGrid.through(np.zeros((2, 2, 3)), (0, 0, 0), -1), "spacing is -1 m"),
        (lambda: HeightField(np.zeros((1, 5)), (1, 1)), r"shape \(1, 5\): must be .nx, ny., each ≥ 2"),
        (lambda: HeightField(np.array([[0, np.nan], [0, np.inf]]), (1, 1)), "2 of 4 heights are not finite"),
        (lambda: HeightField(np.zeros((2, 2)), (1, 0)), r"spacing of heights is \(1, 0\) m"),
        (lambda: HeightField.from_function(lambda x, y: x, (1, 1), 0), "resolution 0 m"),
    ],
)
def test_bad_input_is_refused(make: Callable[[], object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()


def test_bad_files_are_named(tmp_path: Path) -> None:
    file = tmp_path / "open.stl"
    trimesh.Trimesh(BOX.vertices, BOX.faces[1:]).export(file)
    with pytest.raises(InputError, match=rf"open\.stl': {CLOSED}"):
        Mesh.from_file(file)
    with pytest.raises(InputError, match=r"scale of mesh .* is 0"):
        Mesh.from_file(file, 0)
