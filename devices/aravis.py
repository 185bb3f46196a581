"""Industrial cameras (GigE Vision, USB3 Vision) through the Aravis library, as a source of frames.

Aravis and its Python binding come with the system, not with pip: on Debian ``apt install
python3-gi gir1.2-aravis-0.8``. They are looked for when such a camera is asked for, also outside a
virtual environment where that has the same version of Python.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from time import monotonic
from typing import Any

import numpy as np

from devices.address import Uri, option
from devices.frames import FrameCodec, FrameFeed, GatedOptions, make_streak_calibration
from devices.registry import DiscoveredInstrument
from devices.source import Info
from devices.stream import StreamSource, Transfer
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    InputError,
    MissingDependencyError,
    ProtocolError,
)
from tofclip.units import NANOSECOND, PICOSECOND

PIXEL_BITS = {"Mono8": 8, "Mono10": 16, "Mono12": 16, "Mono14": 16, "Mono16": 16}
FRAME_ID_RANGE = 0xFFFF  # GigE Vision's 16-bit identifiers go from 1 to this, and then to 1 again
UNNUMBERED = (1 << 64) - 1  # An identifier that no frame has
HELD_BYTES, HELD_FRAMES = 64 << 20, (16, 256)
# What is asked for; the system gives less (``net.core.rmem_max`` of Linux)
SOCKET_BUFFER_BYTES = 16 << 20
PACKET_HEADER_BYTES = 36  # Of IP, UDP and GVSP, in each packet
SYSTEM_PACKAGES = ("/usr/lib/python3/dist-packages",)


@dataclass(frozen=True)
class CameraOptions(GatedOptions):
    """Values of an address that say how to acquire; None leaves the camera's own setting."""

    exposure_us: float | None = option(None, float, above=0, most=1e12)
    gain: float | None = option(None, float)  # in the camera's own unit, dB for most
    frame_rate: float | None = option(None, float, above=0, most=1e12)  # 1/s
    pixel_format: str = option("")  # as GenICam calls it; empty leaves the camera's
    # duration of a row where the camera looks at a streak tube's screen
    row_ps: float | None = option(None, float, above=0, most=1e12)
    # frames that Aravis holds while this program must wait; None: as many as fit into `HELD_BYTES`,
    # within `HELD_FRAMES`
    buffers: int | None = option(None, int, least=2, most=4096)
    # without any frame, after which the camera is asked whether it is there
    timeout_s: float = option(5.0, above=0, most=600)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pixel_format and self.pixel_format not in PIXEL_BITS:
            raise InputError(
                f"pixel_format must be one of {', '.join(PIXEL_BITS)}, not '{self.pixel_format}'"
            )


