"""What installations hold: sources in an sdist, and no libraries, but a reason, where nothing could be compiled."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from pbfd_torch.native.processor import LEVELS, runnable

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "pbfd_torch" / "native" / "src"


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what an installation is made of, without built libraries."""
    copy = tmp_path_factory.mktemp("native") / "checkout"
    copy.mkdir()
    for name in ("pbfd_torch", "envs", "models", "solvers"):
        shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("lib", "__pycache__"))
    for name in ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    return copy


def build(checkout: Path, what: str) -> tuple[Path, str]:
    """The sdist or wheel that pip would build without a compiler, and what was said."""
    code = f"import setuptools.build_meta as backend; print(backend.build_{what}('dist'))"
    environment = os.environ | {"CXX": "/bin/false", "PBFD_NATIVE_STRICT": "0"}
    ran = subprocess.run([sys.executable, "-c", code], cwd=checkout, env=environment, check=True, capture_output=True, text=True)
    return checkout / "dist" / ran.stdout.split()[-1], ran.stdout + ran.stderr


def test_the_sdist_holds_the_sources(checkout: Path) -> None:
    file, _ = build(checkout, "sdist")
    with tarfile.open(file) as archive:
        names = {Path(*Path(name).parts[1:]) for name in archive.getnames()}
    assert {source.relative_to(ROOT) for source in SOURCES.iterdir()} < names
    assert Path("setup.py") in names


def test_an_installation_without_a_compiler(checkout: Path, tmp_path: Path) -> None:
    """It succeeds, says so while it is made, holds no library, and says why when asked."""
    said = "the native core could not be compiled when pbfd_torch was installed: /bin/false failed: exit status 1"
    wheel, output = build(checkout, "wheel")
    assert f"{said}. The installation goes on without the native core." in output
    assert wheel.name.startswith("pbfd_torch-0.1.0-py3-none-")
    assert not wheel.name.endswith("-any.whl")
    with zipfile.ZipFile(wheel) as archive:
        assert [name for name in archive.namelist() if "/native/lib/" in name] == ["pbfd_torch/native/lib/none.txt"]
    site = str(tmp_path / "site")
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", site, wheel], check=True)
    code = "from pbfd_torch.native import library; print(library.__file__, library.library(), library.reason(), sep='\\n')"
    ran = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": site},
        check=True,
        capture_output=True,
        text=True,
    )
    file, library, reason = ran.stdout.splitlines()
    assert Path(file).is_relative_to(tmp_path)
    assert library == "None"
    assert reason.startswith(f"{said}: install g++ and run pip install again")


def refused(checkout: Path, **environment: str) -> str:
    """What an installation says that fails, as strict ones do."""
    command, asked = [sys.executable, "setup.py", "build_ext"], os.environ | {"PBFD_NATIVE_STRICT": "1"} | environment
    ran = subprocess.run(command, cwd=checkout, env=asked, check=False, capture_output=True, text=True)
    assert ran.returncode != 0
    return ran.stderr


def test_strict_installations_fail(checkout: Path) -> None:
    """Continuous integration asks for that."""
    assert "error: the native core could not be compiled" in refused(checkout, CXX="/bin/false")


def test_which_variants_are_made(checkout: Path) -> None:
    """The one for this processor where sources are worked on, all of them in a wheel, or those that are asked for."""

    def tried(*command: str, targets: str = "") -> list[str]:
        environment = os.environ | {"CXX": "/bin/false", "PBFD_NATIVE_STRICT": "0", "PBFD_NATIVE_TARGETS": targets}
        code = [sys.executable, "setup.py", "-v", "build_ext", *command]
        ran = subprocess.run(code, cwd=checkout, env=environment, check=True, capture_output=True, text=True)
        said = (ran.stdout + ran.stderr).splitlines()
        return [line.split("native core for ")[1].split(":")[0] for line in said if "native core for " in line]

    assert tried("--inplace") == [runnable()[0]]
    assert sorted(tried()) == sorted(runnable() if runnable() == ("arm64",) else LEVELS)
    assert tried(targets=runnable()[-1]) == [runnable()[-1]]


def test_variants_that_do_not_exist(checkout: Path) -> None:
    assert "PBFD_NATIVE_TARGETS names x86-64-v5: some of " in refused(checkout, PBFD_NATIVE_TARGETS="x86-64-v5")
