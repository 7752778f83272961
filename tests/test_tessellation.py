"""Shapes as triangles: closed, the right way round, as large as the shape, and made without libraries that are slow to import."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from pbfd_torch.contact import shapes
from pbfd_torch.looks.tessellation import tessellated

ROUND = [
    (shapes.Sphere(0.3), 4 / 3 * math.pi * 0.027),
    (shapes.Capsule(0.1, 0.4), 4 / 3 * math.pi * 0.001 + math.pi * 0.01 * 0.8),
    (shapes.Box((0.1, 0.2, 0.3)), 0.048),
    (shapes.Cylinder(0.2, 0.3), math.pi * 0.04 * 0.6),
    (shapes.Ellipsoid((0.1, 0.2, 0.3)), 4 / 3 * math.pi * 0.006),
]


@pytest.mark.parametrize(("shape", "volume"), ROUND, ids=lambda x: type(x).__name__)
def test_shapes_are_closed_and_as_large(shape: shapes.Shape, volume: float) -> None:
    """Their triangles look outwards; what is round is inscribed, and loses 2 % at most."""
    mesh = trimesh.Trimesh(vertices=tessellated(shape).vertices, faces=tessellated(shape).faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert 0.98 * volume < mesh.volume < volume * (1 + 1e-12)
    reach = np.array([float(np.linalg.norm(p)) for p in mesh.vertices]).max()
    points, radii = shape.candidates()
    assert reach <= float((np.linalg.norm(points, axis=1) + radii).max()) + 1e-12 or isinstance(shape, shapes.Ellipsoid)


def test_meshes_are_taken_as_they_are_and_points_have_no_surface() -> None:
    box = trimesh.creation.box()
    assert tessellated(box) is box
    assert len(tessellated(shapes.Point()).faces) == 0


def test_the_demo_needs_no_mesh_library() -> None:
    """Which takes over a second to import."""
    code = """import sys
from pbfd_torch.models import SCENES
from pbfd_torch.records.depiction import depicted
depicted(SCENES["chain-slope-drop"]().scene)
print(*(name for name in ("trimesh", "scipy") if name in sys.modules))"""
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert ran.stdout.split() == []
