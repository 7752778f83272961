"""What an MJCF file asks for and the simulation leaves out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pbfd_torch.loading.mjcf_model import CompiledModel, label
from pbfd_torch.loading.mjcf_unread import unread
from pbfd_torch.loading.report import listing


def left_out(model: CompiledModel) -> Iterator[str]:
    """One line a feature, with the names of what has it."""
    yield from _of_world(model)
    yield from _of_constraints(model)
    yield from _of_joints(model)
    yield from _of_contacts(model)
    yield from unread(model.sources)


def _named(what: str, names: list[str]) -> Iterator[str]:
    if names:
        yield f"{what} ({len(names)}): {listing(names)}"


def _of_world(model: CompiledModel) -> Iterator[str]:
    m = model.data
    if m.opt.density or m.opt.viscosity or np.any(m.opt.wind):
        yield "fluid forces (density, viscosity, wind)"
    yield from _named("gravity compensation", [model.body(b) for b in range(m.nbody) if m.body_gravcomp[b]])
    yield from _named("mocap bodies stand still", [model.body(b) for b in range(m.nbody) if m.body_mocapid[b] >= 0])
    if m.nflex:
        yield f"deformable bodies ({m.nflex})"
    if m.nplugin:
        yield f"plugins ({m.nplugin})"


def _of_constraints(model: CompiledModel) -> Iterator[str]:
    m = model.data
    if not model.disabled("equality"):
        by_type: dict[str, list[str]] = {}
        for e in range(m.neq):
            if m.eq_active0[e]:
                by_type.setdefault(label("mjtEq", m.eq_type[e]), []).append(model.equality(e))
        for kind, names in by_type.items():
            yield from _named(f"equality constraints, type {kind}", names)
    pulling = [m.tendon_stiffness, m.tendon_damping, m.tendon_frictionloss, m.tendon_limited, m.tendon_armature]
    yield from _named("tendons", [model.tendon(t) for t in range(m.ntendon) if any(x[t] for x in pulling)])


def _of_joints(model: CompiledModel) -> Iterator[str]:
    m = model.data
    joints = range(m.njnt)
    turning = [j for j in joints if not model.is_scalar(j)]
    dof = m.jnt_dofadr

    def of_actuator(values: Any, j: int) -> bool:
        """Whether the actuator that adds damping and armature to a joint, if there is one, has such a value."""
        return m.jnt_actuatorid[j] >= 0 and bool(np.any(values[m.jnt_actuatorid[j]]))

    features = {
        "limits of ball joints": [j for j in turning if m.jnt_limited[j]],
        "friction loss of ball and free joints": [j for j in turning if m.dof_frictionloss[dof[j]]],
        "springs that are not linear": [j for j in joints if np.any(m.jnt_stiffnesspoly[j])],
        "springs that yield": [j for j in joints if m.jnt_springyield[j]],
        "damping that is not linear": [
            j for j in joints if np.any(m.dof_dampingpoly[dof[j]]) or of_actuator(m.actuator_dampingpoly, j)
        ],
        "armature and damping of actuators on ball and free joints": [
            j for j in turning if of_actuator(m.actuator_armature, j) or of_actuator(m.actuator_damping, j)
        ],
    }
    for feature, found in features.items():
        yield from _named(feature, [model.joint(j) for j in found])


def _of_contacts(model: CompiledModel) -> Iterator[str]:
    m = model.data
    if model.disabled("contact"):
        return
    moving = [p for p, (a, b) in enumerate(model.pairs) if not model.standing[m.geom_bodyid[[a, b]]].all()]
    if moving:
        yield "friction of contact pairs: that of their geoms is used"
    yield from _named("contact pairs of bodies that are joined or excluded", [model.pair(p) for p in moving if _barred(model, p)])
    if model.disabled("filterparent"):
        yield "contact between a body and its parent (filterparent is off)"
    colliding = [g for g in range(m.ngeom) if m.geom_contype[g] or m.geom_conaffinity[g]]
    for what, mark in {
        "torsional and rolling friction (condim 4, 6)": m.geom_condim > 3,
        "surface velocity": m.geom_surfacevel.any(1),
        "adhesion": m.geom_adhesion != 0,
    }.items():
        yield from _named(what, [model.geom(g) for g in colliding if mark[g]])


def _barred(model: CompiledModel, p: int) -> bool:
    """Whether the bodies of an explicit pair do not touch by other rules, which MuJoCo then does not ask."""
    m = model.data
    one, other = (int(m.geom_bodyid[g]) for g in model.pairs[p])
    if {(one, other), (other, one)} & set(model.excludes):
        return True
    one, other = int(m.body_weldid[one]), int(m.body_weldid[other])
    above = [int(m.body_weldid[m.body_parentid[b]]) for b in (one, other)]
    return one == other or bool(one and other and (above[0] == other or above[1] == one))
