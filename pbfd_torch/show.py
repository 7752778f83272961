"""The viewer's door, which loads it only when it is used."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pbfd_torch.records.rollout import Rollout

if TYPE_CHECKING:
    from pbfd_torch.viewer import Inspector


def view(
    rollout: Rollout, ghost: Rollout | None = None, host: str = "127.0.0.1", port: int = 8080, origins: Sequence[str] = ()
) -> Inspector:
    """Shows a rollout in the browser, and another one of the same robot as a ghost over it. Returns at once: the result says its
    `address`, is shown in place by notebooks, waits with `wait()` and ends with `close()`: see `pbfd_torch.viewer.Inspector`.
    origins: of web pages elsewhere that may connect, such as that of a notebook behind a proxy."""
    from pbfd_torch.viewer import Inspector

    return Inspector(rollout, ghost, host, port, origins)
