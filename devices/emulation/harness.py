"""What emulated instruments share: faults to order, a TCP server that nothing but this computer can
reach, and drivers' feeds on instruments of software.

The drivers do not know the difference; all of their code runs.
"""

from __future__ import annotations

import contextlib
import re
import socket
import socketserver
import threading
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

from devices.stream import Feed, StreamOptions, StreamSource
from tofclip.errors import InputError, require
from tofclip.storage import Record

REPLY_FAULTS = ("reply_late", "reply_lost", "reply_stall")
FAULT_KINDS = (
    *("timeout", "stall", "unplug", "powerloss", "short", "overflow", "corrupt", "lost"),
    *REPLY_FAULTS,
)
_FAULT = re.compile(r"(\w+)@(\d+)(?::(\d*))?", re.ASCII)


@dataclass(frozen=True)
class Fault:
    """One fault."""

    # number of the data transfer in which it happens, from 0 since the instrument was first
    # started, without those by which old data is thrown away; or of the reply, from 0 since it was
    # switched on
    transfer: int
    # ``timeout``: nothing comes. ``stall``: the endpoint halts, `amount` times in a row.
    # ``unplug``: gone for `amount` enumerations, keeping its power; ``powerloss``: without.
    # ``short``: only `amount` bytes come now. ``overflow``: the transfer is lost on the wire.
    # ``corrupt``: `amount` records cannot be. ``lost``: `amount` records find the instrument's
    # memory full. ``reply_late``: a reply comes only after the host has given up. ``reply_lost``:
    # it never comes. ``reply_stall``: its endpoint halts once
    kind: str
    amount: int = 1

    @classmethod
    def parse(cls, text: str) -> tuple[Fault, ...]:
        """Read ``kind@transfer`` or ``kind@transfer:amount``, joined by commas."""
        faults = []
        for word in filter(None, text.split(",")):
            found = _FAULT.fullmatch(word)
            if found is None or found[1] not in FAULT_KINDS:
                raise InputError(
                    f"'{word}' is not a fault; write KIND@TRANSFER:AMOUNT with one of {', '.join(FAULT_KINDS)}"
                )
            faults.append(cls(int(found[2]), found[1], int(found[3] or 1)))
        return tuple(faults)


def index_faults(faults: Sequence[Fault], kinds: Collection[str]) -> dict[int, Fault]:
    """Return faults by the number of what they spoil; others than these `kinds` are refused."""
    for fault in faults:
        require(fault.kind in kinds, f"its faults are {', '.join(kinds)}, not {fault.kind}")
    return {fault.transfer: fault for fault in faults}


HOST = "127.0.0.1"
FOREVER = 1 << 62  # Pictures or records after which it is dark: never
FAULT_DELAY_S = 0.1  # Seconds by which a fault of amount 1 delays an answer
MAX_REQUEST_BYTES = 1 << 16


class Connection:
    """A client's end, as the server sees it; it ends for both when the server closes."""

    def __init__(self, link: socket.socket) -> None:
        self._link, self._buffer = link, b""
        self._sending = threading.Lock()

    def send(self, data: bytes) -> None:
        """Send all of `data`, however long the client takes, unless it goes away."""
        with self._sending, contextlib.suppress(OSError):
            self._link.sendall(data)

    def read_request(self, end: bytes) -> bytes | None:
        """Return what came up to `end`, None when the client is gone or says too much."""
        while end not in self._buffer:
            came = self.read_available()
            if came is None or len(self._buffer) > MAX_REQUEST_BYTES:
                return None
            self._buffer += came
        request, _, self._buffer = self._buffer.partition(end)
        return request

    def read_available(self) -> bytes | None:
        """Return what came at once, None when the client is gone."""
        with contextlib.suppress(OSError):
            return self._link.recv(4096) or None
        return None

    def close(self) -> None:
        """Hang up; the client sees the end of the stream."""
        hang_up(self._link)


def hang_up(link: socket.socket) -> None:
    """End a connection, also for a thread that waits for it, which closing would not."""
    with contextlib.suppress(OSError):
        link.shutdown(socket.SHUT_RDWR)


class LoopbackServer(socketserver.ThreadingTCPServer):
    """Listens on a free port of 127.0.0.1 and calls `serve` with each new `Connection`, on a thread
    of its own; when it returns the connection is closed.
    """

    daemon_threads = True

    def __init__(self, serve: Callable[[Connection], None]) -> None:
        self._serve = serve
        self._links: list[socket.socket] = []
        super().__init__((HOST, 0), socketserver.BaseRequestHandler)  # 0: the system chooses
        self.port: int = self.server_address[1]
        threading.Thread(target=self.serve_forever, args=(0.03,), daemon=True).start()

    def get_request(self) -> tuple[socket.socket, object]:
        link, address = super().get_request()
        # Short answers leave at once, instead of waiting for more (Nagle).
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._links.append(link)
        return link, address

    def finish_request(self, request: object, client_address: object) -> None:
        assert isinstance(request, socket.socket)
        self._serve(Connection(request))

    def close_connections(self) -> None:
        """Close all connections; clients may come again."""
        while self._links:
            hang_up(self._links.pop())

    def close(self) -> None:
        self.shutdown()
        self.server_close()
        self.close_connections()

    def __exit__(self, *_: object) -> None:
        self.close()


def open_on(
    instrument: Any,
    connect: Callable[[], Feed],
    options: StreamOptions,
    describe: Callable[[Record | None], Record | None] = lambda known: known,
) -> StreamSource:
    """Open a driver's feed on an instrument of software, which is switched off with it. `describe`:
    from the calibration that the driver knows to that of the scene.
    """
    try:
        feed = connect()
        feed.info = replace(feed.info, instrument=f"emulated {feed.info.instrument}")
        feed.calibration = describe(feed.calibration)
        return StreamSource(feed, options, instrument.close)
    except BaseException:
        instrument.close()
        raise
