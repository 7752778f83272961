"""Integrator states as flat dictionaries of tensors, so that they can travel in a tensordict."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from pbfd_torch.integrators.integrator import S
from pbfd_torch.tensors.worlds import replaced


def packed(state: Any) -> dict[str, Tensor]:
    """The tensors of a state `[worlds, …]` by field; of what terms remember: by number. What is None is left out."""
    flat: dict[str, Tensor] = {}
    for field in dataclasses.fields(state):
        value = getattr(state, field.name)
        if isinstance(value, Tensor):
            flat[field.name] = value
        elif isinstance(value, tuple):
            flat |= {f"{field.name}_{k}": x for k, x in enumerate(value)}
    return flat


def unpacked(flat: Mapping[str, Tensor], like: S) -> S:
    """The state that was packed, of the kind of another one."""
    fields: dict[str, Any] = {}
    for field in dataclasses.fields(like):
        value = getattr(like, field.name)
        if isinstance(value, Tensor):
            fields[field.name] = flat[field.name]
        elif isinstance(value, tuple):
            fields[field.name] = tuple(flat[f"{field.name}_{k}"] for k in range(len(value)))
    return replaced(like, **fields)
