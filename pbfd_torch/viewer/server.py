"""The viewer's server: only this computer sees it unless asked otherwise, and it finds a free port."""

from __future__ import annotations

import contextlib
import io
import socket
import sys
from collections.abc import Iterator, Sequence

import viser

from pbfd_torch.errors import InputError
from pbfd_torch.viewer.origins import checked_origins, guarded

HOST, PORT = "127.0.0.1", 8080
_TRIES = 100


def start(host: str = HOST, port: int = PORT, quiet: bool = False, origins: Sequence[str] = ()) -> viser.ViserServer:
    """A server at a port, or at the next free one, which is then said on stderr unless `quiet`. `origins`: of web pages elsewhere
    that may connect, such as "https://hub.example.org". Raises `InputError` for a host, port or origin that cannot be used."""
    named = checked_origins(origins)
    if not 1 <= port <= 65535:
        raise InputError(f"port is {port}: must be from 1 to 65535")
    free = _free_port(host, port)
    if free != port and not quiet:
        print(f"pbfd: port {port} is taken: using {free}", file=sys.stderr)
    with _quiet(), guarded(host, named):
        server = viser.ViserServer(host=host, port=free, label="pbfd_torch", verbose=False)
    server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False, brand_color=(31, 106, 165))
    server.gui.main_panel.dock_right()
    return server


def stop(server: viser.ViserServer) -> None:
    """Ends it; browsers lose their connection."""
    with _quiet():
        server.stop()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without viser's own words, which it prints whatever it is told; stdout may be read by a program."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def _free_port(host: str, port: int) -> int:
    for candidate in range(port, min(port + _TRIES, 65536)):
        try:
            family = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0][0]
            with socket.socket(family, socket.SOCK_STREAM) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, candidate))
            return candidate
        except socket.gaierror as error:
            raise InputError(f"host is '{host}': {error.strerror}") from None
        except PermissionError:
            continue
        except OSError as error:
            if error.errno not in (98, 48, 10048):  # "address in use" on Linux, macOS and Windows
                raise InputError(f"host is '{host}': {error.strerror}") from None
    raise InputError(f"no free port from {port} on: choose another one")


def address(server: viser.ViserServer) -> str:
    """Where a browser finds it."""
    host = server.get_host()
    return f"http://{'localhost' if host in ('0.0.0.0', '::', '127.0.0.1') else host}:{server.get_port()}"
