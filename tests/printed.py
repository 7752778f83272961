"""What a command has printed."""

from __future__ import annotations

import json
from typing import Any


def json_object(text: str) -> dict[str, Any]:
    """The one JSON object in one line; raises for anything else, NaN and infinity included."""

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not JSON")

    assert text.count("\n") == 1
    found = json.loads(text, parse_constant=refuse)
    assert isinstance(found, dict)
    return found
