"""Meshes become convex hulls of few vertices; what is lost is known."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pbfd_torch.contact.shapes import Points
from pbfd_torch.errors import ModelError
from pbfd_torch.loading.meshes import MAX_VERTICES, load_hull, reduced_hull

BOX = trimesh.creation.box((0.2, 0.4, 0.6))


def support(points: Points, directions: Points) -> Points:
    """How far points reach along directions."""
    reach: Points = (directions @ points.T).max(1)
    return reach


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "dae"])
def test_formats(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"box.{suffix}"
    BOX.export(file)
    hull = load_hull(file, scale=(1, -2, 0.5))
    assert hull.loss == 0
    expected = np.unique(BOX.vertices * (1, -2, 0.5), axis=0)
    np.testing.assert_allclose(np.unique(hull.shape.vertices.round(6), axis=0), expected, atol=1e-7)


def test_collada_unit_is_applied_and_up_axis_is_not(tmp_path: Path) -> None:
    file = tmp_path / "box.dae"
    BOX.export(file)
    text = file.read_text()
    assert text.count("</asset>") == text.count("<up_axis>") == 1
    before, after = re.split(r"<up_axis>\w*</up_axis>", text)
    file.write_text(f'{before}<unit name="mm" meter="0.001"/><up_axis>X_UP</up_axis>{after}')
    np.testing.assert_allclose(np.ptp(load_hull(file).shape.vertices, axis=0), (2e-4, 4e-4, 6e-4), rtol=1e-6)


def test_inner_and_repeated_points_are_dropped() -> None:
    points = np.concatenate((BOX.vertices, BOX.vertices, np.zeros((1, 3)), 0.5 * BOX.vertices))
    assert len(reduced_hull(points).shape.vertices) == 8


def test_a_cut_hull_keeps_vertices_and_knows_its_loss() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3).vertices * (1, 2, 0.3)
    cut = reduced_hull(ball)
    kept = cut.shape.vertices
    assert len(kept) == MAX_VERTICES < len(ball)
    assert {tuple(p) for p in kept} <= {tuple(p) for p in ball}
    directions = trimesh.creation.icosphere(subdivisions=4).vertices
    lost = support(ball, directions) - support(kept, directions)
    assert (lost >= 0).all()
    assert 0.9 * cut.loss < lost.max() <= cut.loss + 1e-12
    assert cut.loss < 0.1


def test_cutting_is_repeatable_and_more_vertices_lose_less() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3).vertices
    np.testing.assert_array_equal(reduced_hull(ball).shape.vertices, reduced_hull(ball).shape.vertices)
    assert reduced_hull(ball, 128).loss < reduced_hull(ball, 32).loss


def test_flat_meshes_give_their_polygon() -> None:
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]]) @ turn.T
    assert len(reduced_hull(square).shape.vertices) == 4
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 0]]) @ turn.T
    assert len(np.unique(reduced_hull(triangle).shape.vertices, axis=0)) == 3


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.eye(3), "mesh 'part' has 3 distinct vertices"),
        (np.outer(np.arange(5.0), [1, 2, 3]), "mesh 'part': all vertices lie on one line"),
    ],
)
def test_points_without_a_hull(points: Points, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        reduced_hull(points, name="part")


@pytest.mark.parametrize("content", [b"", b"solid x\nendsolid x\n", b"nonsense"])
def test_files_without_a_mesh(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "part.stl"
    file.write_bytes(content)
    with pytest.raises(ModelError, match=r"mesh '.*part\.stl'"):
        load_hull(file)


def test_not_finite(tmp_path: Path) -> None:
    file = tmp_path / "part.obj"
    file.write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 2 3 4\n")
    with pytest.raises(ModelError, match="must be finite"):
        load_hull(file)
