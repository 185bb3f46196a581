"""A connection to a loopback server that misbehaves on request."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from devices.tcp import TcpLink
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    ProtocolError,
)

SOON = 0.05
LONG = 5.0


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening


@pytest.fixture
def ends(server: socket.socket) -> Iterator[tuple[TcpLink, socket.socket]]:
    with TcpLink("127.0.0.1", server.getsockname()[1], LONG) as link:
        other, _ = server.accept()
        with other:
            yield link, other


def test_messages_are_cut_where_they_end(ends: tuple[TcpLink, socket.socket]) -> None:
    link, other = ends
    other.sendall(b"RemoteEx Ready\r0,App")
    assert link.read_until(b"\r", 100, LONG) == b"RemoteEx Ready"
    assert link.read_exactly(2, 10, LONG) == b"0,"
    assert link.read_available(2, LONG) == b"Ap"
    assert link.read_available(100, LONG) == b"p"
    link.send(b"x", LONG)
    assert other.recv(10) == b"x"


def test_what_came_before_a_timeout_is_kept(ends: tuple[TcpLink, socket.socket]) -> None:
    link, other = ends
    other.sendall(b"half")
    with pytest.raises(DeviceTimeoutError):
        link.read_exactly(8, 8, SOON)
    with pytest.raises(DeviceTimeoutError):
        link.read_until(b"!", 100, SOON)
    other.sendall(b"done!")
    assert link.read_until(b"!", 100, LONG) == b"halfdone"
    with pytest.raises(DeviceTimeoutError):
        link.read_available(1, SOON)


@pytest.mark.parametrize("length", [-1, 11, 1 << 60])
def test_a_length_from_the_wire_is_bounded(
    ends: tuple[TcpLink, socket.socket], length: int
) -> None:
    with pytest.raises(ProtocolError, match="at most 10"):
        ends[0].read_exactly(length, 10, LONG)


def test_a_message_without_end_is_not_collected_for_ever(
    ends: tuple[TcpLink, socket.socket],
) -> None:
    link, other = ends
    other.sendall(b"x" * 500)
    with pytest.raises(ProtocolError, match="without the end"):
        link.read_until(b"\r", 100, LONG)


def test_a_server_that_leaves_is_noticed(ends: tuple[TcpLink, socket.socket]) -> None:
    link, other = ends
    other.close()
    with pytest.raises(DeviceDisconnectedError, match="closed"):
        link.read_available(1, LONG)
    link.close()
    with pytest.raises(DeviceDisconnectedError):
        link.send(b"x", LONG)


def test_nobody_there_is_said_so(server: socket.socket) -> None:
    port = server.getsockname()[1]
    server.close()
    with pytest.raises(DeviceNotFoundError, match=f"127.0.0.1:{port}"):
        TcpLink("127.0.0.1", port, LONG)
    with pytest.raises(DeviceNotFoundError):
        TcpLink("no.such.host.invalid", 1001, LONG)