class AravisFeed(FrameFeed):
    """Frames in the order of their identifiers; see `devices.stream.Feed`.

    A frame of which packets are missing is malformed. A gap in the identifiers is lost by the camera
    or on the wire, except for frames that found no buffer in Aravis, which this program dropped, and
    for malformed ones whose first packet is missing: that is the one that brings the identifier, and
    so they are counted with the next frame that has one.

    `library`: Aravis; `place`: name or address of the camera, empty for the first one found;
    `prepare`: does what an emulated camera needs before its settings are made.
    """

    _camera: Any
    _stream: Any

    def __init__(
        self,
        library: Any,
        place: str,
        options: CameraOptions,
        prepare: Callable[[Any], None] = lambda camera: None,
    ) -> None:
        super().__init__()
        self._library, self._place, self._options = library, place, options
        self._prepare = prepare
        self._unnumbered = 0
        self._open_camera()
        with self._translate_errors():
            pixel_format = self._camera.get_pixel_format_as_string()
            _, _, width, height = self._camera.get_region()
        if pixel_format not in PIXEL_BITS:
            raise InputError(
                f"the camera sends {pixel_format}; choose pixel_format={' or '.join(PIXEL_BITS)}"
            )
        self.codec = FrameCodec(height, width, PIXEL_BITS[pixel_format])
        camera = self._camera
        with self._translate_errors():
            self.info = Info(
                f"{camera.get_vendor_name()} {camera.get_model_name()} (Aravis)",
                camera.get_device_serial_number() or "",
                {
                    "pixel_format": pixel_format,
                    "exposure_us": camera.get_exposure_time(),
                    "gain": camera.get_gain(),
                    "frame_rate": camera.get_frame_rate(),
                    "rows": height,
                    "columns": width,
                },
            )
        self.calibration = options.gate_record
        if options.row_ps is not None and not options.is_gated:
            times = (np.arange(height) + 0.5) * options.row_ps * PICOSECOND
            self.calibration = make_streak_calibration(times)

    def start(self) -> None:
        with self._translate_errors():
            payload = self._camera.get_payload()
            held = min(max(HELD_BYTES // payload, HELD_FRAMES[0]), HELD_FRAMES[1])
            for _ in range(self._options.buffers or held):
                self._offer_buffer(self._library.Buffer.new_allocate(payload))
            # Aravis counts packets of what finds no buffer.
            self._packets_per_frame = 1
            if self._camera.is_gv_device():
                carried = int(self._camera.gv_get_packet_size()) - PACKET_HEADER_BYTES
                self._packets_per_frame = -(-payload // carried) + 2
            self._camera.start_acquisition()
        self._running = True
        self._heard_at = monotonic()

    def pull(self, timeout: float) -> Transfer | None:
        deadline = monotonic() + timeout
        while True:
            wait_us = max(0.0, deadline - monotonic()) * 1e6
            buffer = self._stream.timeout_pop_buffer(int(wait_us))
            arrived_at = monotonic()
            if buffer is None:
                if not self._running:
                    self._count_unnumbered()
                    return None
                self._check_presence(arrived_at)
                raise DeviceTimeoutError("the camera sent nothing; is it triggered?")
            self._heard_at = arrived_at
            try:
                taken = self._take_frame(buffer, arrived_at)
            finally:
                self._offer_buffer(buffer)
            if taken is not None:
                return taken

    def stop(self) -> None:
        self._running = False
        with self._translate_errors():
            self._camera.stop_acquisition()

    def close(self) -> None:
        self._count_unnumbered()
        try:
            if self._running:
                self.stop()
        finally:
            # Letting go of the last reference closes the connection.
            self._stream = self._camera = None

    def _open_camera(self) -> None:
        options = self._options
        self._running = False
        self._last_id: int | None = None
        self._dropped = 0
        self._clock.reset()
        with self._translate_errors(DeviceNotFoundError):
            camera: Any = self._library.Camera.new(self._place or None)
        self._camera = camera
        with self._translate_errors(InputError):
            camera.set_acquisition_mode(self._library.AcquisitionMode.CONTINUOUS)
            self._prepare(camera)
            for change, value in (
                (camera.set_pixel_format_from_string, options.pixel_format or None),
                (camera.set_frame_rate, options.frame_rate),
                (camera.set_exposure_time, options.exposure_us),
                (camera.set_gain, options.gain),
            ):
                if value is not None:
                    change(value)
        with self._translate_errors():
            self._stream = camera.create_stream(None, None)
            if camera.is_gv_device():
                # By default one frame's worth, which a reader that is late for one overflows.
                fixed = self._library.GvStreamSocketBuffer.FIXED
                self._stream.set_property("socket-buffer", fixed)
                self._stream.set_property("socket-buffer-size", SOCKET_BUFFER_BYTES)

    def _offer_buffer(self, buffer: Any) -> None:
        """Let Aravis fill a buffer; it keeps the identifier that it has if the frame brings none."""
        buffer.set_frame_id(UNNUMBERED)
        self._stream.push_buffer(buffer)

    def _take_frame(self, buffer: Any, arrived_at: float) -> Transfer | None:
        """Enter a frame into the accounts; None where packets of it are missing."""
        status, frame_id = buffer.get_status(), buffer.get_frame_id()
        known = self._library.BufferStatus
        if status in (known.CLEARED, known.ABORTED):
            return None  # never filled: acquisition was stopped
        if frame_id == UNNUMBERED:
            self._unnumbered += 1
            self._note_gap()
            return None
        if not self._count_missing(frame_id):
            return None
        stamp = buffer.get_timestamp() * NANOSECOND
        self._number += 1
        if status != known.SUCCESS:
            self.ledger.truncate()
            self._note_gap()
            return None
        pixels = buffer.get_data()
        if len(pixels) != self.codec.pixel_bytes:
            raise ProtocolError("the frames' size has changed; open the camera anew")
        self._clock.observe(stamp, arrived_at)
        return self._hand_over(self._number - 1, pixels, self._clock.to_host(stamp))

    def _count_missing(self, frame_id: int) -> bool:
        """Enter frames since the last identifier; False for a late one, entered before."""
        if self._last_id is None:
            missing = self._unnumbered
        else:
            missing = frame_id - self._last_id - 1
            if max(frame_id, self._last_id) <= FRAME_ID_RANGE:
                # 65535 is followed by 1, and then frames from before may still be handed over.
                half = FRAME_ID_RANGE // 2
                missing = (missing + 1 + half) % FRAME_ID_RANGE - half - 1
        if missing < 0:
            return False
        self._last_id = frame_id
        if missing == 0:
            return True
        torn = min(missing, self._unnumbered)
        self._unnumbered = 0
        packets = int(self._stream.get_info_uint64_by_name("n_underruns"))
        underruns = max(self._dropped, -(-packets // self._packets_per_frame))
        dropped = min(missing - torn, underruns - self._dropped)
        self._dropped += dropped
        self.ledger.truncate(torn)
        self.ledger.receive(dropped)
        self.ledger.drop(dropped)
        self.ledger.lose(missing - torn - dropped)
        self._number += missing
        self._note_gap()
        return True

    def _count_unnumbered(self) -> None:
        """Enter frames without an identifier that no other frame comes after."""
        self.ledger.truncate(self._unnumbered)
        self._number += self._unnumbered
        self._unnumbered = 0

    def _check_presence(self, now: float) -> None:
        """Where nothing came for long, ask the camera something; open it anew if it is gone."""
        if now - self._heard_at < self._options.timeout_s:
            return
        self._heard_at = now
        try:
            with self._translate_errors():
                self._camera.get_exposure_time()
        except DeviceError:
            self._count_unnumbered()
            self._reconnect(self._reopen, self._options.reconnect_s)
            self._end_scan(self._options)

    def _reopen(self) -> None:
        self._open_camera()
        self.start()

    @contextlib.contextmanager
    def _translate_errors(
        self, kind: type[DeviceError | InputError] = DeviceDisconnectedError
    ) -> Iterator[None]:
        try:
            yield
        except (DeviceError, InputError):
            raise
        except Exception as fault:  # the binding's own, which is not known before it is imported
            where = self._place or "the first camera found"
            said = getattr(fault, "message", str(fault))
            raise kind(f"{where}: {said}") from fault


@lru_cache(maxsize=1)
def load_aravis() -> Any:
    """Import Aravis, from the system's packages where a virtual environment has none."""
    places = list(sys.path)
    sys.path.extend(SYSTEM_PACKAGES)
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis
    except (ImportError, ValueError) as fault:
        raise MissingDependencyError(
            "aravis:// needs Aravis and its Python binding: apt install python3-gi gir1.2-aravis-0.8, with the "
            f"system's version of Python ({fault})"
        ) from fault
    finally:
        sys.path[:] = places
    return Aravis


def find_cameras() -> list[DiscoveredInstrument]:
    """Look for cameras on the network and on USB, which takes a second; none without Aravis."""
    try:
        library = load_aravis()
    except MissingDependencyError:
        return []
    library.update_device_list()
    return [
        DiscoveredInstrument(
            f"aravis://{library.get_device_id(place)}",
            f"{library.get_device_vendor(place)} {library.get_device_model(place)}",
        )
        for place in range(library.get_n_devices())
    ]


def open_aravis(uri: Uri) -> StreamSource:
    """Open ``aravis://NAME``, a camera's identifier or address, or nothing for the first one;
    `CameraOptions` has its values.
    """
    options = CameraOptions.from_uri(uri)
    return StreamSource(AravisFeed(load_aravis(), uri.location, options), options)
