"""Importing the library is quick: what makes it slow is imported where it is used. Times themselves are not compared here."""

from __future__ import annotations

import subprocess
import sys

HEAVY = ("scipy", "trimesh", "fcl", "mujoco", "matplotlib", "viser", "torchrl", "tensordict", "gymnasium", "typer", "rich", "PIL")


def test_importing_the_library_loads_no_compiled_core() -> None:
    code = "import pbfd_torch; from pbfd_torch.native import library; print(library._found.cache_info().currsize)"
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert ran.stdout.split() == ["0"]


def test_importing_the_library_leaves_heavy_modules_out() -> None:
    code = f"import sys, pbfd_torch; print(*(name for name in {HEAVY} if name in sys.modules))"
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert ran.stdout.split() == []
