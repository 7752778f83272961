"""The package list, the symlinks and the import rules that let one tree serve as checkout, editable install, wheel and sdist."""

from __future__ import annotations

import ast
import importlib
import os
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
MAPPED = ("envs", "models", "solvers")
PACKAGED = ("pbfd_torch", *MAPPED)
CODE = (*PACKAGED, "tests", "benchmarks")


def folders(top: str) -> Iterator[Path]:
    """The folders below and including `top`, symlinks left out."""
    for folder, _, _ in os.walk(ROOT / top):
        yield Path(folder)


@pytest.fixture(scope="module")
def pyproject() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture(scope="module")
def modules() -> dict[Path, ast.Module]:
    files = sorted(file for top in CODE for folder in folders(top) for file in folder.glob("*.py"))
    return {file.relative_to(ROOT): ast.parse(file.read_text()) for file in files}


def test_every_package_is_listed(pyproject: dict[str, Any]) -> None:
    inside = [folder for top in PACKAGED for folder in folders(top) if (folder / "__init__.py").exists()]
    names = [".".join(folder.relative_to(ROOT).parts) for folder in inside]
    full = [name if name.startswith("pbfd_torch") else f"pbfd_torch.{name}" for name in names]
    assert sorted(pyproject["tool"]["setuptools"]["packages"]) == sorted(full)


def test_every_folder_with_code_is_a_package() -> None:
    with_code = [folder for top in PACKAGED for folder in folders(top) if any(folder.glob("*.py"))]
    assert [str(folder) for folder in with_code if not (folder / "__init__.py").exists()] == []


def test_mapped_folders(pyproject: dict[str, Any]) -> None:
    expected = {"pbfd_torch": "pbfd_torch"} | {f"pbfd_torch.{name}": name for name in MAPPED}
    assert pyproject["tool"]["setuptools"]["package-dir"] == expected


def test_symlinks_are_relative() -> None:
    links = {entry.name: os.readlink(entry) for entry in (ROOT / "pbfd_torch").iterdir() if entry.is_symlink()}
    assert links == {name: f"../{name}" for name in MAPPED}


@pytest.mark.parametrize("name", MAPPED)
def test_mapped_folder_is_the_package(name: str) -> None:
    file = importlib.import_module(f"pbfd_torch.{name}").__file__
    assert file is not None
    assert Path(file).resolve() == ROOT / name / "__init__.py"


def test_no_relative_imports(modules: dict[Path, ast.Module]) -> None:
    nodes = [(file, node) for file, tree in modules.items() for node in ast.walk(tree)]
    assert [f"{file}:{node.lineno}" for file, node in nodes if isinstance(node, ast.ImportFrom) and node.level] == []


def test_mapped_folders_are_imported_only_by_their_full_name(modules: dict[Path, ast.Module]) -> None:
    found = []
    for file, tree in modules.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            else:
                continue
            found += [f"{file}:{node.lineno}: {name}" for name in names if name.split(".")[0] in MAPPED]
    assert found == []


def test_tested_versions_are_within_the_ranges(pyproject: dict[str, Any]) -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    pins = {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}
    project = pyproject["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    for requirement in (Requirement(text) for group in groups for text in group):
        assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), requirement
