"""Which engine makes the steps: the compiled core, or PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from pbfd_torch.errors import InputError
from pbfd_torch.native.not_compiled import NotCompiledError
from pbfd_torch.native.stepper import NativeStepper, plan_of
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.stepping.stepper import Stepper


class Engine(Protocol):
    """What makes a stepper of the one that defines its steps."""

    name: ClassVar[str]
    """As commands and reports have it."""

    def stepper(self, eager: EagerStepper[Any]) -> Stepper[Any]:
        """Makes these steps. Raises `InputError` where it cannot."""
        ...


@dataclass(frozen=True)
class Torch:
    """Steps in PyTorch: whatever the scene, on any device."""

    name: ClassVar[str] = "torch"

    def stepper(self, eager: EagerStepper[Any]) -> Stepper[Any]:
        """See `Engine`."""
        return eager


@dataclass(frozen=True)
class Native:
    """Steps by the compiled core, where it covers them (docs/NATIVE.md). `threads` ≥ 1: at most, for batches that are worth it;
    None: as many as PyTorch uses. Raises `InputError` for others."""

    threads: int | None = None
    name: ClassVar[str] = "native"

    def __post_init__(self) -> None:
        if self.threads is not None and self.threads < 1:
            raise InputError(f"threads is {self.threads}: must be ≥ 1, or None for as many as PyTorch uses")

    def stepper(self, eager: EagerStepper[Any]) -> Stepper[Any]:
        """See `Engine`."""
        return NativeStepper(eager, self.threads)


def chosen(eager: EagerStepper[Any]) -> tuple[Stepper[Any], str, str]:
    """What makes these steps, the engine's name, and why it is not the compiled core (empty where it is)."""
    try:
        plan = plan_of(eager)
    except NotCompiledError as missing:
        return eager, Torch.name, str(missing)
    return NativeStepper(eager, plan=plan), Native.name, ""
