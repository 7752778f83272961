"""MJCF files: compiled by MuJoCo, then read from its model."""

from __future__ import annotations

import functools
import math
import os
from pathlib import Path
from typing import Any

import torch

from pbfd_torch.errors import ModelError
from pbfd_torch.loading.bounds import require_actuators, require_link_count, require_links
from pbfd_torch.loading.joint_terms import JointProperties, articulate, joint_limits
from pbfd_torch.loading.mjcf_actuators import drive_properties, mjcf_actuators
from pbfd_torch.loading.mjcf_colliders import mjcf_collisions
from pbfd_torch.loading.mjcf_features import left_out
from pbfd_torch.loading.mjcf_model import CompiledModel, compile_mjcf
from pbfd_torch.loading.mjcf_visuals import mjcf_visuals
from pbfd_torch.loading.report import naming, warn_not_modelled
from pbfd_torch.loading.robot import Keyframe, Robot
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.tree.kinematics import retract


def load_mjcf(path: str | os.PathLike[str], *, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Robot:
    """Loads an MJCF file: q and v have the layout of MuJoCo's qpos and qvel.

    Geoms that can collide become colliders, those fixed to the world obstacles. Meshes become their convex hulls; a height field
    goes on beyond its border and has no bottom. Who touches whom is as in MuJoCo (contype, conaffinity, <exclude>, <pair>; not a
    body and its parent), also where shapes overlap. A geom with condim 1 is frictionless. The time step is that of each run. Other
    numbers of MuJoCo's own method (integrator, solver, solref, solimp, margin) are not read, and named in `Robot.not_modelled`.
    Raises `ModelError` with MuJoCo's own words, or naming the element that cannot be used, is too large (`loading.bounds`) or not
    finite.
    """
    model = compile_mjcf(Path(path))
    with naming(str(path)):
        gravity = _gravity(model)
        require_link_count(model.data.nbody - 1, model.data.nv)
        links = _links(model)
        require_links(links)
        articulation, terms = articulate(links, _properties(model), dtype, device)
        drives, controls, idle = mjcf_actuators(model)
        require_actuators(drives)
        collisions = mjcf_collisions(model)
        actuators = Actuators.from_list(articulation, drives) if drives else None
    return Robot(
        name=model.name,
        articulation=articulation,
        joint_terms=(*terms, *joint_limits(articulation, actuators, math.hypot(*gravity))),
        actuators=actuators,
        colliders=collisions.colliders,
        obstacles=collisions.obstacles,
        excluded=collisions.excluded,
        gravity=gravity,
        visuals=functools.partial(mjcf_visuals, Path(path).absolute()),
        keyframes=_keyframes(model, articulation, controls),
        not_modelled=warn_not_modelled(model.path, [*idle, *collisions.left_out, *left_out(model)]),
    )


def _links(model: CompiledModel) -> list[Link]:
    m = model.data
    return [
        Link(
            name=model.body(b),
            parent=model.body(int(m.body_parentid[b])) if m.body_parentid[b] else "",
            position=tuple(m.body_pos[b].tolist()),
            quaternion=tuple(m.body_quat[b].tolist()),
            joints=tuple(_joint(model, j) for j in range(m.njnt) if m.jnt_bodyid[j] == b),
            mass=float(m.body_mass[b]),
            com=tuple(m.body_ipos[b].tolist()),
            inertia=model.inertia(b),
        )
        for b in range(1, m.nbody)
    ]


def _joint(model: CompiledModel, j: int) -> Joint:
    m = model.data
    scalar = model.is_scalar(j)
    limited = scalar and m.jnt_limited[j] and not model.disabled("limit")
    return Joint(
        name=model.joint(j),
        kind=JointKind[model.joint_type(j)],
        axis=tuple(m.jnt_axis[j].tolist()),
        anchor=tuple(m.jnt_pos[j].tolist()),
        ref=float(m.qpos0[m.jnt_qposadr[j]]) if scalar else 0.0,
        lower=float(m.jnt_range[j, 0]) if limited else -math.inf,
        upper=float(m.jnt_range[j, 1]) if limited else math.inf,
    )


def _properties(model: CompiledModel) -> dict[str, JointProperties]:
    m = model.data
    found = {}
    for j in range(m.njnt):
        first, count = int(m.jnt_qposadr[j]), JointKind[model.joint_type(j)].nq
        dof = int(m.jnt_dofadr[j])
        damping, armature = drive_properties(model, j)
        found[model.joint(j)] = JointProperties(
            armature=float(m.dof_armature[dof]) + armature,
            damping=0.0 if model.disabled("damper") else float(m.dof_damping[dof]) + damping,
            stiffness=0.0 if model.disabled("spring") else float(m.jnt_stiffness[j]),
            dry_friction=float(m.dof_frictionloss[dof]) if model.is_scalar(j) and not model.disabled("frictionloss") else 0.0,
            spring_rest=m.qpos_spring[first : first + count].tolist(),
        )
    return found


def _gravity(model: CompiledModel) -> tuple[float, float, float]:
    x, y, z = (0.0, 0.0, 0.0) if model.disabled("gravity") else model.data.opt.gravity.tolist()
    if not all(map(math.isfinite, (x, y, z))):
        raise ModelError(f"gravity is {(x, y, z)}: must be finite", element="option")
    return x, y, z


def _keyframes(model: CompiledModel, articulation: Articulation, controls: list[int]) -> dict[str, Keyframe]:
    """Quaternions come out at unit norm; `controls`: where the control of each actuator that is modelled stands in MuJoCo's."""
    m: Any = model.data

    def tensor(values: Any) -> torch.Tensor:
        return torch.as_tensor(values.copy(), dtype=articulation.dtype, device=articulation.device)

    still = torch.zeros(articulation.nv, dtype=articulation.dtype, device=articulation.device)
    found = {}
    for k in range(model.keyframe_count):
        q = retract(articulation, tensor(m.key_qpos[k]), still)
        found[model.keyframe(k)] = Keyframe(q, tensor(m.key_qvel[k]), tensor(m.key_ctrl[k][controls]))
    return found
