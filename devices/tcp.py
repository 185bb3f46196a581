"""TCP: a connection to an instrument's server, with bounded waiting (s), bounded lengths (bytes) and our
exceptions.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from time import monotonic

from devices.source import Closing
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    ProtocolError,
)

RECEIVE_BYTES = 1 << 18  # Most bytes taken from the system at once


class TcpLink(Closing):
    """A connection to a server. Not for two threads at once."""

    def __init__(self, host: str, port: int, timeout: float) -> None:
        self.name = f"{host}:{port}"
        self._buffer = bytearray()
        with self._translate_errors():
            try:
                self._socket = socket.create_connection((host, port), timeout)
            except TimeoutError:
                raise
            except OSError as fault:
                reason = fault.strerror or fault
                raise DeviceNotFoundError(
                    f"no program answers at {self.name} ({reason}); is its program running?"
                ) from fault
        # Commands are short and wait for an answer: Nagle's algorithm would hold them back.
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes, timeout: float) -> None:
        with self._translate_errors():
            self._socket.settimeout(timeout)
            self._socket.sendall(data)

    def read_available(self, limit: int, timeout: float) -> bytes:
        """Return what came, at least 1 and at most `limit` bytes."""
        if not self._buffer:
            self._fill_buffer(monotonic() + timeout, timeout)
        return self._take_bytes(min(limit, len(self._buffer)))

    def read_exactly(self, length: int, limit: int, timeout: float) -> bytes:
        """Return `length` bytes; that came from the wire, so it is bounded first."""
        if not 0 <= length <= limit:
            raise ProtocolError(
                f"{self.name} announced {length} bytes; at most {limit} are possible"
            )
        deadline = monotonic() + timeout
        while len(self._buffer) < length:
            self._fill_buffer(deadline, timeout)
        return self._take_bytes(length)

    def read_until(self, end: bytes, limit: int, timeout: float) -> bytes:
        """Return everything up to `end`, which is taken off."""
        deadline = monotonic() + timeout
        searched = 0
        while (found := self._buffer.find(end, searched)) < 0:
            if len(self._buffer) > limit:
                raise ProtocolError(
                    f"{self.name} sent {len(self._buffer)} bytes without the end of a message"
                )
            # The end may be split between two receptions.
            searched = max(0, len(self._buffer) - len(end) + 1)
            self._fill_buffer(deadline, timeout)
        message = self._take_bytes(found)
        self._take_bytes(len(end))
        return message

    def discard_available(self) -> int:
        """Throw away what has come unasked, without waiting; return how many bytes."""
        thrown = len(self._buffer)
        self._buffer.clear()
        with contextlib.suppress(DeviceError), self._translate_errors():
            self._socket.settimeout(0)
            while came := self._socket.recv(RECEIVE_BYTES):
                thrown += len(came)
        return thrown

    def close(self) -> None:
        self._socket.close()

    def _take_bytes(self, length: int) -> bytes:
        with memoryview(self._buffer) as held:  # a slice of the buffer itself is one more copy
            taken = bytes(held[:length])
        del self._buffer[:length]
        return taken

    def _fill_buffer(self, deadline: float, timeout: float) -> None:
        """Wait for more, until `deadline`."""
        with self._translate_errors():
            left = deadline - monotonic()
            if left <= 0:
                raise DeviceTimeoutError(f"{self.name} sent nothing for {timeout:g} s")
            self._socket.settimeout(left)
            came = self._socket.recv(RECEIVE_BYTES)
        if not came:
            raise DeviceDisconnectedError(f"{self.name} closed the connection")
        self._buffer += came

    @contextlib.contextmanager
    def _translate_errors(self) -> Iterator[None]:
        try:
            yield
        except DeviceError:
            raise
        except TimeoutError as fault:
            raise DeviceTimeoutError(f"{self.name} did not answer in time") from fault
        except OSError as fault:
            raise DeviceDisconnectedError(
                f"the connection to {self.name} broke: {fault.strerror or fault}"
            ) from fault
