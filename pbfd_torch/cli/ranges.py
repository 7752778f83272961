"""What numbers the command's options take: each range is declared once, here, and checked as the option is read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import typer

from pbfd_torch import memory
from pbfd_torch.errors import InputError
from pbfd_torch.stepping.stepper import LONGEST_STEP, SHORTEST_STEP


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, in a `unit`. Nothing that is not finite is within."""

    low: float
    high: float
    unit: str = ""

    @property
    def words(self) -> str:
        return f"from {_text(self.low)} to {_text(self.high)}"

    def check(self, name: str, value: float) -> None:
        """Raises `InputError` naming the option, its value and the range."""
        if not self.low <= value <= self.high:  # NaN neither
            unit = f" {self.unit}" if self.unit else ""
            raise InputError(f"{name} is {_text(value)}{unit}: must be {self.words}")

    def option(self, help: str, *names: str) -> Any:  # noqa: A002  (typer's own name)
        """An option, or a pair of numbers, that takes such numbers; None where it is left out."""
        return typer.Option(*names, help=f"{help} Must be {self.words}.", callback=_checked(self.check))


class WorldsRange:
    """As many worlds as memory has room for, as far as that can be known before the scene is."""

    def option(self, help: str, *names: str) -> Any:  # noqa: A002  (typer's own name)
        """See `Range`."""
        return typer.Option(*names, help=f"{help} Must be ≥ 1; memory says how many.", callback=_checked(memory.require_room))


def _checked(check: Callable[[str, float], None]) -> Callable[..., Any]:
    def checked(param: typer.CallbackParam, value: Any) -> Any:
        for number in value if isinstance(value, list | tuple) else (value,):
            if number is not None:
                check(max(param.opts, key=len), number)
        return value

    return checked


def _text(value: float) -> str:
    """Integers with all their digits."""
    return str(value) if isinstance(value, int) else f"{value:g}"


WORLDS = WorldsRange()
STEP = Range(SHORTEST_STEP, LONGEST_STEP, "s")
DURATION = Range(SHORTEST_STEP, 1e9, "s")
ACCURACY = Range(1e-9, 1.0, "m")
CONTROL_STEP = Range(SHORTEST_STEP, 1.0, "s")
SEED = Range(0, 2**64 - 1)
PROCESSES = Range(1, 256)
COLLECTORS = Range(0, 256)
THREADS = Range(1, 256)
PORT = Range(1, 65535)
FRAMES = Range(1, 10**12)
MINUTES = Range(1e-3, 10**6, "min")
ITERATIONS = Range(1, 10**6)
FACTOR = Range(1e-3, 1e3)
FRICTION_FACTOR = Range(0, 1e3)
FORCE = Range(0, 1e6, "N")
FRAME = Range(0, 10**9)
SIDE_BY_SIDE = Range(1, 64)

MEASURED_STEP = Range(SHORTEST_STEP, 0.1, "s")  # up to the paper's largest
MEASURED_STEPS = Range(1, 10_000)
MEASURED_WORLDS = Range(1, 4096)
MEASURED_SECONDS = Range(1e-3, 1e5, "s")
REPEATS = Range(1, 1000)
TRAJECTORY = Range(0.1, 60, "s")
SOAKED = Range(1, 10**9)
SOAKED_SEED = Range(0, 2**62)
