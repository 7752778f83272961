"""Actuators of an MJCF file."""

from __future__ import annotations

import math
from typing import Any

from pbfd_torch.loading.mjcf_model import CompiledModel, label
from pbfd_torch.loading.report import listing
from pbfd_torch.terms.actuators import Actuator


def mjcf_actuators(model: CompiledModel) -> tuple[list[Actuator], list[int], list[str]]:
    """The actuators that can be modelled, the place of each one's control in MuJoCo's, and lines on the others."""
    m = model.data
    if model.disabled("actuation"):
        return [], [], []
    reasons = [_obstacle(model, a) for a in range(m.nactuator)]
    usable = [a for a, reason in enumerate(reasons) if not reason]
    by_reason: dict[str, list[str]] = {}
    for a, reason in enumerate(reasons):
        if reason:
            by_reason.setdefault(reason, []).append(model.actuator(a))
    lines = [f"actuators with {reason} ({len(names)}), they do nothing: {listing(names)}" for reason, names in by_reason.items()]
    total = _total_force_ranges(model, usable, lines)
    return [_actuator(model, a, total) for a in usable], [int(m.actuator_ctrladr[a]) for a in usable], lines


def drive_properties(model: CompiledModel, j: int) -> tuple[float, float]:
    """Damping and armature that an actuator adds to a hinge or slide joint: its own times the gear squared."""
    m = model.data
    a = int(m.jnt_actuatorid[j])
    if a < 0 or not model.is_scalar(j):
        return 0.0, 0.0
    gear = _gear(m, a)
    return float(m.actuator_damping[a]) * gear**2, float(m.actuator_armature[a]) * gear**2


def _gear(m: Any, a: int) -> float:
    return float(m.actuator_gear[m.actuator_outadr[a], 0])


def _obstacle(model: CompiledModel, a: int) -> str:
    """Why an actuator cannot be modelled, or ""."""
    m = model.data
    transmission = label("mjtTrn", m.actuator_trntype[a])
    bias = label("mjtBias", m.actuator_biastype[a])
    if m.actuator_plugin[a] >= 0:
        return "a plugin"
    if transmission not in ("joint", "jointinparent"):
        return f"transmission {transmission}"
    if not model.is_scalar(int(m.actuator_trnid[a, 0])):
        return "a ball or free joint"
    if label("mjtDyn", m.actuator_dyntype[a]) != "none":
        return "activation dynamics"
    if m.actuator_delay[a] > 0:
        return "a delay"
    if label("mjtGain", m.actuator_gaintype[a]) != "fixed" or m.actuator_ctrlnum[a] != 1:
        return "a gain that is not fixed"
    if bias == "none":
        return ""
    if bias != "affine":
        return "a bias that is not affine"
    return "a bias that pushes away (negative stiffness or damping)" if (m.actuator_biasprm[a, 1:3] > 0).any() else ""


def _actuator(model: CompiledModel, a: int, total: dict[int, tuple[float, float]]) -> Actuator:
    m = model.data
    bias = m.actuator_biasprm[a, :3].tolist() if label("mjtBias", m.actuator_biastype[a]) == "affine" else [0.0, 0.0, 0.0]
    limited = m.actuator_ctrllimited[m.actuator_ctrladr[a]] and not model.disabled("clampctrl")
    low, high = m.actuator_forcerange[a].tolist() if m.actuator_forcelimited[a] else (-math.inf, math.inf)
    low_total, high_total = total.get(a, (-math.inf, math.inf))
    return Actuator(
        name=model.actuator(a),
        joint=model.joint(int(m.actuator_trnid[a, 0])),
        gear=_gear(m, a),
        gain=float(m.actuator_gainprm[a, 0]),
        bias=bias[0],
        stiffness=-bias[1],
        damping=-bias[2],
        control_range=tuple(m.actuator_ctrlrange[m.actuator_ctrladr[a]].tolist()) if limited else (-math.inf, math.inf),
        force_range=(max(low, low_total), min(high, high_total)),
    )


def _total_force_ranges(model: CompiledModel, usable: list[int], lines: list[str]) -> dict[int, tuple[float, float]]:
    """A joint's limit on its total actuator force, as a limit before the gear of the actuator where there is only one."""
    m = model.data
    ranges = {}
    shared = []
    for j in range(m.njnt):
        here = [a for a in usable if m.actuator_trnid[a, 0] == j]
        if m.jnt_actfrclimited[j] and len(here) == 1 and _gear(m, here[0]):
            low, high = sorted((m.jnt_actfrcrange[j] / _gear(m, here[0])).tolist())
            ranges[here[0]] = (low, high)
        elif m.jnt_actfrclimited[j] and here:
            shared.append(model.joint(j))
    if shared:
        lines.append(f"actuatorfrcrange of joints with several actuators ({len(shared)}): {listing(shared)}")
    return ranges
