"""Files that appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from pbfd_torch.files import whole_file, write_whole


def test_a_file_gets_its_name_when_it_is_whole(tmp_path: Path) -> None:
    """Folders are made; until the end the old file is there, and nothing else that can be seen."""
    path = tmp_path / "new" / "a.txt"
    write_whole(path, "old")
    with whole_file(path) as file:
        file.write(b"new")
        assert path.read_text() == "old"
        assert [x.name for x in path.parent.iterdir() if not x.name.startswith(".")] == ["a.txt"]
    assert path.read_text() == "new"
    assert len(list(path.parent.iterdir())) == 1


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, SystemExit])
def test_an_interruption_leaves_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "a.bin"
    write_whole(path, b"old")

    def fail() -> None:
        with whole_file(path) as file:
            file.write(b"half")
            raise error

    with pytest.raises(error):
        fail()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_is_the_systems_error(tmp_path: Path) -> None:
    write_whole(tmp_path / "file", b"")
    for path in (tmp_path, tmp_path / "file" / "a.txt", tmp_path / ("x" * 300)):
        with pytest.raises(OSError, match=r"."):
            write_whole(path, "text")
    assert sorted(x.name for x in tmp_path.iterdir()) == ["file"]
    write_whole(tmp_path / ("y" * 250), "long")
