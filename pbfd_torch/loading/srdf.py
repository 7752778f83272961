"""SRDF files, which say of a URDF robot which of its links never touch."""

from __future__ import annotations

import os

from pbfd_torch.errors import ModelError
from pbfd_torch.loading.report import existing_file


def load_srdf_exclusions(path: str | os.PathLike[str]) -> tuple[tuple[str, str], ...]:
    """The pairs of links that an SRDF file keeps from touching (<disable_collisions link1="…" link2="…"/>), for `excluded` of
    `load_urdf`. Raises `ModelError` for malformed XML, another root than <robot> or a pair without two names."""
    from lxml import etree

    file = existing_file(path)
    try:
        root = etree.parse(file).getroot()
    except etree.XMLSyntaxError as error:
        raise ModelError(f"malformed XML: {error.msg}", file=f"{file}:{error.lineno}") from None
    if root.tag != "robot":
        raise ModelError(f"root element is <{root.tag}>: must be <robot>", file=f"{file}:{root.sourceline}")
    pairs = []
    for node in root.iter("disable_collisions"):
        one, other = node.get("link1"), node.get("link2")
        if not one or not other:
            raise ModelError("<disable_collisions> needs the attributes link1 and link2", file=f"{file}:{node.sourceline}")
        pairs.append((one, other))
    return tuple(pairs)
