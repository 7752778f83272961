"""`pbfd info`: what is in a robot file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.errors import InputError
from pbfd_torch.loading import Robot, load_robot
from pbfd_torch.models import SCENES
from pbfd_torch.models.robots import robot_setup
from pbfd_torch.native.library import library, reason
from pbfd_torch.simulator import Simulator
from pbfd_torch.terms.joint_springs import Armature, JointDamping


def run(file: str, free_base: bool | None, as_json: bool) -> None:
    """Prints the contents of a file, or the file behind a named scene."""
    if file in SCENES:
        shipped = Path(__file__).parent.parent / "models" / f"{file}.xml"
        if not shipped.exists():
            raise InputError(f"'{file}' is a scene made in code: give a URDF or MJCF file")
        file = str(shipped)
    robot = load_robot(file, free_base=free_base)
    contents = describe(robot) | {"native_library": _native_library()} | _engine(robot)
    if as_json:
        print(json.dumps(contents))
    else:
        _print(contents)


def describe(robot: Robot) -> dict[str, Any]:
    """Everything that `pbfd info` says, as plain data."""
    a = robot.articulation
    t = a.topology
    kinds = {(7, 6): "free", (4, 3): "ball"}
    joints = [
        {
            "name": name,
            "kind": kinds.get(t.joint_sizes[j], "hinge" if t.joint_is_hinge[j] else "slide"),
            "link": a.link_names[t.joint_link[j]],
            "range": [_finite(a.lower[t.v_start[j]]), _finite(a.upper[t.v_start[j]])],
            "armature": _coefficient(robot, Armature, "inertia", t.v_start[j]),
            "damping": _coefficient(robot, JointDamping, "damping", t.v_start[j]),
        }
        for j, name in enumerate(a.joint_names)
    ]
    links = [
        {
            "name": name,
            "parent": a.link_names[t.link_parent[k]] if t.link_parent[k] >= 0 else "",
            "mass_kg": float(a.mass[k]),
            "shapes": [type(c.shape).__name__ for c in robot.colliders if c.link == name],
        }
        for k, name in enumerate(a.link_names)
    ]
    return {
        "name": robot.name,
        "nq": a.nq,
        "nv": a.nv,
        "nu": robot.actuators.nu if robot.actuators else 0,
        "mass_kg": float(a.mass.sum()),
        "gravity_m_s2": list(robot.gravity),
        "links": links,
        "joints": joints,
        "actuators": list(robot.actuators.names) if robot.actuators else [],
        "unlimited_actuators": _unlimited(robot),
        "obstacles": [_obstacle(x) for x in robot.obstacles],
        "keyframes": list(robot.keyframes),
        "terms": [type(term).__name__ for term in robot.joint_terms],
        "not_modelled": list(robot.not_modelled),
    }


def _unlimited(robot: Robot) -> list[str]:
    """Actuators whose force nothing bounds."""
    if robot.actuators is None:
        return []
    largest = robot.actuators.largest(robot.articulation).tolist()
    return [name for name, force in zip(robot.actuators.names, largest, strict=True) if math.isinf(force)]


def _obstacle(obstacle: HalfSpace | Obstacle) -> dict[str, Any]:
    if isinstance(obstacle, HalfSpace):
        return {"name": obstacle.name, "shape": "HalfSpace", "normal": list(obstacle.normal), "offset_m": obstacle.offset}
    position = torch.as_tensor(obstacle.position, dtype=torch.float64).tolist()
    return {"name": obstacle.name, "shape": type(obstacle.shape).__name__, "position_m": position}


def _native_library() -> dict[str, Any]:
    """The compiled core: its target and how many worlds a register holds, or why there is none."""
    found = library()
    lanes = {str(dtype).removeprefix("torch."): found.lanes(dtype) for dtype in (torch.float64, torch.float32)} if found else {}
    return {"target": found and found.target, "lanes": lanes, "reason": reason()}


def _engine(robot: Robot) -> dict[str, Any]:
    """What makes the robot's steps, and why they are not compiled, if they are not."""
    setup = robot_setup(robot)
    simulator: Simulator[Any] = Simulator(setup.scene, setup.dt)
    return {"engine": simulator.engine, "engine_reason": simulator.engine_reason}


def _finite(value: torch.Tensor) -> float | None:
    return float(value) if bool(torch.isfinite(value)) else None


def _coefficient(robot: Robot, kind: type, field: str, dof: int) -> float:
    return sum(float(getattr(term, field)[dof]) for term in robot.joint_terms if isinstance(term, kind))


def _written(values: Sequence[float]) -> str:
    """Numbers as people write them: «[0, 0, -9.81]»."""
    return f"[{', '.join(f'{x:.6g}' for x in values)}]"


def _table(*headers: str) -> Table:
    """A table that breaks long names where it has to, and never drops a part of them."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold cyan")
    for header in headers:
        table.add_column(header, overflow="fold")
    return table


def _print(contents: dict[str, Any]) -> None:
    print(
        f"{contents['name']}: {len(contents['links'])} links, {contents['nv']} degrees of freedom, {contents['nu']} actuators, "
        f"{contents['mass_kg']:.6g} kg, gravity {_written(contents['gravity_m_s2'])}\n"
    )
    links = _table("link", "parent", "mass [kg]", "shapes")
    for x in contents["links"]:
        links.add_row(x["name"], x["parent"] or "world", f"{x['mass_kg']:.6g}", ", ".join(x["shapes"]))
    joints = _table("joint", "kind", "link", "range", "armature", "damping")
    for x in contents["joints"]:
        low, high = x["range"]
        limits = (
            ""
            if low is None and high is None
            else f"{-float('inf') if low is None else low:.4g} … {float('inf') if high is None else high:.4g}"
        )
        joints.add_row(x["name"], x["kind"], x["link"], limits, f"{x['armature']:.4g}", f"{x['damping']:.4g}")
    Console(markup=False, emoji=False).print(links, "", joints, "", sep="\n")
    for key in ("actuators", "keyframes", "terms"):
        print(f"{key}: {', '.join(contents[key]) or 'none'}")
    if unlimited := contents["unlimited_actuators"]:
        print(
            f"without a largest force: {', '.join(unlimited)}\n"
            "  (contacts are not made firm enough for them: watch too_deep_steps, or give ctrlrange, forcerange or effort)"
        )
    for obstacle in contents["obstacles"]:
        place = (
            f"at {obstacle['offset_m']:.4g} m along {_written(obstacle['normal'])}"
            if "normal" in obstacle
            else f"at {_written(obstacle['position_m'])}"
        )
        print(f"obstacle: {obstacle['name']}, {obstacle['shape']} {place}")
    native = contents["native_library"]
    print(
        "native library:",
        f"{native['target']}, {native['lanes']['float64']} lanes of float64" if native["target"] else f"none: {native['reason']}",
    )
    print("engine:", contents["engine"] + (f": {contents['engine_reason']}" if contents["engine_reason"] else ""))
    print("not modelled:" + ("".join(f"\n  {line}" for line in contents["not_modelled"]) or " nothing"))
