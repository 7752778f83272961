"""The compiled core as Python sees it: which variant is loaded, what it says of itself, and why there is none."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from pbfd_torch.errors import InputError
from pbfd_torch.native import library as native
from pbfd_torch.native.library import Library
from pbfd_torch.native.processor import LEVELS, levels, runnable
from tests.command import Pbfd, caller

DOUBLES = {"x86-64-v2": 2, "x86-64-v3": 4, "x86-64-v4": 8, "arm64": 2}
HERE = [target for target in runnable() if target in native.built()]  # what was built and runs here, the best one first

needs_library = pytest.mark.skipif(not HERE, reason="there is no native library")
pbfd = pytest.fixture(caller)


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every test finds the library anew, and leaves nothing of what it found."""
    monkeypatch.delenv(native.CHOICE, raising=False)
    native._found.cache_clear()
    yield
    native._found.cache_clear()


def a_library(folder: Path, code: str) -> None:
    """Makes the best variant of this processor, of other code, the only one."""
    (folder / "code.cpp").write_text(code)
    subprocess.run(["g++", "-shared", "-fPIC", "-o", folder / f"pbfd-{HERE[0]}.so", folder / "code.cpp"], check=True)


# What is loaded -----------------------------------------------------------------------------------------------------------


@needs_library
def test_the_best_variant_is_loaded() -> None:
    found = native.library()
    assert found is not None
    assert found.target == HERE[0]
    assert native.library() is found
    assert native.reason() == ""


@needs_library
def test_every_variant_says_what_it_is() -> None:
    """The target it is named after, the lanes of that target, the interface that Python knows."""
    for target in HERE:
        found = native.loaded(native.built()[target])
        assert isinstance(found, Library)
        assert found.target == target
        assert found.functions.pbfd_interface() == native.INTERFACE
        assert found.lanes(torch.float64) == DOUBLES[target]
        assert found.lanes(torch.float32) == 2 * DOUBLES[target]


@needs_library
def test_a_lower_variant_can_be_chosen() -> None:
    code = "from pbfd_torch.native.library import library; print(library().target)"
    environment = os.environ | {native.CHOICE: HERE[-1]}
    ran = subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True)
    assert ran.stdout.split() == [HERE[-1]]


@needs_library
def test_an_unknown_variant_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(native.CHOICE, "x86-64-v5")
    with pytest.raises(InputError, match=f"^PBFD_NATIVE_TARGET is 'x86-64-v5': must be one of {', '.join(HERE)}$"):
        native.library()


@needs_library
def test_many_threads_load_it_once(monkeypatch: pytest.MonkeyPatch) -> None:
    loads, loaded = [], native.loaded

    def counted(file: Path) -> Library | str:
        loads.append(file)
        return loaded(file)

    monkeypatch.setattr(native, "loaded", counted)
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda _: native.library(), range(64)))
    assert len(loads) == 1
    assert all(one is found[0] for one in found)


@needs_library
@pytest.mark.skipif(not (shutil.which("nm") and sys.platform == "linux"), reason="needs nm of Linux")
def test_nothing_but_the_interface_is_visible() -> None:
    """And nothing of torch and Python is asked for."""
    for file in native.built().values():
        listed = subprocess.run(["nm", "-D", "--defined-only", file], check=True, capture_output=True, text=True).stdout
        assert all(line.split()[-1].startswith("pbfd_") for line in listed.splitlines()), listed
        asked = subprocess.run(["nm", "-D", "--undefined-only", file], check=True, capture_output=True, text=True).stdout
        assert "Py" not in asked, asked
        assert "c10" not in asked, asked


# Why there is none --------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in the place of the built libraries."""
    monkeypatch.setattr(native, "FOLDER", tmp_path)
    return tmp_path


def test_not_built(folder: Path) -> None:
    assert native.library() is None
    assert native.reason() == f"the native library has not been built: {native.REMEDY}"


