"""What the settings of both methods have in common, and the checks of them."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

from pbfd_torch.errors import InputError
from pbfd_torch.learning.numbers import require_integer
from pbfd_torch.learning.training_env import EnvSettings

COUNTS, WIDTHS = (1, 10**12), (1, 4096)


@dataclass(frozen=True)
class Settings:
    """Attributes:
    env: where.
    horizon: steps of each world per batch. epochs: how often each batch is gone through.
    decay: environment steps in which learning rates fall to a tenth; they stay there.
    gamma, lmbda, width: the usual ones; width: of both networks' two hidden layers.

    Raises `InputError` for a discount outside [0, 1), for counts below 1 and for widths over 4096.
    """

    counts: ClassVar[tuple[str, ...]] = ("horizon", "epochs", "decay", "width")

    env: EnvSettings
    _: KW_ONLY
    horizon: int
    epochs: int
    decay: int
    gamma: float
    lmbda: float = 0.95
    width: int = 64

    def __post_init__(self) -> None:
        for name in self.counts:
            require_integer(name, getattr(self, name), *(WIDTHS if name == "width" else COUNTS))
        if not 0 <= self.gamma < 1:
            raise InputError(f"gamma is {self.gamma}: must be from 0 to below 1")
