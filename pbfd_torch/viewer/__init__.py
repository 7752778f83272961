"""Looks at rollouts: in a browser, as a page, a still or a film. Draws, never steps, but for `live`."""

from __future__ import annotations

from pbfd_torch.rollout import Rollout
from pbfd_torch.viewer.export import save_film, save_html, save_png
from pbfd_torch.viewer.inspector import Inspector
from pbfd_torch.viewer.live import Live
from pbfd_torch.viewer.server import HOST, PORT

__all__ = ["Inspector", "Live", "save_film", "save_html", "save_png", "view"]


def view(rollout: Rollout, ghost: Rollout | None = None, host: str = HOST, port: int = PORT) -> Inspector:
    """Shows a rollout in the browser, with another one of the same robot as a ghost over it, and returns at once: the result says
    its `address`, is shown in place by notebooks, waits with `wait()` and ends with `close()`. See `Inspector`."""
    return Inspector(rollout, ghost, host, port)
