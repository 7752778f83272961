"""URDF files: links and joints through pytorch-kinematics' parser, which keeps 64-bit numbers."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pbfd_torch.errors import ModelError
from pbfd_torch.loading.bounds import require_actuators, require_links
from pbfd_torch.loading.joint_terms import JointProperties, articulate, joint_limits
from pbfd_torch.loading.moments import clipped_moments
from pbfd_torch.loading.report import listing, naming, warn_not_modelled
from pbfd_torch.loading.robot import Robot
from pbfd_torch.loading.urdf_colliders import urdf_collisions
from pbfd_torch.loading.urdf_file import Parsed, UrdfFile, read_urdf
from pbfd_torch.loading.urdf_placement import Placed, plane_axes, rotation_matrix
from pbfd_torch.loading.urdf_visuals import urdf_visuals
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.tree.articulation import Joint, JointKind, Link

_GRAVITY = (0.0, 0.0, -9.81)  # [m/s²]; URDF has none


def load_urdf(
    path: str | os.PathLike[str],
    *,
    free_base: bool | None = None,
    excluded: Sequence[tuple[str, str]] = (),
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Robot:
    """Loads a URDF file.

    `free_base`: whether the root can move freely. None: it can, unless it is named "world" or neither it nor anything fixed to it
    has mass. Links come parents first, depth first, in the file's order of joints. Every revolute, continuous and prismatic joint
    gets a torque motor with the joint's effort limit (none if it is 0). A planar joint becomes two slides and a hinge; a floating
    joint becomes a free one (coordinates in the world), or three slides and a ball where its parent can move. Meshes become
    their convex hulls, and the shapes of links fixed to the world obstacles of the link's name.

    Links touch each other, except for the pairs `excluded` (see `load_srdf_exclusions`), links joined by a joint, and links that
    overlap by more than 1 mm in the rest configuration: shapes of real robots often do, and would push each other away. The last
    ones are named in `Robot.not_modelled`; all are in `Robot.excluded`. Raises `ModelError` naming file, line and element, and
    `InputError` for an unknown link in `excluded`.
    """
    file = read_urdf(Path(path))
    with naming(str(path)):
        root, order = _tree(file)
        free = _has_free_base(file, root, order) if free_base is None else free_base
        given, standing = _links(file, root, order, free)
        require_links(given)
        links, clipped = clipped_moments(given)
        joints = [x.data for x in file.joints.values()]
        properties = {j.name: _properties(j) for j in joints if j.type in ("revolute", "continuous", "prismatic")}
        articulation, terms = articulate(links, properties, dtype, device)
        driven = [name for name in articulation.joint_names if name in properties]
        motors = [Actuator.motor(name, name, effort=_effort(file.joints[name].data)) for name in driven]
        require_actuators(motors)
        actuators = Actuators.from_list(articulation, motors) if motors else None
    collisions = urdf_collisions(file, articulation, standing, excluded)
    return Robot(
        name=file.name,
        articulation=articulation,
        joint_terms=(*terms, *joint_limits(articulation, actuators, math.hypot(*_GRAVITY))),
        actuators=actuators,
        colliders=collisions.colliders,
        obstacles=collisions.obstacles,
        excluded=collisions.excluded,
        gravity=_GRAVITY,
        visuals=functools.partial(urdf_visuals, file.path.absolute(), articulation.link_names),
        not_modelled=warn_not_modelled(file.path, [*clipped, *_ignored(joints), *file.left_out, *collisions.left_out]),
    )


def _tree(file: UrdfFile) -> tuple[str, list[Parsed]]:
    """The root link, and the joints parents first; raises `ModelError` unless they form one tree."""
    if not file.links:
        raise ModelError("holds no <link>")
    carrying: dict[str, Parsed] = {}
    children: dict[str, list[Parsed]] = {name: [] for name in file.links}
    for name, joint in file.joints.items():
        with naming(joint.place, f"joint '{name}'"):
            for side in ("parent", "child"):
                if getattr(joint.data, side) not in file.links:
                    raise ModelError(f"{side} link '{getattr(joint.data, side)}' does not exist")
            if joint.data.child in carrying:
                other = carrying[joint.data.child].data.name
                raise ModelError(f"its child '{joint.data.child}' is also that of joint '{other}': closed loops are not possible")
        carrying[joint.data.child] = joint
        children[joint.data.parent].append(joint)
    roots = [name for name in file.links if name not in carrying]
    if len(roots) > 1:
        raise ModelError(f"has {len(roots)} root links, {listing(roots)}: every link but one must be the child of a joint")
    order: list[Parsed] = []
    pending = [joint for root in roots for joint in reversed(children[root])]
    while pending:
        order.append(pending.pop())
        pending += reversed(children[order[-1].data.child])
    reached = {*roots, *(x.data.child for x in order)}
    if lost := [name for name in file.links if name not in reached]:
        raise ModelError(f"the parents of links {listing(lost)} form a closed loop")
    return roots[0], order


def _has_free_base(file: UrdfFile, root: str, order: list[Parsed]) -> bool:
    group = {root}
    for joint in order:
        if joint.data.type == "fixed" and joint.data.parent in group:
            group.add(joint.data.child)
    return root != "world" and any(_mass(file.links[name].data) > 0 for name in group)


def _mass(link: Any) -> float:
    return float(link.inertial.mass) if link.inertial else 0.0


def _links(file: UrdfFile, root: str, order: list[Parsed], free: bool) -> tuple[list[Link], dict[str, Placed]]:
    """All links, and those fixed to the world with where they are."""
    base = (Joint(f"{root}_free", JointKind.FREE),) if free else ()
    links = [_link(file.links[root], "", Placed.identity(), base)]
    standing = {} if free else {root: Placed.identity()}
    for parsed in order:
        joint = parsed.data
        place = Placed.from_origin(joint.origin)
        with naming(parsed.place, f"joint '{joint.name}'"):
            parent, joints = joint.parent, tuple(_joints(joint))
            if joint.type == "floating" and parent in standing:
                place, parent, joints = standing[parent] @ place, "", (Joint(joint.name, JointKind.FREE),)
            elif joint.type == "fixed" and parent in standing:
                standing[joint.child] = standing[parent] @ place
            links.append(_link(file.links[joint.child], parent, place, joints))
    return links, standing


def _joints(joint: Any) -> Iterator[Joint]:
    """The joints that make up one URDF joint, from the parent to the child."""
    axis = tuple(joint.axis or (1.0, 0.0, 0.0))
    lower, upper = (joint.limit.lower, joint.limit.upper) if joint.limit else (-math.inf, math.inf)
    match joint.type:
        case "revolute":
            yield Joint(joint.name, JointKind.HINGE, axis, lower=lower, upper=upper)
        case "continuous":
            yield Joint(joint.name, JointKind.HINGE, axis)
        case "prismatic":
            yield Joint(joint.name, JointKind.SLIDE, axis, lower=lower, upper=upper)
        case "planar":
            first, second = plane_axes(axis)
            yield Joint(f"{joint.name}_1", JointKind.SLIDE, first)
            yield Joint(f"{joint.name}_2", JointKind.SLIDE, second)
            yield Joint(f"{joint.name}_turn", JointKind.HINGE, axis)
        case "floating":
            for name, along in (("x", (1.0, 0.0, 0.0)), ("y", (0.0, 1.0, 0.0)), ("z", (0.0, 0.0, 1.0))):
                yield Joint(f"{joint.name}_{name}", JointKind.SLIDE, along)
            yield Joint(f"{joint.name}_turn", JointKind.BALL)


def _link(parsed: Parsed, parent: str, place: Placed, joints: tuple[Joint, ...]) -> Link:
    link = parsed.data
    com, inertia = Placed.identity(), np.zeros((3, 3))
    if link.inertial:
        com = Placed.from_origin(link.inertial.origin)
        if link.inertial.inertia:
            turn = rotation_matrix(com.quaternion)
            inertia = turn @ np.array(link.inertial.inertia.to_matrix()) @ turn.T
    return Link(
        link.name, parent, place.position, place.quaternion, joints, mass=_mass(link), com=com.position, inertia=_rows(inertia)
    )


def _rows(matrix: NDArray[np.float64]) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(a), float(b), float(c)) for a, b, c in matrix)


def _properties(joint: Any) -> JointProperties:
    if not joint.dynamics:
        return JointProperties()
    return JointProperties(damping=joint.dynamics.damping or 0.0, dry_friction=joint.dynamics.friction or 0.0)


def _effort(joint: Any) -> float:
    return joint.limit.effort if joint.limit and joint.limit.effort > 0 else math.inf


def _ignored(joints: list[Any]) -> Iterator[str]:
    """What joints that can move ask for and the simulation leaves out."""
    moving = [j for j in joints if j.type != "fixed"]
    limited = [j for j in moving if j.limit]
    unlimited = [j for j in moving if not j.limit or j.limit.upper - j.limit.lower == math.inf]
    features = {
        "mimic, these joints move freely": [j for j in moving if j.mimic],
        "revolute and prismatic joints without limits move without": [j for j in unlimited if j.type in ("revolute", "prismatic")],
        "velocity limits": [j for j in limited if 0 < j.limit.velocity < math.inf],
        "<safety_controller>": [j for j in moving if j.safety_controller],
        "<calibration>": [j for j in moving if j.calibration],
        "limits and damping of planar and floating joints": [
            j for j in moving if j.type in ("planar", "floating") and (j.limit or j.dynamics)
        ],
    }
    for feature, found in features.items():
        if found:
            yield f"{feature} ({len(found)}): {listing((j.name for j in found), 3)}"
