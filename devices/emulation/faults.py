"""Faults to order: what goes wrong, and in which transfer.

A TCP server for emulated instruments, which nothing but this computer can reach.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Self, get_args

import numpy as np

from tofclip.errors import InputError

FaultKind = Literal[
    "timeout",
    "stall",
    "unplug",
    "powerloss",
    "short",
    "overflow",
    "corrupt",
    "lost",
    "reply_late",
    "reply_lost",
    "reply_stall",
]
FAULT_KINDS: tuple[FaultKind, ...] = get_args(FaultKind)
REPLY_FAULTS = ("reply_late", "reply_lost", "reply_stall")

PERMANENT_ENUMERATIONS = 1_000_000
"""Enumerations after which nothing looks any more."""


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
    kind: FaultKind
    amount: int = 1

    @classmethod
    def parse(cls, text: str) -> tuple[Fault, ...]:
        """Read ``kind@transfer`` or ``kind@transfer:amount``, joined by commas."""
        return tuple(cls._parse_one(word) for word in text.split(",") if word)

    @classmethod
    def _parse_one(cls, word: str) -> Fault:
        kind, _, rest = word.partition("@")
        transfer, _, amount = rest.partition(":")
        known = next((known for known in FAULT_KINDS if known == kind), None)
        if known is None or not transfer.isdecimal() or not (amount or "1").isdecimal():
            raise InputError(
                f"'{word}' is not a fault; write KIND@TRANSFER:AMOUNT with one of {', '.join(FAULT_KINDS)}"
            )
        return cls(int(transfer), known, int(amount or 1))


def draw_fault_script(seed: int, transfers: int) -> tuple[Fault, ...]:
    """Draw up to six faults of any kind, at most one per transfer, within the first `transfers`.

    Returns in the order of the transfers.
    """
    rng = np.random.default_rng(seed)
    # without repeats: one fault for a transfer
    when = rng.permutation(transfers)[: rng.integers(0, 7)]
    return tuple(Fault(int(transfer), *_draw_fault(rng)) for transfer in sorted(when))


def _draw_fault(rng: np.random.Generator) -> tuple[FaultKind, int]:
    kind = FAULT_KINDS[rng.integers(len(FAULT_KINDS))]
    if kind in ("stall", "unplug", "powerloss"):
        often = int(rng.choice([1, 2], p=[0.85, 0.15]))
        if kind == "stall" or often == 1:
            return kind, often
        # Rarely the instrument never comes back.
        return kind, PERMANENT_ENUMERATIONS
    if kind in REPLY_FAULTS:
        return kind, int(rng.integers(1, 4))
    return kind, int(rng.integers(0, 600))


HOST = "127.0.0.1"
POLL_INTERVAL_S = 0.03
"""Seconds after which a waiting thread looks whether the server has closed."""

MAX_REQUEST_BYTES = 1 << 16


class Connection:
    """A client's end, as the server sees it."""

    def __init__(self, link: socket.socket, closing: threading.Event) -> None:
        self._link, self._closing = link, closing
        self._buffer = b""
        self._sending = threading.Lock()
        link.settimeout(POLL_INTERVAL_S)

    def send(self, data: bytes) -> None:
        """Send all of `data`, however long the client takes, unless it goes away or the server
        closes.
        """
        left = memoryview(data)
        with self._sending:
            while left and not self._closing.is_set():
                try:
                    left = left[self._link.send(left) :]
                except TimeoutError:
                    continue
                except OSError:
                    return

    def read_request(self, end: bytes) -> bytes | None:
        """Return what came up to `end`, None when the client is gone, says too much, or the server
        closes.
        """
        while end not in self._buffer:
            if self._closing.is_set() or len(self._buffer) > MAX_REQUEST_BYTES:
                return None
            try:
                came = self._link.recv(4096)
            except TimeoutError:
                continue
            except OSError:
                return None
            if not came:
                return None
            self._buffer += came
        request, _, self._buffer = self._buffer.partition(end)
        return request

    def read_available(self) -> bytes | None:
        """Return what came at once, None when the client is gone or the server closes."""
        while not self._closing.is_set():
            try:
                return self._link.recv(4096) or None
            except TimeoutError:
                continue
            except OSError:
                break
        return None

    def close(self) -> None:
        """Hang up; the client sees the end of the stream."""
        with contextlib.suppress(OSError):
            self._link.shutdown(socket.SHUT_RDWR)
        self._link.close()


class LoopbackServer:
    """Listens on a free port of 127.0.0.1 and serves each client on a thread of its own.

    `serve`: called with each new `Connection`; when it returns the connection is closed.
    """

    def __init__(self, serve: Callable[[Connection], None]) -> None:
        self._serve = serve
        self._closing = threading.Event()
        # Port 0: the system chooses a free one.
        self._listener = socket.create_server((HOST, 0))
        self._listener.settimeout(POLL_INTERVAL_S)
        self.port: int = self._listener.getsockname()[1]
        self._connections: list[Connection] = []
        self._threads = [
            threading.Thread(target=self._accept, name="emulated instrument", daemon=True)
        ]
        self._threads[0].start()

    def close_connections(self) -> None:
        """Close all connections; clients may come again."""
        for connection in self._connections:
            connection.close()
        self._connections.clear()

    def close(self) -> None:
        """Stop serving; closing twice is fine."""
        self._closing.set()
        self._listener.close()
        self.close_connections()
        for thread in self._threads:
            # A handler may close the server; a thread cannot join itself.
            if thread is not threading.current_thread():
                thread.join(2)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        fault: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _accept(self) -> None:
        while not self._closing.is_set():
            try:
                link, _ = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            # Short answers leave at once, instead of waiting for more (Nagle).
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection = Connection(link, self._closing)
            self._connections.append(connection)
            thread = threading.Thread(
                target=self._run, args=(connection,), name="emulated instrument", daemon=True
            )
            self._threads.append(thread)
            thread.start()

    def _run(self, connection: Connection) -> None:
        try:
            self._serve(connection)
        finally:
            connection.close()