def test_without_a_compiler(folder: Path) -> None:
    """The installation's own words are passed on."""
    (folder / "none.txt").write_text("no C++ compiler was found when pbfd_torch was installed\n")
    assert native.library() is None
    assert native.reason().startswith("no C++ compiler was found when pbfd_torch was installed: install g++ and run pip install")


def test_damaged(folder: Path) -> None:
    (folder / f"pbfd-{runnable()[0]}.so").write_text("not a library")
    assert native.library() is None
    assert native.reason().startswith("the native library cannot be loaded (")


def test_none_that_runs_here(folder: Path) -> None:
    (folder / "pbfd-x86-64-v9.so").touch()
    assert native.library() is None
    assert native.reason().startswith("the native libraries that were built (x86-64-v9) do not run on this processor: ")


def test_a_processor_without_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "riscv64")
    assert native.library() is None
    assert native.reason() == "there is no native library for this processor (riscv64)"


@needs_library
@pytest.mark.skipif(not shutil.which("g++"), reason="needs g++")
def test_another_interface(folder: Path) -> None:
    """A library that was built from other sources is not used."""
    a_library(folder, 'extern "C" int pbfd_interface() { return 99; }')
    assert native.library() is None
    assert native.reason().startswith(
        f"the native library has interface 99, and this is pbfd_torch for interface {native.INTERFACE}"
    )


# The processor ------------------------------------------------------------------------------------------------------------


def cpuinfo(*names: str) -> list[str]:
    """The file of a processor with the flags of some levels."""
    return ["processor : 0\n", "flags\t\t: fpu sse2 " + " ".join(LEVELS[name] for name in names) + "\n", "flags\t\t:\n"]


def test_levels_of_a_processor() -> None:
    v2, v3, v4 = LEVELS
    assert levels(cpuinfo(v2, v3, v4)) == (v4, v3, v2)
    assert levels(cpuinfo(v2, v3)) == (v3, v2)
    assert levels(cpuinfo(v2, v4)) == (v2,)  # a level holds all below it
    assert levels(cpuinfo()) == ()
    assert levels([]) == ()


@needs_library
def test_the_compiler_agrees_with_linux(tmp_path: Path) -> None:
    """What the compiler's own look at the processor finds is what the levels say."""
    features = {"x86-64-v3": "avx2", "x86-64-v4": "avx512vl"}
    if HERE[-1] not in LEVELS or not shutil.which("g++"):
        pytest.skip("needs g++ on x86-64")
    asked = "".join(f'if (__builtin_cpu_supports("{name}")) std::puts("{level}");' for level, name in features.items())
    (tmp_path / "ask.cpp").write_text(f"#include <cstdio>\nint main() {{ {asked} }}")
    subprocess.run(["g++", "-o", tmp_path / "ask", tmp_path / "ask.cpp"], check=True)
    answer = subprocess.run([tmp_path / "ask"], check=True, capture_output=True, text=True).stdout.split()
    assert answer == [level for level in features if level in runnable()]


# `pbfd info` --------------------------------------------------------------------------------------------------------------


@needs_library
def test_info_names_the_library(pbfd: Pbfd) -> None:
    lanes = DOUBLES[HERE[0]]
    assert f"native library: {HERE[0]}, {lanes} lanes of float64\n" in pbfd("info", "hopper").out
    data = pbfd("info", "hopper", "--json").data["native_library"]
    assert data == {"target": HERE[0], "lanes": {"float64": lanes, "float32": 2 * lanes}, "reason": ""}


@needs_library
def test_info_names_the_engine(pbfd: Pbfd) -> None:
    assert "\nengine: native\n" in pbfd("info", "hopper").out
    data = pbfd("info", "hopper", "--json").data
    assert (data["engine"], data["engine_reason"]) == ("native", "")


def test_info_says_why_there_is_none(pbfd: Pbfd, folder: Path) -> None:
    assert f"native library: none: {native.reason()}\n" in pbfd("info", "hopper").out
    data = pbfd("info", "hopper", "--json").data["native_library"]
    assert data == {"target": None, "lanes": {}, "reason": native.reason()}
    assert f"\nengine: torch: {native.reason()}\n" in pbfd("info", "hopper").out
