"""From a scene to its appearance."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from weakref import WeakKeyDictionary

import numpy as np
import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Point
from pbfd_torch.errors import PbfdError
from pbfd_torch.looks.appearance import Appearance, JointMark, Plane, Visual
from pbfd_torch.looks.painting import STONE, link_color, surface_of, visual_of
from pbfd_torch.looks.tessellation import tessellated
from pbfd_torch.scene import Scene
from pbfd_torch.tree.articulation import JointKind
from pbfd_torch.tree.kinematics import place

_THIN = 1e-3  # [m] half extents that a body without thickness is drawn with


_KNOWN: WeakKeyDictionary[Scene, Appearance] = WeakKeyDictionary()


def depicted(scene: Scene) -> Appearance:
    """What a scene looks like; it is worked out once."""
    if scene not in _KNOWN:
        _KNOWN[scene] = _depicted(scene)
    return _KNOWN[scene]


def _depicted(scene: Scene) -> Appearance:
    """A link looks like its visual shapes, else like its colliders, else like the box that has its inertia; numbers that differ
    between worlds are those of the first."""
    a = scene.articulation
    links = range(a.nlink)
    try:
        visuals = list(scene.visuals())
    except PbfdError as error:  # the robot's file may be gone by now; what was computed is not lost for that
        warnings.warn(f"links look like their colliders: {error}", stacklevel=2)
        visuals = []
    seen = {x.body for x in visuals}
    standing = {x.name for x in scene.obstacles}  # links fixed to the world are obstacles of their name
    for k in (k for k in links if k not in seen and a.link_names[k] not in standing):
        mine = [x for x in scene.colliders if x.link == a.link_names[k]]
        visuals += [*_worn(mine, k), *_skin([x for x in mine if isinstance(x.shape, Point)], k)] or _inertia_box(scene, k)
    painted = {a.link_names[k] for k in seen if 0 <= k < a.nlink}
    planes = []
    for k, obstacle in enumerate(scene.obstacles, a.nlink):
        if isinstance(obstacle, HalfSpace):
            planes.append(Plane(obstacle.name, k, obstacle.normal, obstacle.offset))
        elif obstacle.name not in painted:  # a link fixed to the world, which has visuals
            visuals.append(surface_of(obstacle.name, k, tessellated(obstacle.shape), color=STONE))
    gravity = scene.gravity.detach().reshape(-1, 3)[0].double()
    strength = float(torch.linalg.vector_norm(gravity))
    up = (0.0 - gravity / strength).tolist() if strength > 0 else (0.0, 0.0, 1.0)
    return Appearance(tuple(visuals), tuple(planes), tuple(_joint_marks(scene)), tuple(up))


def _worn(colliders: Iterable[Collider], link: int) -> list[Visual]:
    solid = [x for x in colliders if not isinstance(x.shape, Point)]
    return [visual_of(x.name, link, x.shape, x.position, x.quaternion, link_color(link)) for x in solid]


def _skin(points: Sequence[Collider], link: int) -> list[Visual]:
    """The hull of single points with their margins: they stand for a body between them."""
    import trimesh

    thick = [x for x in points if x.margin > 0]
    if not thick:
        return []
    balls = [trimesh.creation.icosphere(subdivisions=2, radius=x.margin).vertices + np.array(x.position) for x in thick]
    return [surface_of("skin", link, trimesh.convex.convex_hull(np.concatenate(balls)), color=link_color(link))]


def _inertia_box(scene: Scene, link: int) -> list[Visual]:
    """The box of uniform density with the link's mass, centre of mass and inertia; nothing for a link without mass."""
    import trimesh

    a = scene.articulation
    matrix = a.pseudo_inertia.detach().reshape(-1, a.nlink, 4, 4)[0, link].double()
    mass = float(matrix[3, 3])
    if mass <= 0:
        return []
    com = matrix[:3, 3] / mass
    second, axes = torch.linalg.eigh(matrix[:3, :3] / mass - torch.outer(com, com))
    half = (3 * second.clamp_min(0)).sqrt().clamp_min(_THIN).numpy()  # ∫x² over a box of half extent h is m h²/3
    turn = (axes * torch.linalg.det(axes)).numpy()
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = turn, com.numpy()
    return [surface_of("inertia", link, trimesh.creation.box(2 * half, transform=place), color=link_color(link))]


def _joint_marks(scene: Scene) -> Iterable[JointMark]:
    """Every joint at the reference configuration, seen from the link that it carries."""
    a, t = scene.articulation, scene.articulation.topology
    with torch.no_grad():
        placement = place(a, a.rest)
        links = placement.poses.reshape(-1, a.nlink, 4, 4)[0].double()
        nodes = placement.nodes.reshape(-1, t.nnode, 4, 4)[0].double()
        axes = a.joint_axis.reshape(-1, t.njoint, 3)[0].double()
        for j, name in enumerate(a.joint_names):
            seen = torch.linalg.inv(links[t.joint_link[j]]) @ nodes[j + 1]
            axis = (
                tuple((seen[:3, :3] @ axes[j]).tolist()) if t.joint_sizes[j] == (JointKind.HINGE.nq, JointKind.HINGE.nv) else None
            )
            yield JointMark(name, t.joint_link[j], t.q_start[j], t.joint_sizes[j][0], tuple(seen[:3, 3].tolist()), axis)
