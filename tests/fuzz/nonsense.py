"""Values that mean nothing, and where in a structure of dictionaries and lists they can be put."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any, TypeVar

from hypothesis import strategies as st

from pbfd_torch import PbfdError

T = TypeVar("T")

GONE = object()
"""In the place of a value: there is none."""

NONSENSE: st.SearchStrategy[Any] = st.one_of(
    st.just(GONE),
    st.sampled_from([None, True, False, [], {}, "", "nan", "inf", "x" * 1000, -1, 0, 1, 10**9, 10**30, -(10**30)]),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e308, 1e-320, -0.5, 0.5]),
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
        max_leaves=4,
    ),
)

Place = tuple[Any, ...]


def places(structure: Any, before: Place = ()) -> list[Place]:
    """The keys that lead to every entry of a structure, inner ones included."""
    listed = enumerate(structure) if isinstance(structure, list) else ()
    items = structure.items() if isinstance(structure, dict) else listed
    return [place for key, value in items for place in ((*before, key), *places(value, (*before, key)))]


def placed(structure: Any, place: Place, value: Any) -> Any:
    """A copy with another value in a place, or without any, where it is `GONE`."""
    changed = copy.deepcopy(structure)
    inner = changed
    for key in place[:-1]:
        inner = inner[key]
    if value is GONE:
        del inner[place[-1]]
    else:
        inner[place[-1]] = value
    return changed


def unless_refused(read: Callable[[], T], *words: str) -> T | None:
    """What a function makes, or None where it refuses by the package's own error, which must have these words."""
    try:
        return read()
    except PbfdError as error:
        missing = [word for word in words if word not in str(error)]
    assert not missing
    return None
