"""The page's server: for this computer only."""

from __future__ import annotations

import http.client
from collections.abc import Iterator

import pytest

from apps.viewer.server import get_address, parse_loopback, start_server, stop_server
from tofclip.errors import InputError

viser = pytest.importorskip("viser")


def test_addresses_that_other_computers_reach_are_refused() -> None:
    assert [parse_loopback(host) for host in ("127.0.0.1", "localhost", "::1", "127.0.0.9")] == [
        "127.0.0.1",
        "127.0.0.1",
        "::1",
        "127.0.0.9",
    ]
    for host in ("0.0.0.0", "192.168.0.2", "::", "example.org", ""):
        with pytest.raises(InputError, match="ssh -L 8080:localhost:8080"):
            parse_loopback(host)


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    started = start_server()
    yield started
    stop_server(started)


def get(port: int, path: str) -> tuple[int, bytes]:
    """Ask for a page; the path goes out as it is."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", path)
    connection.endheaders()
    answer = connection.getresponse()
    found = answer.status, answer.read()
    connection.close()
    return found


def test_it_serves_the_page_and_no_other_files(server: viser.ViserServer) -> None:
    port = server.get_port()
    status, page = get(port, "/")
    assert status == 200
    assert b"<html" in page
    for path in ("/../../../../etc/passwd", "/%2e%2e/%2e%2e/client/package.json"):
        status, text = get(port, path)
        assert status >= 400 or text == page
    assert get_address(server) == f"http://127.0.0.1:{port}/"
    assert get_address(server, "::1") == f"http://[::1]:{port}/"


def test_it_opens_no_tunnel_to_the_internet(server: viser.ViserServer) -> None:
    assert server.request_share_url() is None


def test_a_port_that_is_taken(server: viser.ViserServer) -> None:
    with pytest.raises(InputError, match="cannot listen"):
        start_server(server.get_port())
    with pytest.raises(InputError, match="cannot listen"):
        start_server(host="203.0.113.7")
