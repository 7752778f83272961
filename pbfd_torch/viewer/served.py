"""What is shown at an address until it is closed."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod

import viser

from pbfd_torch.viewer import server as serving


class Served(ABC):
    """Has a `server`, and is closed once."""

    server: viser.ViserServer

    def __init__(self) -> None:
        self._closed = threading.Event()

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return serving.address(self.server)

    def wait(self) -> None:
        """Returns once it is closed, or with KeyboardInterrupt."""
        while not self._closed.wait(0.2):
            pass

    def close(self) -> None:
        """Stops it; browsers lose their connection. Twice is no error."""
        if not self._closed.is_set():
            self._closed.set()
            self._ended()
            serving.stop(self.server)

    @abstractmethod
    def _ended(self) -> None:
        """Stops what runs besides the server."""
