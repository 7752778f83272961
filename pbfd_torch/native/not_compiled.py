"""What the compiled core does not know, said by name."""

from __future__ import annotations


class NotCompiledError(Exception):
    """What the core does not know, in words."""


def unknown(what: str) -> NotCompiledError:
    """The error that says so."""
    return NotCompiledError(f"the core does not know {what}")
