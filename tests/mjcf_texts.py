"""Small MJCF files that tests write, and robots of them."""

from __future__ import annotations

import warnings
from pathlib import Path

from pbfd_torch.errors import NotModelledWarning
from pbfd_torch.loading import Robot, load_robot

BODY = "<body name='b'><joint name='j'/><geom name='g' size='1'/></body>"


def write(folder: Path, bodies: str, more: str = "") -> Path:
    file = folder / "robot.xml"
    file.write_text(f"<mujoco>\n<worldbody>\n{bodies}\n</worldbody>\n{more}\n</mujoco>")
    return file


def loaded(folder: Path, bodies: str = BODY, more: str = "") -> Robot:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotModelledWarning)
        return load_robot(write(folder, bodies, more))
