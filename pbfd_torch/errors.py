"""The exceptions of the library: every message names the value, the range and the valid choices."""

from __future__ import annotations


class PbfdError(Exception):
    """Base of everything this library raises on purpose."""


class InputError(PbfdError, ValueError):
    """A value, shape, dtype, device or option that cannot be used."""


class ModelError(PbfdError, ValueError):
    """A robot that cannot be simulated: names the file (where there is one), the element and the reason."""

    def __init__(self, reason: str, *, element: str = "", file: str = "") -> None:
        self.reason, self.element, self.file = reason, element, file
        super().__init__(": ".join(part for part in (file, element, reason) if part))


class ContactOverflowError(PbfdError, RuntimeError):
    """More contacts were near than there are slots for, and the scene asks to stop then. `rollout`: what was computed before, or
    None."""

    rollout: object = None


class NotModelledWarning(UserWarning):
    """Something that a file asks for and that the simulation leaves out; given once per file and feature."""


class GradientError(PbfdError, RuntimeError):
    """Derivatives were asked for of a step that has none: unsolved, or with a singular Jacobian."""


class GradientWarning(UserWarning):
    """Derivatives were given where there are none, as asked for."""
