"""Torsional friction as the C++ core sees it: a part of the laws of the contact that it belongs to."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from pbfd_torch.native.not_compiled import unknown
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.torsional_friction import TorsionalFriction

BESIDE = ("friction", "grip", "deep", "pairs")  # of a contact: what its depths, normals and normal forces know nothing of


def torsions(terms: Sequence[Any]) -> dict[int, TorsionalFriction]:
    """That of each contact term that has one, by the term's `id`. Raises `NotCompiledError` for what belongs to none of them."""
    found: dict[int, TorsionalFriction] = {}
    contacts = [term for term in terms if isinstance(term, Contact)]
    for friction in (term for term in terms if isinstance(term, TorsionalFriction)):
        if friction.held is not None:
            raise unknown("torsional friction with a normal force that is held")
        its = [contact for contact in contacts if _alike(contact, friction.contact, BESIDE)]
        if not its:
            raise unknown("torsional friction of a contact that is not among the scene's terms")
        free = [contact for contact in its if id(contact) not in found]
        if not free:
            raise unknown("two torsional frictions of one contact")
        found[id(free[0])] = friction
    return found


def _alike(one: Any, other: Any, but: Sequence[str] = ()) -> bool:
    """Whether two parts of a scene have the same numbers, whoever made them; but: names of fields that may differ."""
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, Tensor):
        return one.shape == other.shape and bool((one == other).all())
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(_alike, one, other))
    if dataclasses.is_dataclass(one):
        names = (field.name for field in dataclasses.fields(one) if field.name not in but)
        return all(_alike(getattr(one, name), getattr(other, name)) for name in names)
    return bool(one == other)
