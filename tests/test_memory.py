"""How much memory there is, as machines and containers say it."""

from __future__ import annotations

from pathlib import Path

import pytest

from pbfd_torch import InputError, memory


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with 8 GiB available, in no container."""
    (tmp_path / "meminfo").write_text("MemTotal:       16777216 kB\nMemFree:          100000 kB\nMemAvailable:    8388608 kB\n")
    monkeypatch.setattr(memory, "_MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "_GROUP", tmp_path)
    return tmp_path


def test_half_of_what_is_available(machine: Path) -> None:
    assert memory.available() == 2**33
    assert memory.share() == 2**32
    assert memory.most_worlds() == 2**32 // memory.LEAST_OF_A_WORLD


def test_a_container_may_have_less(machine: Path) -> None:
    """Its limit less what it uses; "max" is no limit."""
    (machine / "memory.max").write_text("3000000\n")
    (machine / "memory.current").write_text("1000000\n")
    assert memory.available() == 2_000_000
    (machine / "memory.max").write_text("max\n")
    assert memory.available() == 2**33


def test_a_system_without_that_file(machine: Path) -> None:
    """All the memory that the machine has, or 8 GiB where nothing says it."""
    (machine / "meminfo").unlink()
    assert memory.available() >= 2**28


@pytest.mark.parametrize("worlds", [0, -1, 10**12, 2.5])
def test_worlds_without_room_are_refused(machine: Path, worlds: float) -> None:
    with pytest.raises(
        InputError, match=f"worlds is {worlds}: must be from 1 to 262144, which have 16 KiB each in half of .*4 GiB"
    ):
        memory.require_room("worlds", worlds)
    memory.require_room("worlds", 262144)
