"""The page's server lets in whoever knows its token, and no other page of the browser."""

import http.client
from urllib.parse import urlsplit

import pytest
import viser
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from apps.viewer import page as served
from apps.viewer.page import Guard, install_guard, parse_host, start_server, stop_server
from tofclip.errors import InputError, MissingDependencyError

EVIL = "https://evil.example"


def test_a_host_is_an_ip_address():
    given = ("127.0.0.1", "localhost", "::1", "0.0.0.0", "192.168.0.2")
    expected = ["127.0.0.1", "127.0.0.1", "::1", "0.0.0.0", "192.168.0.2"]
    assert [parse_host(host) for host in given] == expected
    for host in ("example.org", ""):
        with pytest.raises(InputError, match="IP address of this computer"):
            parse_host(host)


def connect_as_page(port, path, **headers):
    """Open the WebSocket that viser's page opens."""
    subprotocol = Subprotocol(f"viser-v{viser.__version__}")
    place = f"ws://127.0.0.1:{port}{path}"
    return connect(place, additional_headers=headers, subprotocols=[subprotocol], compression=None)


class Opened:
    """A server, and what comes back from it."""

    def __init__(self, host="127.0.0.1"):
        self.server, self.address = start_server(host=host)
        self.port = self.server.get_port()
        self.own = f"127.0.0.1:{self.port}"
        place, _, self.token = self.address.partition("?token=")
        assert urlsplit(place).port == self.port
        self.cookie = f"tofclip-{self.port}={self.token}"

    def get(self, path, **headers):
        """Ask for a page; the path goes out as it is."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        connection.putrequest("GET", path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        return connection.getresponse()

    def open_socket(self, path, **headers):
        """Ask for a WebSocket: the status, and the scene has to come where it is let in."""
        try:
            with connect_as_page(self.port, path, **headers) as connection:
                connection.recv(timeout=10)
                return 101
        except InvalidStatus as fault:
            return fault.response.status_code


@pytest.fixture(scope="module")
def opened():
    started = Opened()
    yield started
    stop_server(started.server)


def test_the_token_is_asked_for(opened):
    right, wrong = f"/?token={opened.token}", f"/?token={opened.token[:-1]}"
    page = opened.get(right)
    assert page.status == 200
    assert b"<html" in page.read()
    assert opened.open_socket(right) == 101
    for path in ("/", wrong, "/?token=", "/?token=%ff%7f", f"/{opened.token}"):
        refused = opened.get(path)
        assert (refused.status, refused.getheader("Set-Cookie")) == (403, None)
        assert b"address that tofclip printed" in refused.read()
    assert opened.open_socket("/") == 403
    assert opened.open_socket(wrong) == 403


def test_the_cookie_of_the_first_load_stands_for_the_token(opened):
    first = opened.get(f"/?token={opened.token}")
    given = first.getheader("Set-Cookie", "").split("; ")
    assert given == [opened.cookie, "Path=/", "HttpOnly", "SameSite=Strict"]
    other = f'odd="a, @[]; {opened.cookie}; tofclip-1=1'  # of another server of this computer
    assert opened.get("/", Cookie=other).status == 200
    assert opened.open_socket("/", Cookie=other) == 101
    for cookie in (f"{opened.cookie}x", f"tofclip-1={opened.token}", opened.token):
        assert opened.get("/", Cookie=cookie).status == 403
        assert opened.open_socket("/", Cookie=cookie) == 403


def test_another_port_of_a_tunnel_has_a_cookie_of_its_own(opened):
    path, there = f"/?token={opened.token}", "localhost:9123"
    (given, *_) = opened.get(path, Host=there).getheader("Set-Cookie", "").split("; ")
    assert given == f"tofclip-9123={opened.token}"
    assert opened.get("/", Host=there, Cookie=given, Origin=f"http://{there}").status == 200


def test_pages_of_other_servers_and_other_names_are_refused(opened):
    """Even with the token, or the cookie that the browser sends along."""
    path = f"/?token={opened.token}"
    for origin in (EVIL, "null", "http://127.0.0.1:1", f"http://localhost:{opened.port}"):
        assert opened.get(path, Origin=origin).status == 403
        assert opened.open_socket("/", Cookie=opened.cookie, Origin=origin) == 403
    assert opened.open_socket("/", Cookie=opened.cookie, Origin=f"http://{opened.own}") == 101
    for host in (f"evil.example:{opened.port}", "203.0.113.7", "", "[::1", "localhost:x"):
        assert opened.get(path, Host=host).status == 403
    for host in (f"localhost:{opened.port}", "[::1]", "LOCALHOST"):
        assert opened.get(path, Host=host).status == 200


def test_a_page_for_all_computers_is_guarded_as_well():
    """By any address of this computer, but by no name that another's DNS may have given it."""
    everywhere = Opened("0.0.0.0")
    try:
        path = f"/?token={everywhere.token}"
        named = urlsplit(everywhere.address).netloc
        assert not named.startswith("0.0.0.0")
        for host in (named, "203.0.113.7:8080", everywhere.own):
            assert everywhere.get(path, Host=host).status == 200
        assert everywhere.get(path, Host="evil.example").status == 403
        assert everywhere.get("/").status == 403
        assert everywhere.open_socket("/") == 403
    finally:
        stop_server(everywhere.server)


def test_it_serves_no_other_files(opened):
    page = opened.get("/", Cookie=opened.cookie).read()
    for path in ("/../../../../etc/passwd", "/%2e%2e/%2e%2e/client/package.json"):
        answer = opened.get(path, Cookie=opened.cookie)
        assert answer.status >= 400 or answer.read() == page


def test_who_came_before_the_guard_is_sent_away(monkeypatch):
    early = []

    def install(port, is_local):
        early.append(connect_as_page(port, "/"))
        return install_guard(port, is_local)

    monkeypatch.setattr(served, "install_guard", install)
    server, _ = start_server()
    try:
        with pytest.raises(ConnectionClosed):
            receive_all(early[0])
    finally:
        stop_server(server)


def receive_all(connection):
    """Receive until nothing comes for a while."""
    while True:
        connection.recv(timeout=10)


@pytest.mark.parametrize("passes_all", [True, False])
def test_a_viser_that_asks_no_guard_is_not_served(passes_all, monkeypatch):
    if passes_all:
        monkeypatch.setattr(Guard, "__call__", lambda guard, *asked: guard._serve(*asked))
    else:
        monkeypatch.setattr("gc.get_objects", list)
    stopped = []
    monkeypatch.setattr(
        served, "stop_server", lambda one: stopped.append(one.get_port()) or stop_server(one)
    )
    with pytest.raises(MissingDependencyError, match="show the page to everybody"):
        start_server()
    with pytest.raises(ConnectionRefusedError):
        http.client.HTTPConnection("127.0.0.1", stopped[0], timeout=10).request("GET", "/")


def test_it_opens_no_tunnel_to_the_internet(opened):
    assert opened.server.request_share_url() is None


def test_a_port_that_is_taken(opened):
    with pytest.raises(InputError, match="cannot listen"):
        start_server(opened.port)
    with pytest.raises(InputError, match="cannot listen"):
        start_server(host="203.0.113.7")
