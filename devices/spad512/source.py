"""A SPAD array over TCP as a source of frames."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from time import monotonic

from devices.ledger import Ledger
from devices.persistence import persistently
from devices.ring import Gap
from devices.source import Info
from devices.spad512.protocol import DONE, ERROR, LONGEST_TEXT, PORT, Exposure
from devices.stream import Arrival, StreamSource
from devices.stream_options import OPTIONS as STREAM_OPTIONS
from devices.stream_options import buffering, seconds
from devices.tcp import TcpLink
from devices.uri import Uri
from tofclip.errors import DeviceDisconnectedError, DeviceError, DeviceTimeoutError, ProtocolError
from tofclip.storage import Record

INSTRUMENT = "SPAD512 array"
OPTIONS = ("bits", "exposure_us", "images", "width", "pile_up", "timeout_s", "reconnect_s", *STREAM_OPTIONS)

_QUIET = 0.2
"""Seconds after which a text of unknown length has ended."""

Connect = Callable[[], TcpLink]


class Spad512Feed:
    """One picture after the other; see `devices.stream.Feed`.

    Pictures are asked for a request at a time, and a request that finds no answer in time is not sent again.

    Parameters
    ----------
    connect : callable
        Returns a new connection.
    ledger : Ledger
    exposure : Exposure
    patience, reconnect : float
        Seconds to wait for an answer beyond the exposure, and for a server that went away.
    """

    def __init__(self, connect: Connect, ledger: Ledger, exposure: Exposure, patience: float, reconnect: float) -> None:
        self._connect, self._ledger, self._exposure = connect, ledger, exposure
        self._patience, self._reconnect_time = patience, reconnect
        self.codec = exposure.codec
        self._number, self._due, self._gap = 0, 0, Gap.NONE
        self._came = bytearray()
        self._stopped = False
        self._begin()

    @property
    def info(self) -> Info:
        return Info(
            INSTRUMENT,
            "",
            {
                "greeting": self._greeting,
                "bits": self._exposure.bits,
                "exposure_s": self._exposure.seconds,
                "rows": self.codec.rows,
                "columns": self.codec.columns,
            },
        )

    @property
    def calibration(self) -> Record | None:
        """Nothing: a picture has no time axis."""
        return None

    def start(self) -> None:
        """Do nothing: the first request starts the instrument."""

    def pull(self, timeout: float) -> Arrival | None:
        while True:
            if self._due == 0:
                if self._stopped:
                    return None
                self._request()
            try:
                return self._picture(timeout)
            except DeviceDisconnectedError:
                self._reconnect()

    def stop(self) -> None:
        self._stopped = True

    def close(self) -> None:
        self._break_off()
        self._link.close()

    def _begin(self) -> None:
        self._link = link = self._connect()
        try:
            self._greeting = self._text(self._patience)
            link.send(self._exposure.encode_pile_up(), self._patience)
            self._text(self._patience)
        except BaseException:
            link.close()
            raise

    def _text(self, patience: float) -> str:
        """Return a text of unknown length: what comes until it is quiet."""
        text = self._link.some(LONGEST_TEXT, patience)
        with contextlib.suppress(DeviceTimeoutError):
            while len(text) < LONGEST_TEXT:
                text += self._link.some(LONGEST_TEXT - len(text), _QUIET)
        return text.decode("ascii", "replace").strip()

    def _request(self) -> None:
        self._link.send(self._exposure.encode(), self._patience)
        self._due = self._exposure.images
        self._deadline = monotonic() + self._exposure.seconds + self._patience

    def _picture(self, timeout: float) -> Arrival:
        """Return the next picture; with the last one of a request comes the end of the answer."""
        is_last = self._due == 1
        length = self.codec.pixel_bytes + (len(DONE) if is_last else 0)
        self._fill(length, timeout)
        pixels, end = bytes(self._came[: self.codec.pixel_bytes]), bytes(self._came[self.codec.pixel_bytes :])
        if is_last and end != DONE:
            raise ProtocolError(f"the SPAD array's answer ended in {end!r}, expected {DONE!r}; is its width another?")
        self._came.clear()
        self._due -= 1
        self._deadline = monotonic() + self._exposure.seconds + self._patience
        self._number += 1
        gap, self._gap = self._gap, Gap.NONE
        return Arrival(memoryview(self.codec.numbered(self._number - 1, pixels)), gap)

    def _fill(self, length: int, timeout: float) -> None:
        """Wait until `length` bytes came, a length that was computed, not told; what came in time is kept."""
        deadline = monotonic() + timeout
        while len(self._came) < length:
            try:
                self._came += self._link.some(length - len(self._came), max(deadline - monotonic(), 0))
            except DeviceTimeoutError:
                self._require_no_error()
                raise

    def _require_no_error(self) -> None:
        """Raise what the server says instead of a picture, or that it says nothing at all."""
        if self._came.endswith(ERROR) and self._came.isascii():
            said = self._came[-160:].decode("ascii").strip()
            raise DeviceError(f"the SPAD array could not take pictures: {' '.join(said.split())}")
        if monotonic() > self._deadline:
            raise DeviceDisconnectedError(f"the SPAD array sent nothing for {self._patience:g} s beyond the exposure")

    def _reconnect(self) -> None:
        self._break_off()
        self._link.close()
        persistently(self._begin, self._reconnect_time)
        self._ledger.reconnect()
        self._gap = Gap.RESTART

    def _break_off(self) -> None:
        """Enter a picture of which only a part came; of those that never began nobody knows whether they were taken."""
        if self._came:
            self._ledger.break_off()
        self._due = 0
        self._came.clear()


def open_spad512(uri: Uri) -> StreamSource:
    """Open ``spad512://HOST:9999?bits=8&exposure_us=1000&images=1&width=512&pile_up=0&timeout_s=5&reconnect_s=5``."""
    uri.only(*OPTIONS)
    host, port = uri.host_and_port(PORT)
    patience, back = waiting(uri)
    held, ledger = buffering(uri), Ledger()
    feed = Spad512Feed(lambda: TcpLink(host, port, patience), ledger, exposure_of(uri), patience, back)
    return StreamSource(feed, feed.codec, ledger, held)


def exposure_of(uri: Uri) -> Exposure:
    """Read the values of an address that say what pictures to take."""
    standard = Exposure()
    return Exposure(
        uri.value("bits", int, standard.bits),
        uri.value("exposure_us", float, standard.seconds * 1e6) * 1e-6,
        uri.value("images", int, standard.images),
        uri.value("width", int, standard.width),
        uri.choice("pile_up", "0", "1") == "1",
    )


def waiting(uri: Uri) -> tuple[float, float]:
    """Read how long to wait for an answer and for a server that went away, s."""
    return seconds(uri, "timeout_s", 5.0), seconds(uri, "reconnect_s", 5.0)
