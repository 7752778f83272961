"""The `pbfd` command as tests call it: how a call ends, and what is often given to it."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.printed import Printed, called

ROOT = Path(__file__).parent.parent
ARM = Path(__file__).parent / "data" / "arm_description" / "arm.urdf"
HOPPER = ROOT / "models" / "hopper.xml"
SHORT = ("--duration", "0.1")  # five steps of box-slide


@dataclass(frozen=True)
class Ran(Printed):
    """How one call of the command ended."""

    @property
    def words(self) -> str:
        """Standard error in one line, without the frame that typer draws around its messages."""
        return " ".join(re.sub("[─│╭╮╰╯]", " ", self.err).split())


Pbfd = Callable[..., Ran]


def caller(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Pbfd:
    """Calls the command in this process. To be made a fixture: `pbfd = pytest.fixture(caller)`."""
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)  # the command sets its own: back to this one at the end

    def call(*arguments: object) -> Ran:
        capsys.readouterr()
        with warnings.catch_warnings():
            status = called(monkeypatch, *arguments)
        printed = capsys.readouterr()
        return Ran(status, printed.out, printed.err)

    return call
