"""Where the robot files are that Gymnasium brings along."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest


def gymnasium_file(name: str) -> Path:
    """A robot file of Gymnasium, found without importing it; skips the test where Gymnasium is missing."""
    spec = importlib.util.find_spec("gymnasium")
    if spec is None or spec.origin is None:
        pytest.skip("gymnasium, whose robots this test loads, is not installed")
    return Path(spec.origin).parent / "envs" / "mujoco" / "assets" / f"{name}.xml"
