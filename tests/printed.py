"""The command called in this process, and what it has printed."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import Any

import pytest

from pbfd_torch.cli.main import main


def json_object(text: str) -> dict[str, Any]:
    """The one JSON object in one line; raises for anything else, NaN and infinity included."""

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not JSON")

    assert text.count("\n") == 1
    found = json.loads(text, parse_constant=refuse)
    assert isinstance(found, dict)
    return found


@dataclass(frozen=True)
class Printed:
    """How one call of the command ended: its exit status, and what it printed."""

    status: int
    out: str
    err: str

    @property
    def data(self) -> dict[str, Any]:
        """The one JSON object that was printed; raises for anything else, NaN and infinity included."""
        return json_object(self.out)


def called(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """The exit status of `pbfd` with these arguments, called in this process."""
    monkeypatch.setattr(sys, "argv", ["pbfd", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    status = end.value.code
    assert isinstance(status, int)
    return status
