"""Looks at rollouts: in a browser, as a page, a still or a film. Draws, never steps, but for `live`. Imports `records` and the
simulator; `show` is its door."""

from __future__ import annotations

from pbfd_torch.viewer.export import save_film, save_html, save_png
from pbfd_torch.viewer.inspector import Inspector
from pbfd_torch.viewer.live import Live

__all__ = ["Inspector", "Live", "save_film", "save_html", "save_png"]
