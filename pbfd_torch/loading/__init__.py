"""Robot files in: URDF and MJCF become a scene. Imports `scene`, `terms`, `contact`, `looks` and what lies below; it makes no
steps."""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch

from pbfd_torch.errors import InputError, ModelError
from pbfd_torch.loading.mjcf import load_mjcf
from pbfd_torch.loading.report import existing_file
from pbfd_torch.loading.robot import Keyframe, Robot
from pbfd_torch.loading.srdf import load_srdf_exclusions
from pbfd_torch.loading.urdf import load_urdf
from pbfd_torch.loading.xml_file import read_xml

__all__ = ["Keyframe", "Robot", "load_mjcf", "load_robot", "load_srdf_exclusions", "load_urdf"]


def load_robot(
    path: str | os.PathLike[str],
    *,
    free_base: bool | None = None,
    excluded: Sequence[tuple[str, str]] = (),
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Robot:
    """Loads a URDF file (.urdf, or .xml with root <robot>) or an MJCF file (.xml or .mjcf with root <mujoco>).

    `free_base` and `excluded`, URDF only: see `load_urdf`; an MJCF file says itself what is free and what never touches. Raises
    `ModelError` naming the file and the element that cannot be used or is too large (`loading.bounds`), and `InputError` for these
    two with MJCF and for a device that is not there. What the file asks for and the simulation leaves out is in
    `Robot.not_modelled`, and given as `NotModelledWarning`.
    """
    _require_device(device)
    file = existing_file(path)
    suffix = file.suffix.lower()
    if suffix not in (".urdf", ".xml", ".mjcf"):
        hint = "; expand it with the xacro command first" if suffix == ".xacro" else ""
        raise ModelError(f"extension '{file.suffix}' is not known: must be .urdf, .xml or .mjcf{hint}", file=str(file))
    root = "robot" if suffix == ".urdf" else read_xml(file).tag
    if root == "robot":
        return load_urdf(file, free_base=free_base, excluded=excluded, dtype=dtype, device=device)
    if root != "mujoco":
        raise ModelError(f"root element is <{root}>: must be <robot> (URDF) or <mujoco> (MJCF)", file=str(file))
    if free_base is not None:
        raise InputError(f"free_base is {free_base}: an MJCF file says itself what is free (<freejoint/>), leave it out")
    if excluded:
        raise InputError("excluded is given: an MJCF file says itself what never touches (<exclude/>), leave it out")
    return load_mjcf(file, dtype=dtype, device=device)


def _require_device(device: torch.device | str) -> None:
    """Raises `InputError` for a device that is not there, with those that are."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError):  # as torch was built without it, found none or knows no such name
        there = ", ".join(["cpu", *(f"cuda:{k}" for k in range(torch.cuda.device_count()))])
        raise InputError(f"device is '{device}': must be one that is there, of {there}") from None
