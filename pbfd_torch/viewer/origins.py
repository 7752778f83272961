"""Which web pages may connect to the viewer.

A browser lets any page that its user looks at open a WebSocket to any server, the viewer's included, but says in the header
`Origin` where that page is from. Pages of the viewer itself may connect, and those of other servers on this computer, such as
notebooks and tunnels; others only where the user names them. What is no browser may connect: it could send any header.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server
from websockets import Request, Response
from websockets.asyncio.server import ServerConnection

from pbfd_torch.errors import InputError

_PORTS = {"http": 80, "https": 443}
LOCAL = ("localhost", "127.0.0.1", "::1")
_ORIGIN = re.compile(r"https?://([a-z0-9.-]+|\[[0-9a-f:.]+\])(:[0-9]{1,5})?")

Answer = Callable[[ServerConnection, Request], Response | None]


def checked_origins(origins: Sequence[str]) -> tuple[str, ...]:
    """The same in lower case. Raises `InputError` for what is no origin as a browser sends it."""
    for origin in origins:
        if not _ORIGIN.fullmatch(origin.lower()):
            raise InputError(f"origin is '{origin}': must be like https://hub.example.org or http://10.0.0.5:8888, no path")
    return tuple(origin.lower() for origin in origins)


def may_connect(origin: str | None, host: str, address: tuple[str, int], named: Sequence[str]) -> bool:
    """Whether a page from `origin` may connect to a server that was started for `host` and is reached at `address`, host and port.
    `named`: further origins.

    The header `Host` is not asked: a page whose name is made to point here can have any."""
    if origin is None or origin.lower() in named:
        return True
    if not _ORIGIN.fullmatch(origin.lower()):
        return False
    try:
        page = urlsplit(origin.lower())
        port = page.port or _PORTS[page.scheme]
    except ValueError:  # no address, no port
        return False
    if page.hostname in LOCAL:
        return True
    return page.hostname in {host.lower(), address[0].lower(), socket.gethostname().lower()} and port == address[1]


@contextmanager
def guarded(host: str, named: Sequence[str]) -> Iterator[None]:
    """A server of viser's that is started meanwhile refuses pages from elsewhere with status 403.

    viser has no door for that: what is replaced is the function that it starts its server with. Raises `RuntimeError` where it was
    started without, rather than leave it open."""
    serve, used = websockets.asyncio.server.serve, []

    def serve_guarded(*arguments: Any, process_request: Answer | None = None, **more: Any) -> Any:
        used.append(True)

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            origin = request.headers.get("Origin")
            if "Upgrade" in request.headers and not may_connect(origin, host, connection.local_address[:2], named):
                return connection.respond(HTTPStatus.FORBIDDEN, f"origin {origin} may not connect: start the viewer with it\n")
            return None if process_request is None else process_request(connection, request)

        return serve(*arguments, process_request=answer, **more)

    websockets.asyncio.server.serve = serve_guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
    if not used:
        raise RuntimeError("viser starts its server in another way: origins cannot be checked")
