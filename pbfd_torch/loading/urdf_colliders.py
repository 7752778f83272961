"""Collision shapes of a URDF file."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from pbfd_torch.contact.shapes import Box, Capsule, Collider, Cylinder, Shape, Sphere
from pbfd_torch.loading.meshes import HullLosses, find_mesh, load_hull
from pbfd_torch.loading.report import naming
from pbfd_torch.loading.urdf_file import UrdfFile
from pbfd_torch.loading.urdf_placement import Placed


def urdf_colliders(file: UrdfFile, links: Iterable[str], fixed: Collection[str]) -> tuple[tuple[Collider, ...], list[str]]:
    """Colliders of the links that can move, and lines on what is lost. Raises `ModelError` naming link and shape."""
    colliders = []
    standing = 0
    losses = HullLosses()
    for link in links:
        parsed = file.links[link]
        if link in fixed:
            standing += len(parsed.data.collisions)
            continue
        for k, (collision, given) in enumerate(zip(parsed.data.collisions, parsed.collision_names, strict=True)):
            name = given or f"{link}_{k}"
            place = Placed.from_origin(collision.origin)
            with naming(parsed.place, f"link '{link}', collision '{name}'"):
                shape = _shape(collision.geometry, file.path, losses)
                colliders.append(Collider(name, link, shape, place.position, place.quaternion))
    notes = [f"collision shapes of links fixed to the world are no obstacles ({standing})"] if standing else []
    return tuple(colliders), notes + losses.lines()


def _shape(geometry: Any, robot_file: Path, losses: HullLosses) -> Shape:
    kind = type(geometry).__name__
    if kind == "Box":
        x, y, z = (0.5 * s for s in geometry.size)
        return Box((x, y, z))
    if kind == "Sphere":
        return Sphere(geometry.radius)
    if kind == "Cylinder":
        return Cylinder(geometry.radius, 0.5 * geometry.length)
    if kind == "Capsule":
        return Capsule(geometry.radius, 0.5 * geometry.length)
    x, y, z = geometry.scale or (1.0, 1.0, 1.0)
    mesh = find_mesh(geometry.filename, robot_file)
    return losses.keep(mesh.name, load_hull(mesh, (x, y, z)))
