"""A TCP instrument of one's own, all of it in this file: 32 x 32 histograms of 128 bins, each picture
behind a header of 8 bytes, its number and the bytes that follow. Registered, or offered as an
entry point `tofclip.sources`, every verb has it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from time import monotonic

import numpy as np

from devices.address import Uri, option
from devices.frames import FrameCodec, FrameFeed
from devices.source import Info
from devices.stream import LiveOptions, StreamSource, Transfer
from devices.tcp import TcpLink
from tofclip.camera import Camera
from tofclip.errors import DeviceDisconnectedError, ProtocolError
from tofclip.storage import Field, Record

SIDE, BINS, BIN_S = 32, 128, 250e-12
HEADER = struct.Struct("<II")
PICTURE_BYTES = SIDE * SIDE * BINS * 2


@dataclass(frozen=True)
class HistogramOptions(LiveOptions):
    """Values of the address."""

    timeout_s: float = option(5.0, above=0)


class HistogramFeed(FrameFeed):
    """Pictures as the server sends them from when one connects."""

    codec = FrameCodec(SIDE * SIDE, BINS, 16)  # pixel after pixel, its bins side by side

    def __init__(self, host: str, port: int, options: HistogramOptions) -> None:
        super().__init__()
        self._place, self._options, self._is_stopped = (host, port), options, False
        self._connect()
        shape = {"rows": SIDE, "columns": SIDE, "bins": BINS, "bin_width_s": BIN_S}
        self.info = Info("histogram array", "", {"address": self._link.name, **shape})
        # When each bin is, which picture the histograms make, and where it looks
        fields = {
            "bin_times": Field(BIN_S * (np.arange(BINS) + 0.5), "s", ("bin",)),
            "image_shape": Field(np.array([SIDE, SIDE]), "px", ("yx",)),
        }
        camera = Camera.pinhole((SIDE, SIDE), 40.0, pulse_fwhm=700e-12).to_record()
        self.calibration = Record("histograms", fields, {"axes": "yxt"}, {"camera": camera})

    def pull(self, timeout: float) -> Transfer | None:
        deadline = monotonic() + timeout
        while not self._is_stopped:
            try:
                if self._header is None:
                    wait = max(deadline - monotonic(), 0.0)
                    header = self._link.read_exactly(HEADER.size, HEADER.size, wait)
                    self._header = HEADER.unpack(header)
                number, size = self._header
                if size != PICTURE_BYTES:
                    raise ProtocolError(f"{self._link.name} announced a picture of {size} bytes")
                pixels = self._link.read_exactly(size, PICTURE_BYTES, self._options.timeout_s)
            except DeviceDisconnectedError:
                self._link.close()
                self._reconnect(self._connect, self._options.reconnect_s)
                continue
            self._header = None
            self._lose(number - self._number)
            self._number = number + 1
            return self._hand_over(number, pixels)
        return None

    def stop(self) -> None:
        self._is_stopped = True

    def close(self) -> None:
        self._link.close()

    def _connect(self) -> None:
        self._header: tuple[int, int] | None = None
        self._link = TcpLink(*self._place, self._options.timeout_s)


def open_histograms(uri: Uri) -> StreamSource:
    """Open ``histograms://HOST:PORT``."""
    options = HistogramOptions.from_uri(uri)
    host, _, port = uri.location.partition(":")
    return StreamSource(HistogramFeed(host, int(port), options), options)
