"""TCP: a connection to an instrument's server, with bounded waiting, bounded lengths and our exceptions."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from time import monotonic
from types import TracebackType
from typing import Self

from tofclip.errors import DeviceDisconnectedError, DeviceError, DeviceNotFoundError, DeviceTimeoutError, ProtocolError

PIECE = 1 << 18
"""Most bytes taken from the system at once."""


class TcpLink:
    """A connection to a server. Not for two threads at once.

    Parameters
    ----------
    host : str
    port : int
    timeout : float
        Seconds to wait for the connection.

    Raises
    ------
    DeviceNotFoundError
        Nobody answers there.
    DeviceTimeoutError
        Nobody answers in time.
    """

    def __init__(self, host: str, port: int, timeout: float) -> None:
        self.name = f"{host}:{port}"
        self._held = bytearray()
        with self._translated():
            try:
                self._socket = socket.create_connection((host, port), timeout)
            except TimeoutError:
                raise
            except OSError as fault:
                reason = fault.strerror or fault
                raise DeviceNotFoundError(
                    f"nobody answers at {self.name} ({reason}); is its program running?"
                ) from fault
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes, timeout: float) -> None:
        """Send all of `data`."""
        with self._translated():
            self._socket.settimeout(timeout)
            self._socket.sendall(data)

    def some(self, limit: int, timeout: float) -> bytes:
        """Return what came, at least 1 and at most `limit` bytes.

        Raises
        ------
        DeviceTimeoutError, DeviceDisconnectedError
        """
        if not self._held:
            self._fill(monotonic() + timeout, timeout)
        return self._taken(min(limit, len(self._held)))

    def exactly(self, length: int, limit: int, timeout: float) -> bytes:
        """Return `length` bytes, a length that came from the wire and is bounded before anything is held for it.

        Raises
        ------
        ProtocolError
            `length` is negative or beyond `limit`.
        DeviceTimeoutError, DeviceDisconnectedError
            What came in time stays for the next call.
        """
        if not 0 <= length <= limit:
            raise ProtocolError(f"{self.name} announced {length} bytes; at most {limit} are possible")
        deadline = monotonic() + timeout
        while len(self._held) < length:
            self._fill(deadline, timeout)
        return self._taken(length)

    def until(self, end: bytes, limit: int, timeout: float) -> bytes:
        """Return everything up to `end`, which is taken off.

        Raises
        ------
        ProtocolError
            `end` is not among the next `limit` bytes.
        DeviceTimeoutError, DeviceDisconnectedError
            What came in time stays for the next call.
        """
        deadline = monotonic() + timeout
        searched = 0
        while (found := self._held.find(end, searched)) < 0:
            if len(self._held) > limit:
                raise ProtocolError(f"{self.name} sent {len(self._held)} bytes without the end of a message")
            searched = max(0, len(self._held) - len(end) + 1)
            self._fill(deadline, timeout)
        message = self._taken(found)
        self._taken(len(end))
        return message

    def close(self) -> None:
        """Close the connection; closing twice is fine."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _taken(self, length: int) -> bytes:
        taken = bytes(self._held[:length])
        del self._held[:length]
        return taken

    def _fill(self, deadline: float, timeout: float) -> None:
        """Wait for more, until `deadline`."""
        with self._translated():
            left = deadline - monotonic()
            if left <= 0:
                raise DeviceTimeoutError(f"{self.name} sent nothing for {timeout:g} s")
            self._socket.settimeout(left)
            came = self._socket.recv(PIECE)
        if not came:
            raise DeviceDisconnectedError(f"{self.name} closed the connection")
        self._held += came

    @contextlib.contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except DeviceError:
            raise
        except TimeoutError as fault:
            raise DeviceTimeoutError(f"{self.name} did not answer in time") from fault
        except OSError as fault:
            raise DeviceDisconnectedError(f"the connection to {self.name} broke: {fault.strerror or fault}") from fault
