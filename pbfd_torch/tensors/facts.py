"""What follows from some fields of a frozen dataclass alone: found once, and known to its copies that share these fields."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, TypeVar

T = TypeVar("T")


class Fact(cached_property[T]):
    """A cached property with the names of the fields that it follows from."""

    def __init__(self, find: Callable[[Any], T], fields: tuple[str, ...]) -> None:
        super().__init__(find)
        self.fields = fields


def fact(*fields: str) -> Callable[[Callable[[Any], T]], Fact[T]]:
    """Makes a method of a dataclass a `Fact` that follows from these fields. To find one from tensors on a device makes the host
    wait: what is used in a step is found in `__post_init__`, and `replaced` takes it along."""
    return lambda find: Fact(find, fields)


def known(instance: object, fields: Mapping[str, Any]) -> dict[str, Any]:
    """The facts that an object has found and that hold for a copy with these fields, because those that they follow from are the
    same objects."""
    found = {}
    for name in vars(instance).keys() - fields.keys():
        made = getattr(type(instance), name, None)
        if isinstance(made, Fact) and all(fields[x] is getattr(instance, x) for x in made.fields):
            found[name] = getattr(instance, name)
    return found
