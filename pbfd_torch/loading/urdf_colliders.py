"""Collision shapes of a URDF file: colliders on links, obstacles in the world, and which of them never touch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Capsule, Collider, ConvexHull, Cylinder, Shape, Sphere
from pbfd_torch.errors import InputError
from pbfd_torch.loading.bounds import SHAPES, require_count, require_shapes, require_size
from pbfd_torch.loading.collisions import Collisions, as_solid, overlapping
from pbfd_torch.loading.meshes import HullLosses, find_mesh, load_hull
from pbfd_torch.loading.report import listing, naming, progress
from pbfd_torch.loading.urdf_file import UrdfFile
from pbfd_torch.loading.urdf_placement import Placed
from pbfd_torch.tree.articulation import Articulation

_FLAT = 1e-9  # of the size


def urdf_collisions(
    file: UrdfFile, articulation: Articulation, standing: Mapping[str, Placed], excluded: Sequence[tuple[str, str]]
) -> Collisions:
    """`standing`: the links fixed to the world, and where; their shapes become obstacles of the link's name. `excluded` pairs do
    not touch, nor do links that overlap at rest and links joined to one that is fixed. Raises `ModelError` naming link and shape,
    and `InputError` for an unknown name."""
    for name in (name for pair in excluded for name in pair):
        if name not in file.links:
            raise InputError(f"excluded pairs name '{name}': the links are {listing(file.links, 20)}")
    losses = HullLosses()
    count = sum(len(link.data.collisions) for link in file.links.values())
    with naming(str(file.path)):
        require_count("collision shapes", count, 2 * SHAPES, "simplify what collides")
    links = progress(articulation.link_names, "collision shapes")
    shapes = [collider for link in links for collider in _colliders(file, link, losses, link not in standing)]
    joints = [x.data for x in file.joints.values()]
    joined = [(x.parent, x.child) for x in joints if x.parent in standing and x.child not in standing]
    moving = [x for x in shapes if x.link not in standing]
    flat = [x for x in shapes if x.link in standing and _flat(x.shape)]
    obstacles = [_obstacle(x, standing[x.link]) for x in shapes if x.link in standing and x not in flat]
    with naming(str(file.path)):
        require_shapes(moving, obstacles)
    apart = tuple(dict.fromkeys((*excluded, *joined)))
    overlaps = overlapping(articulation, shapes, apart)
    lines = losses.lines()
    if flat:
        lines.append(f"flat shapes of links fixed to the world are no obstacles ({len(flat)}): {listing(x.name for x in flat)}")
    if overlaps:
        pairs = listing((f"{a} and {b}" for a, b in overlaps), 3)
        lines.append(f"contact of links that overlap in the rest configuration ({len(overlaps)}): {pairs}")
    return Collisions(
        colliders=tuple(moving),
        obstacles=tuple(obstacles),
        excluded=apart + overlaps,
        left_out=tuple(lines),
    )


def _colliders(file: UrdfFile, link: str, losses: HullLosses, moving: bool) -> list[Collider]:
    parsed, found = file.links[link], []
    for k, (collision, given) in enumerate(zip(parsed.data.collisions, parsed.collision_names, strict=True)):
        name = given or f"{link}_{k}"
        place = Placed.from_origin(collision.origin)
        with naming(parsed.place, f"link '{link}', collision '{name}'"):
            shape = _shape(collision.geometry, file, losses)
            require_size(shape, place.position, moving)
            found.append(Collider(name, link, shape, place.position, place.quaternion))
    return found


def _shape(geometry: Any, file: UrdfFile, losses: HullLosses) -> Shape:
    shape = primitive(geometry)
    if shape is not None:
        return shape
    x, y, z = geometry.scale or (1.0, 1.0, 1.0)
    mesh = find_mesh(geometry.filename, file.path)
    return losses.keep(mesh.name, load_hull(mesh, (x, y, z)))


def primitive(geometry: Any) -> Shape | None:
    """A parsed <geometry>; None for a mesh."""
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
    return None


def _flat(shape: Shape) -> bool:
    """Whether it has no inside."""
    if not isinstance(shape, ConvexHull):
        return False
    extents = np.linalg.svd(shape.vertices - shape.vertices.mean(0), compute_uv=False)
    return bool(extents[-1] <= _FLAT * extents[0])


def _obstacle(collider: Collider, link: Placed) -> Obstacle:
    place = link @ Placed(collider.position, collider.quaternion)
    return Obstacle(collider.link, as_solid(collider.shape), place.position, place.quaternion)
