"""Who is let in, and what they may say: the rules, and the server that keeps them."""

from __future__ import annotations

import http.client
from collections.abc import Iterator

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from apps.viewer.door import LARGEST_MESSAGE, LARGEST_PICTURE, MESSAGES, PICTURE, Door, refused_message
from apps.viewer.server import address_of, start_server, stop_server
from tofclip.errors import InputError

viser = pytest.importorskip("viser")
OWN = {"host": "127.0.0.1:8080"}
SOCKET = {**OWN, "upgrade": "websocket", "origin": "http://127.0.0.1:8080"}


def test_loopback_needs_no_token_and_everything_else_does() -> None:
    for host in ("127.0.0.1", "localhost", "::1", "127.0.0.9"):
        assert Door.at(host).token == ""
    for host in ("0.0.0.0", "192.168.0.2", "::"):
        assert len(Door.at(host).token) >= 32
    assert Door.at("0.0.0.0").token != Door.at("0.0.0.0").token
    with pytest.raises(InputError, match="IP address"):
        Door.at("example.org")


@pytest.mark.parametrize(
    "path",
    [
        "/../etc/passwd",
        "/%2e%2e/etc/passwd",
        "/..\\secret",
        "/etc/passwd",
        "//evil.org/",
        "/index.html/x",
        "/assets/a.js",
    ],
)
def test_nothing_but_the_page_is_served(path: str) -> None:
    assert Door().refusal(path, OWN) == "no such page"


def test_requests_that_are_refused_on_loopback() -> None:
    door = Door()
    assert door.refusal("/", OWN) == ""
    assert door.refusal("/", {"host": "localhost:9000"}) == ""  # the near end of a tunnel
    assert door.refusal("/", SOCKET) == ""
    assert door.refusal("/", {"host": "evil.org:8080"}) == "another computer's name"
    assert door.refusal("/", {}) == "another computer's name"
    assert door.refusal("/", {"host": "[::1"}) == "another computer's name"
    assert door.refusal("/?websocket=ws://evil.org", OWN) == "unknown query"
    assert door.refusal("/?playbackPath=http://evil.org/x", OWN) == "unknown query"
    assert door.refusal("/", {**SOCKET, "origin": "http://evil.org"}) == "another page's request"
    assert door.refusal("/", {**SOCKET, "origin": "http://127.0.0.1:9999"}) == "another page's request"
    assert door.refusal("/", {name: SOCKET[name] for name in ("host", "upgrade")}) == "another page's request"


def test_beyond_loopback_only_the_token_opens() -> None:
    door = Door("192.168.0.2", "secret")
    far = {"host": "192.168.0.2:8080"}
    assert door.refusal("/", far).startswith("no token")
    assert door.refusal("/?token=wrong", far).startswith("no token")
    assert door.refusal("/", {**far, "cookie": "tofclip=wrong; a=b"}).startswith("no token")
    assert door.refusal("/?token=secret", far) == ""
    assert door.refusal("/", {**far, "cookie": "a=b; tofclip=secret"}) == ""
    assert "HttpOnly" in door.cookie("/?token=secret")
    assert "SameSite=Strict" in door.cookie("/?token=secret")
    assert door.cookie("/") == Door().cookie("/?token=x") == ""


@given(st.text(), st.dictionaries(st.sampled_from(["host", "origin", "upgrade", "cookie"]), st.text()))
def test_a_strange_request_is_refused_rather_than_an_error(path: str, headers: dict[str, str]) -> None:
    assert Door("192.168.0.2", "a token that nobody guesses").refusal("/" + path, headers)


def message(kind: object, size: int = 0) -> bytes:
    return msgspec.msgpack.encode({"type": kind, "padding": "x" * size})


def test_messages_that_are_refused() -> None:
    assert all(refused_message(message(kind)) == "" for kind in MESSAGES)
    for kind in (
        "ShareUrlRequest",
        "FileTransferStartUpload",
        "RunJavascriptMessage",
        "RemoveSceneNodeMessage",
        7,
        None,
    ):
        assert refused_message(message(kind)) == "unknown command"
    assert refused_message(message("GuiUpdateMessage", LARGEST_MESSAGE)) == "too large"
    assert refused_message(message(PICTURE, LARGEST_MESSAGE)) == ""
    assert refused_message(message(PICTURE, LARGEST_PICTURE)) == "too large"
    assert refused_message("text") == "text"
    assert refused_message(b"\xc1") == "no message"
    assert refused_message(b"\x90") == "unknown command"


@given(st.binary(max_size=300))
@example(b"\xa3\x00\x00\x80")  # a text that is none
def test_noise_is_no_message(data: bytes) -> None:
    assert refused_message(data)


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    started = start_server(Door())
    yield started
    stop_server(started)


def get(port: int, path: str, host: str = "127.0.0.1") -> tuple[int, dict[str, str]]:
    """Ask for a page; the path goes out as it is."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    connection.putheader("Host", f"{host}:{port}")
    connection.endheaders()
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer.status, {name.lower(): value for name, value in answer.getheaders()}


def dial(port: int, origin: str | None = None) -> ClientConnection:
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    own = f"http://127.0.0.1:{port}" if origin is None else origin
    return connect(f"ws://127.0.0.1:{port}", origin=own, subprotocols=[protocol], max_size=None)  # type: ignore[arg-type]


def close_code(port: int, data: bytes) -> int:
    """Say something and return with which code the connection ends."""
    with dial(port) as line:
        try:
            line.send(data)
            while True:
                line.recv(timeout=10)
        except ConnectionClosed as end:
            return end.rcvd.code if end.rcvd else 1006


def test_the_server_keeps_the_rules_for_pages(server: viser.ViserServer) -> None:
    port = server.get_port()
    status, headers = get(port, "/")
    assert (status, headers["x-frame-options"]) == (200, "DENY")
    assert get(port, "/../../../../etc/passwd")[0] == 404
    assert get(port, "/%2e%2e/%2e%2e/client/package.json")[0] == 404
    assert get(port, "/?websocket=ws://evil.org")[0] == 403
    assert get(port, "/", "evil.org")[0] == 403
    assert address_of(server, Door()) == f"http://127.0.0.1:{port}/"


def test_the_server_keeps_the_rules_for_messages(server: viser.ViserServer) -> None:
    port = server.get_port()
    for wrong in (message("ShareUrlRequest"), message("GuiUpdateMessage", LARGEST_MESSAGE), b"\xff\xff"):
        assert close_code(port, wrong) == 1008
    assert close_code(port, message("GuiUpdateMessage")) in (1008, 1011)  # a command without what belongs to it
    # Larger than any message: the connection ends before all of it has come, perhaps without a word.
    assert close_code(port, message(PICTURE, LARGEST_PICTURE + 1)) in (1006, 1009)
    with pytest.raises(InvalidStatus):
        dial(port, "http://evil.org")
    assert get(port, "/")[0] == 200  # and goes on serving


def test_a_token_is_asked_for_and_kept_in_a_cookie() -> None:
    door = Door("127.0.0.1", "secret")  # as it would be at another address
    started = start_server(door)
    try:
        port = started.get_port()
        assert get(port, "/")[0] == 403
        status, headers = get(port, "/?token=secret")
        assert (status, headers["set-cookie"].startswith("tofclip=secret")) == (200, True)
        with pytest.raises(InvalidStatus):
            dial(port)
        assert address_of(started, door).endswith("/?token=secret")
        with pytest.raises(InputError, match="cannot listen"):
            start_server(door, port)
    finally:
        stop_server(started)
    with pytest.raises(InputError, match="cannot listen"):
        start_server(Door("203.0.113.7", "secret"))
