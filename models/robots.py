"""Scenes made from robot files: our own hopper, walker and quadruped, and any URDF or MJCF file."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from pbfd_torch.errors import InputError
from pbfd_torch.loading import Robot, load_robot
from pbfd_torch.loading.scene import ground_below, robot_scene
from pbfd_torch.models.setup import Setup, repeated

_HERE = Path(__file__).parent


def robot_setup(robot: Robot, worlds: int = 1, duration: float = 2.0, keyframe: str | None = None) -> Setup:
    """The robot at its rest configuration without control, or in a named state of its file, whose control is held. A robot that
    can fall and whose file holds no obstacle gets level ground just below it. Raises `InputError` for an unknown keyframe."""
    free = any(size == (7, 6) for size in robot.articulation.topology.joint_sizes)
    notes = [f"not modelled: {line}" for line in robot.not_modelled]
    obstacles = robot.obstacles
    if free and not obstacles and robot.colliders and any(robot.gravity):
        obstacles = (ground_below(robot),)
        notes.append(f"the file has no ground: a level one was added at z = {obstacles[0].offset:.4g} m")
    scene = robot_scene(robot, obstacles)
    if keyframe is None:
        q = repeated(robot.articulation.rest, worlds)
        return Setup(scene, q, q.new_zeros(worlds, robot.articulation.nv), duration, 0.008, notes=notes)
    if keyframe not in robot.keyframes:
        raise InputError(f"no keyframe named '{keyframe}': the keyframes are {', '.join(robot.keyframes) or 'none'}")
    key = robot.keyframes[keyframe]
    q, v = repeated(key.q, worlds), repeated(key.v, worlds)
    return Setup(scene, q, v, duration, 0.008, notes=notes, control=key.control)


def file_setup(
    path: str | os.PathLike[str],
    worlds: int = 1,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
    free_base: bool | None = None,
    keyframe: str | None = None,
) -> Setup:
    """Setup of a URDF or MJCF file; raises `ModelError` as `load_robot` does, and `InputError` for an unknown keyframe."""
    return robot_setup(load_robot(path, free_base=free_base, dtype=dtype, device=device), worlds, keyframe=keyframe)


def hopper(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """A planar one-legged hopper, dropped onto its foot and left to itself."""
    return file_setup(_HERE / "hopper.xml", worlds, dtype, device)


def walker(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """A planar two-legged walker, dropped onto its feet and left to itself."""
    return file_setup(_HERE / "walker.xml", worlds, dtype, device)


def quadruped(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """A robot dog of 12 hinges, dropped onto its feet, whose position servos hold its stance."""
    return file_setup(_HERE / "quadruped.xml", worlds, dtype, device, keyframe="stance")
