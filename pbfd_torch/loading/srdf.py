"""SRDF files, which say of a URDF robot which of its links never touch."""

from __future__ import annotations

import os
from pathlib import Path

from pbfd_torch.errors import ModelError
from pbfd_torch.loading.xml_file import read_xml, require_finite, require_root

_WORDS = ("name", "link", "link1", "link2", "reason", "base_link", "tip_link", "parent_link", "child_link", "group", "joint")


def load_srdf_exclusions(path: str | os.PathLike[str]) -> tuple[tuple[str, str], ...]:
    """The pairs of links that an SRDF file keeps from touching (<disable_collisions link1="…" link2="…"/>), for `excluded` of
    `load_urdf`. Raises `ModelError` for malformed XML, another root than <robot> or a pair without two names."""
    file = Path(path)
    root = read_xml(file)
    require_root(root, "robot", file)
    require_finite(root, file, words=_WORDS, endless=())
    pairs = []
    for node in root.iter("disable_collisions"):
        one, other = node.get("link1"), node.get("link2")
        if not one or not other:
            raise ModelError("<disable_collisions> needs the attributes link1 and link2", file=f"{file}:{node.sourceline}")
        pairs.append((one, other))
    return tuple(pairs)
