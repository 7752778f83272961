"""Some worlds of a batch, and their parts of the objects that hold values per world."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar, overload

import torch
from torch import Tensor

from pbfd_torch.tensors.facts import known

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Instance = TypeVar("Instance", bound="DataclassInstance")


@dataclass(frozen=True, eq=False)
class Worlds:
    """Some worlds of a batch, as a flat list.

    Attributes:
        batch: the batch shape.
        index: `[n]` long, their positions in the flattened batch.
    """

    batch: tuple[int, ...]
    index: Tensor

    @overload
    def pick(self, value: Tensor, rank: int) -> Tensor: ...
    @overload
    def pick(self, value: float, rank: int) -> float: ...
    @overload
    def pick(self, value: None, rank: int) -> None: ...
    def pick(self, value: float | Tensor | None, rank: int) -> float | Tensor | None:
        """Rows `[n, *event]` of a value `[*, *event]` whose last `rank` dimensions are its own and whose leading ones broadcast to
        the batch. A number, None, or a value without leading dimensions is one for all worlds: it comes back itself."""
        if not isinstance(value, Tensor) or value.ndim <= rank:
            return value
        event = value.shape[value.ndim - rank :]
        return value.expand(*self.batch, *event).flatten(0, len(self.batch) - 1)[self.index]

    def rows(self, value: Tensor) -> Tensor:
        """Rows `[n, *event]` of a value `[*batch, *event]` that has all the batch's dimensions."""
        return self.pick(value, value.ndim - len(self.batch))


@dataclass(frozen=True, eq=False)
class Census(Worlds):
    """Takes no worlds of anything, and notes what it is shown: tensors, and how many of their last dimensions are their own."""

    batch: tuple[int, ...] = ()
    index: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))
    shown: list[tuple[Tensor, int]] = field(default_factory=list)

    def pick(self, value: Any, rank: int) -> Any:
        """The value itself."""
        if isinstance(value, Tensor):
            self.shown.append((value, min(rank, value.ndim)))
        return value

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """For how many worlds there are values."""
        return [tuple(value.shape[: value.ndim - rank]) for value, rank in self.shown]


@cache
def _names(kind: type[DataclassInstance]) -> tuple[str, ...]:
    """Of a dataclass's fields."""
    return tuple(field.name for field in dataclasses.fields(kind))


def replaced(instance: Instance, **changes: Any) -> Instance:
    """A copy of a frozen dataclass with some fields changed: `__post_init__` does not run, its checks being done, and cached
    properties are left behind, but for every `Fact` whose fields stay the same. The instance itself where no field changes
    identity."""
    if all(getattr(instance, name) is value for name, value in changes.items()):
        return instance
    fields = {name: getattr(instance, name) for name in _names(type(instance))} | changes
    copy = object.__new__(type(instance))
    vars(copy).update(fields | known(instance, fields))
    return copy
