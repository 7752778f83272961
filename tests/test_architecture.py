"""The rooms: what may import what, no circles, and files that can be read."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"pbfd_torch": "pbfd_torch", "pbfd_torch.envs": "envs", "pbfd_torch.models": "models", "pbfd_torch.solvers": "solvers"}
MOST_LINES = 400
MOST_LAYERS = 12


def files(folder: Path) -> Iterator[Path]:
    """The Python files below a folder, those behind symlinks left out."""
    for file in sorted(folder.rglob("*.py")):
        if not any(parent.is_symlink() for parent in file.parents):
            yield file


@cache
def modules() -> dict[str, Path]:
    """Every module of the package and its file."""
    found = {}
    for package, folder in PACKAGES.items():
        for file in files(ROOT / folder):
            parts = file.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join((package, *(part for part in parts if part != "__init__")))] = file
    return found


def imported(file: Path) -> Iterator[str]:
    """The modules of the package that a file imports, wherever in it that is written."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names if name.name in modules())
        elif isinstance(node, ast.ImportFrom) and node.module in modules():
            for name in node.names:
                inner = f"{node.module}.{name.name}"
                yield inner if inner in modules() else str(node.module)


@cache
def imports() -> dict[str, frozenset[str]]:
    """What every module imports of the package."""
    return {name: frozenset(imported(file)) - {name} for name, file in modules().items()}


def room(module: str) -> str:
    """The package, or the module at the root, that a module belongs to."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


@cache
def layers() -> dict[str, int]:
    """The layer of every room, as `docs/ARCHITECTURE.md` has it."""
    found: dict[str, int] = {}
    for line in (ROOT / "docs/ARCHITECTURE.md").read_text().splitlines():
        if row := re.match(r"\| (\d+) \| (`.*?) \|", line):
            found |= dict.fromkeys(re.findall(r"`(\w+)`", row[2]), int(row[1]))
    return found


def circle(graph: dict[str, frozenset[str]]) -> list[str]:
    """A way from a module back to itself; empty where there is none."""
    done: set[str] = set()

    def walk(module: str, way: list[str]) -> list[str]:
        if module in way:
            return [*way[way.index(module) :], module]
        if module not in done:
            for other in sorted(graph[module]):
                if found := walk(other, [*way, module]):
                    return found
            done.add(module)
        return []

    return next((found for module in sorted(graph) if (found := walk(module, []))), [])


def test_every_room_has_a_layer() -> None:
    assert {room(name) for name in modules()} == set(layers())
    assert max(layers().values()) <= MOST_LAYERS


def test_no_import_goes_up() -> None:
    """Between rooms every import leads to a lower layer, so no chain of rooms is longer than there are layers."""
    wrong = [
        f"{name} ({layers()[room(name)]}) imports {other} ({layers()[room(other)]})"
        for name, others in imports().items()
        for other in sorted(others)
        if room(name) != room(other) and layers()[room(name)] <= layers()[room(other)]
    ]
    assert not wrong, "\n".join(wrong)


def test_no_circles() -> None:
    assert not circle(imports())


def test_a_circle_is_found() -> None:
    graph = {"a": frozenset({"b"}), "b": frozenset({"c"}), "c": frozenset({"b"}), "d": frozenset()}
    assert circle(graph) == ["b", "c", "b"]
    assert not circle(graph | {"c": frozenset({"d"})})


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_rooms_say_what_they_are(package: str) -> None:
    """Every package has a docstring, one paragraph long."""
    for file in files(ROOT / PACKAGES[package]):
        if file.name == "__init__.py" and "tasks" not in file.parts:
            words = ast.get_docstring(ast.parse(file.read_text()))
            assert words, file
            assert "\n\n" not in words, file


def test_no_file_is_too_long() -> None:
    folders = (*PACKAGES.values(), "tests", "benchmarks", "notebooks")
    lengths = {str(file.relative_to(ROOT)): len(file.read_text().splitlines()) for name in folders for file in files(ROOT / name)}
    assert not {name: length for name, length in lengths.items() if length > MOST_LINES}
