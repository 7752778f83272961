"""Named tasks of trajectory optimisation, one file each: name → (worlds, seed) → task."""

from collections.abc import Callable

from pbfd_torch.optimize.tasks.arm_swing_up import ArmSwingUp
from pbfd_torch.optimize.tasks.box_throw import BoxThrow
from pbfd_torch.optimize.tasks.hopper import Hopper
from pbfd_torch.optimize.tasks.task import Outcome, Task

TASKS: dict[str, Callable[[int, int], Task]] = {
    "box-throw": BoxThrow,
    "arm-swing-up": ArmSwingUp,
    "hopper": Hopper,
}

__all__ = ["TASKS", "ArmSwingUp", "BoxThrow", "Hopper", "Outcome", "Task"]
