"""XML files of robots: the one place where text from outside becomes elements, and their numbers are checked."""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

from pbfd_torch.errors import ModelError
from pbfd_torch.loading.bounds import require_file_size
from pbfd_torch.loading.report import existing_file

_VERSION = re.compile(rb"""\A(?P<before>(?:\xef\xbb\xbf)?<\?xml\s+version\s*=\s*)(?P<quote>["'])[^"'>]*(?P=quote)""")


def read_xml(path: Path) -> Any:
    """The root element, without comments. The version that the file names is not asked for: there is only one that is used.
    Raises `ModelError` naming file and line for what is no XML, declares entities or is nested more than 256 deep."""
    from lxml import etree

    file = existing_file(path)
    require_file_size(file)
    text = _VERSION.sub(rb'\g<before>"1.0"', file.read_bytes())
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, huge_tree=False, recover=False, remove_comments=True, remove_pis=True
    )
    try:
        root = etree.fromstring(text, parser)
    except etree.XMLSyntaxError as error:
        words = re.sub(r", line \d+, column \d+.*", "", error.msg or "it is empty").strip()
        raise ModelError(f"malformed XML: {words}", file=f"{file}:{error.lineno or 1}") from None
    types = root.getroottree().docinfo.internalDTD
    if types is not None and (entities := [x.name for x in types.iterentities()]):
        raise ModelError(f"declares the entities {', '.join(entities[:5])}: write out what they stand for", file=str(file))
    return root


def require_root(root: Any, tag: str, path: Path) -> None:
    """Raises `ModelError` for another root element."""
    if root.tag != tag:
        raise ModelError(f"root element is <{root.tag}>: must be <{tag}>", file=f"{path}:{root.sourceline}")


def require_finite(root: Any, path: Path, words: Collection[str], endless: Collection[str]) -> None:
    """Raises `ModelError` naming file, line and element for an attribute with a number that is not finite. `words`: attributes
    that hold no numbers. `endless`: those that may be infinite, like limits."""
    for node in root.iter():
        for key, value in node.attrib.items():
            if key in words:
                continue
            if any(math.isnan(x) or (math.isinf(x) and key not in endless) for x in _numbers(value)):
                shown = value if len(value) <= 60 else f"{value[:60]}…"
                must = "must be numbers" if key in endless else "must be finite numbers"
                reason = f"{key} of <{node.tag}> is '{shown}': {must}"
                raise ModelError(reason, element=_around(node), file=f"{path}:{node.sourceline}")


def _around(node: Any) -> str:
    """The element itself, or the nearest one around it, that has a name: «link 'foot'»; empty where only the root has one."""
    named = next((x for x in (node, *node.iterancestors()) if x.get("name") and x.getparent() is not None), None)
    return "" if named is None else f"{named.tag} '{named.get('name')}'"


def _numbers(text: str) -> list[float]:
    found = []
    for part in text.split():
        try:
            found.append(float(part))
        except ValueError:
            return []
    return found
