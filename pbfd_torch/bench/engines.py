"""Which engine made what is reported."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable


def in_words(made: Iterable[tuple[str, str]]) -> str:
    """The engine of most results (what, engine), and what others made: "engine: native; of PBD, min E: torch"."""
    pairs = list(made)
    (most, _), *others = Counter(engine for _, engine in pairs).most_common()
    exceptions = {engine: dict.fromkeys(what for what, by in pairs if by == engine) for engine, _ in others}
    return "; ".join([f"engine: {most}", *(f"of {', '.join(names)}: {engine}" for engine, names in exceptions.items())])
