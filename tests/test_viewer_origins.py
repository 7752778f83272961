"""Which web pages may connect to the viewer's WebSocket: its own, this computer's, and those that the user names."""

from __future__ import annotations

import urllib.request
from collections.abc import Iterator

import pytest
import viser
import websockets.asyncio.server
from websockets import Subprotocol
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from pbfd_torch import InputError
from pbfd_torch.viewer import server as serving
from pbfd_torch.viewer.origins import checked_origins, guarded, may_connect

NAMED = "https://hub.example.org"


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    started = serving.start(port=8660, quiet=True, origins=[NAMED])
    yield started
    serving.stop(started)


def greeted(server: viser.ViserServer, origin: str | None) -> bool:
    """Whether a page from there gets through the handshake, and hears of the scene."""
    uri, version = f"ws://127.0.0.1:{server.get_port()}", Subprotocol(f"viser-v{viser.__version__}")
    with connect(uri, origin=None if origin is None else Origin(origin), subprotocols=[version]) as socket:
        return len(socket.recv(timeout=20)) > 0


@pytest.mark.parametrize("origin", ["http://localhost:{}", "http://127.0.0.1:{}", "http://[::1]:8888", NAMED, None])
def test_the_viewers_own_pages_connect(server: viser.ViserServer, origin: str | None) -> None:
    """So do pages of this computer, the one that is named, and what is no browser."""
    assert greeted(server, None if origin is None else origin.format(server.get_port()))


FOREIGN = [
    "https://evil.example",
    "http://evil.example:{}",
    "http://localhost.evil.example:{}",
    "http://hub.example.org",  # another scheme than the one that is named
    "https://hub.example.org:8443",
    "http://192.168.1.5:{}",
    "http://localhost:{}@evil.example",
    "null",
    "",
]


@pytest.mark.parametrize("origin", FOREIGN)
def test_foreign_pages_are_refused(server: viser.ViserServer, origin: str) -> None:
    """With status 403, in the handshake."""
    with pytest.raises(InvalidStatus) as refused:
        greeted(server, origin.format(server.get_port()))
    assert refused.value.response.status_code == 403


def test_the_page_itself_is_served_to_all(server: viser.ViserServer) -> None:
    """It holds nothing of the scene."""
    with urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}/") as answer:
        assert answer.status == 200


@pytest.mark.parametrize(
    ("origin", "host", "address", "may"),
    [
        ("http://192.168.1.5:8080", "0.0.0.0", ("192.168.1.5", 8080), True),
        ("http://192.168.1.5:9090", "0.0.0.0", ("192.168.1.5", 8080), False),
        ("http://192.168.1.6:8080", "0.0.0.0", ("192.168.1.5", 8080), False),
        ("http://[fd00::5]:8080", "::", ("fd00::5", 8080), True),
        ("http://robot.lab:8080", "robot.lab", ("10.0.0.2", 8080), True),
        ("http://ROBOT.lab:8080", "Robot.Lab", ("10.0.0.2", 8080), True),
        ("http://evil.example:8080", "0.0.0.0", ("192.168.1.5", 8080), False),
        ("http://evil.example:99999", "0.0.0.0", ("192.168.1.5", 8080), False),
        ("https://robot.lab", "robot.lab", ("10.0.0.2", 443), True),
        ("ftp://localhost", "127.0.0.1", ("127.0.0.1", 8080), False),
    ],
)
def test_a_server_for_others_knows_its_own_addresses(origin: str, host: str, address: tuple[str, int], may: bool) -> None:
    """The address that a connection came in at, and the name that the server was started for; what the page calls it is not asked,
    because a name that is made to point here can be anything."""
    assert may_connect(origin, host, address, ()) == may


@pytest.mark.parametrize("origin", ["hub.example.org", "https://hub.example.org/path", "*", "https://a b", "ws://hub", ""])
def test_what_is_no_origin_is_refused_by_name(origin: str) -> None:
    with pytest.raises(InputError, match=r"must be like https://hub\.example\.org"):
        checked_origins([origin])
    with pytest.raises(InputError, match="origin is"):
        serving.start(port=8670, quiet=True, origins=[origin])


def test_a_server_without_the_guard_is_not_left_open() -> None:
    """Where viser starts its server in another way, and afterwards everything is as it was."""
    serve = websockets.asyncio.server.serve
    with pytest.raises(RuntimeError, match="origins cannot be checked"), guarded("127.0.0.1", ()):
        pass
    assert websockets.asyncio.server.serve is serve
