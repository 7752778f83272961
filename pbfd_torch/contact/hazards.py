"""What may be wrong with a step although its equations were solved, as bits per world."""

from __future__ import annotations

import enum
from collections.abc import Mapping

import torch
from torch import Tensor


class Hazard(enum.IntFlag):
    """Bits; 0: nothing."""

    CANDIDATES_DROPPED = 1  # more was near than there are slots for: contacts may be missing
    MOVED_TOO_FAR = 2  # a body moved further than detection looked: it may have jumped over something
    OVERLAPPED = 4  # bodies overlapped by more than the slack at its start: they began so, or turned into each other before
    TOO_DEEP = 8  # a contact or a joint limit is ten times deeper than it is meant to be, or a quarter of a body's half thickness
    TURNED_FAR = 16  # a link that touches something has turned by more than a quarter turn in the step: it may be a foreign root


def marked(found: Mapping[Hazard, Tensor]) -> Tensor:
    """The bits of what was found, each `[*batch]` bool, as one `[*batch]` int."""
    return torch.stack([where.to(torch.int32) * int(bit) for bit, where in found.items()]).sum(0, dtype=torch.int32)


class Overflow(enum.Enum):
    """What happens where more candidates are near than there are slots."""

    FLAG = "flag"  # the nearest ones are kept, and the world is marked with `Hazard.CANDIDATES_DROPPED`
    RAISE = "raise"  # `ContactOverflowError`
    GROW = "grow"  # there are twice as many slots for that step, and again until all fit
