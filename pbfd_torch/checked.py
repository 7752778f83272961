"""Arrays from outside: tensors, numpy arrays, lists and numbers become tensors of one type in one place, or are refused by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.shapes import broadcast_shapes

Array: TypeAlias = Tensor | NDArray[Any] | Sequence[Any] | float
"""What may be given where a tensor is asked for."""


def as_tensor(name: str, value: Array, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The value as a tensor of this type. A tensor must be one already, for a copy would hide which type a scene has; what comes
    from numpy or Python is copied. No device is asked for anything. Raises `InputError` for another dtype or device, and for what
    is no array of real numbers."""
    if isinstance(value, Tensor):
        if value.dtype != dtype or value.device != device:
            raise InputError(f"{name} is {value.dtype} on {value.device}: must be {dtype} on {device}")
        return value
    try:
        numbers = np.asarray(value)
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{name} is no array: {error}; must be a tensor, a numpy array or a list of numbers") from error
    if numbers.dtype.kind not in "fiu":
        raise InputError(
            f"{name} is a {type(value).__name__} of {numbers.dtype}: must be a tensor, a numpy array or a list of real numbers"
        )
    return torch.tensor(numbers.astype(np.float64), dtype=dtype, device=device)


def require_shape(name: str, value: Tensor, event: tuple[int, ...]) -> None:
    """Raises `InputError` unless the shape ends in that of one world."""
    rank = len(event)
    if value.ndim < rank or tuple(value.shape[value.ndim - rank :]) != event:
        raise InputError(f"{name} has shape {tuple(value.shape)}: must end in {event}")


def broadcast_batches(batches: dict[str, Sequence[int]]) -> tuple[int, ...]:
    """The batch shape that these go together to; raises `InputError` with all of them by name where they do not."""
    shapes = {tuple(shape) for shape in batches.values() if len(shape)}
    if len(shapes) < 2:  # as it nearly always is
        return shapes.pop() if shapes else ()
    try:
        return tuple(broadcast_shapes(*batches.values()))
    except RuntimeError as error:
        each = ", ".join(f"{name}: {tuple(shape)}" for name, shape in batches.items() if len(shape))
        raise InputError(
            f"batch shapes do not go together: {each}; each must be that of all worlds, or have 1 or nothing"
        ) from error


def require_bounded(name: str, value: Tensor, most: float, unit: str) -> None:
    """Raises `InputError` unless every entry is finite and no farther than `most` from 0. A device makes the host wait for it."""
    size = value.detach().abs()
    if bool((size <= most).all()):
        return
    if not bool(torch.isfinite(size).all()):
        raise InputError(f"{name} holds NaN or infinity: must be finite, and at most {most:g} {unit} in size")
    raise InputError(f"{name} holds {float(size.amax()):g}: must be at most {most:g} {unit} in size")
