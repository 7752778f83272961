"""The README's example runs as it stands, and its commands exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The Python blocks print solved steps, write the rollout that they name, print the derivative that they say, and show it."""
    example, derivative, shown = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(example.strip().splitlines()) <= 16
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "README.md", "exec"), {})
    assert re.search(r"100\.0% of the steps solved", capsys.readouterr().out)
    assert (tmp_path / "hopper.npz").stat().st_size > 10_000
    exec(compile(derivative, "README.md", "exec"), {})
    assert "slides 0.1699 m, by μ -0.5678 m" in capsys.readouterr().out
    exec(compile(shown, "README.md", "exec"), {})


def test_the_two_commands_are_in_the_makefile() -> None:
    """`make demo` and `make test` are targets."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for command in ("demo", "test"):
        assert f"make {command}" in README
        assert re.search(rf"^{command}:", makefile, re.MULTILINE)


def test_every_linked_file_exists() -> None:
    """Relative links and pictures of the README point at files of the repository."""
    prose = re.sub(r"```.*?```", "", README, flags=re.DOTALL)
    targets = [t for t in re.findall(r"\]\(([^)]+)\)", prose) if not t.startswith(("http", "#"))]
    assert targets
    assert [t for t in targets if not (ROOT / t).exists()] == []
