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

from apps.viewer.access_control import (
    ALLOWED_MESSAGES,
    MAX_MESSAGE_BYTES,
    MAX_SCREENSHOT_BYTES,
    SCREENSHOT_MESSAGE,
    AccessControl,
    check_message,
)
from apps.viewer.server import get_address, start_server, stop_server
from tofclip.errors import InputError

viser = pytest.importorskip("viser")
OWN = {"host": "127.0.0.1:8080"}
SOCKET = {**OWN, "upgrade": "websocket", "origin": "http://127.0.0.1:8080"}


def test_loopback_needs_no_token_and_everything_else_does() -> None:
    for host in ("127.0.0.1", "localhost", "::1", "127.0.0.9"):
        assert AccessControl.for_host(host).token == ""
    for host in ("0.0.0.0", "192.168.0.2", "::"):
        assert len(AccessControl.for_host(host).token) >= 32
    assert AccessControl.for_host("0.0.0.0").token != AccessControl.for_host("0.0.0.0").token
    with pytest.raises(InputError, match="IP address"):
        AccessControl.for_host("example.org")


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
    assert AccessControl().check_request(path, OWN) == "no such page"


def test_requests_that_are_refused_on_loopback() -> None:
    access_control = AccessControl()
    assert access_control.check_request("/", OWN) == ""
    assert (
        access_control.check_request("/", {"host": "localhost:9000"}) == ""
    )  # the near end of a tunnel
    assert access_control.check_request("/", SOCKET) == ""
    assert access_control.check_request("/", {"host": "evil.org:8080"}) == "another computer's name"
    assert access_control.check_request("/", {}) == "another computer's name"
    assert access_control.check_request("/", {"host": "[::1"}) == "another computer's name"
    assert access_control.check_request("/?websocket=ws://evil.org", OWN) == "unknown query"
    assert access_control.check_request("/?playbackPath=http://evil.org/x", OWN) == "unknown query"
    assert (
        access_control.check_request("/", {**SOCKET, "origin": "http://evil.org"})
        == "another page's request"
    )
    assert (
        access_control.check_request("/", {**SOCKET, "origin": "http://127.0.0.1:9999"})
        == "another page's request"
    )
    assert (
        access_control.check_request("/", {name: SOCKET[name] for name in ("host", "upgrade")})
        == "another page's request"
    )


def test_beyond_loopback_only_the_token_opens() -> None:
    access_control = AccessControl("192.168.0.2", "secret")
    far = {"host": "192.168.0.2:8080"}
    assert access_control.check_request("/", far).startswith("no token")
    assert access_control.check_request("/?token=wrong", far).startswith("no token")
    assert access_control.check_request("/", {**far, "cookie": "tofclip=wrong; a=b"}).startswith(
        "no token"
    )
    assert access_control.check_request("/?token=secret", far) == ""
    assert access_control.check_request("/", {**far, "cookie": "a=b; tofclip=secret"}) == ""
    assert "HttpOnly" in access_control.make_cookie("/?token=secret")
    assert "SameSite=Strict" in access_control.make_cookie("/?token=secret")
    assert access_control.make_cookie("/") == AccessControl().make_cookie("/?token=x") == ""


@given(
    st.text(), st.dictionaries(st.sampled_from(["host", "origin", "upgrade", "cookie"]), st.text())
)
def test_a_strange_request_is_refused_rather_than_an_error(
    path: str, headers: dict[str, str]
) -> None:
    assert AccessControl("192.168.0.2", "a token that nobody guesses").check_request(
        "/" + path, headers
    )


def message(kind: object, size: int = 0) -> bytes:
    return msgspec.msgpack.encode({"type": kind, "padding": "x" * size})


def test_messages_that_are_refused() -> None:
    assert all(check_message(message(kind)) == "" for kind in ALLOWED_MESSAGES)
    for kind in (
        "ShareUrlRequest",
        "FileTransferStartUpload",
        "RunJavascriptMessage",
        "RemoveSceneNodeMessage",
        7,
        None,
    ):
        assert check_message(message(kind)) == "unknown command"
    assert check_message(message("GuiUpdateMessage", MAX_MESSAGE_BYTES)) == "too large"
    assert check_message(message(SCREENSHOT_MESSAGE, MAX_MESSAGE_BYTES)) == ""
    assert check_message(message(SCREENSHOT_MESSAGE, MAX_SCREENSHOT_BYTES)) == "too large"
    assert check_message("text") == "text"
    assert check_message(b"\xc1") == "no message"
    assert check_message(b"\x90") == "unknown command"


@given(st.binary(max_size=300))
@example(b"\xa3\x00\x00\x80")  # a text that is none
def test_noise_is_no_message(data: bytes) -> None:
    assert check_message(data)


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    started = start_server(AccessControl())
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
    assert get_address(server, AccessControl()) == f"http://127.0.0.1:{port}/"


def test_the_server_keeps_the_rules_for_messages(server: viser.ViserServer) -> None:
    port = server.get_port()
    for wrong in (
        message("ShareUrlRequest"),
        message("GuiUpdateMessage", MAX_MESSAGE_BYTES),
        b"\xff\xff",
    ):
        assert close_code(port, wrong) == 1008
    assert close_code(port, message("GuiUpdateMessage")) in (
        1008,
        1011,
    )  # a command without what belongs to it
    # Larger than any message: the connection ends before all of it has come, perhaps without a
    # word.
    assert close_code(port, message(SCREENSHOT_MESSAGE, MAX_SCREENSHOT_BYTES + 1)) in (1006, 1009)
    with pytest.raises(InvalidStatus):
        dial(port, "http://evil.org")
    assert get(port, "/")[0] == 200  # and goes on serving


def test_a_token_is_asked_for_and_kept_in_a_cookie() -> None:
    access_control = AccessControl("127.0.0.1", "secret")  # as it would be at another address
    started = start_server(access_control)
    try:
        port = started.get_port()
        assert get(port, "/")[0] == 403
        status, headers = get(port, "/?token=secret")
        assert (status, headers["set-cookie"].startswith("tofclip=secret")) == (200, True)
        with pytest.raises(InvalidStatus):
            dial(port)
        assert get_address(started, access_control).endswith("/?token=secret")
        with pytest.raises(InputError, match="cannot listen"):
            start_server(access_control, port)
    finally:
        stop_server(started)
    with pytest.raises(InputError, match="cannot listen"):
        start_server(AccessControl("203.0.113.7", "secret"))
