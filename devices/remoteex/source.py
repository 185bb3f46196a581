"""Hamamatsu's streak cameras as a source of frames."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic, sleep
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from devices.clock import InstrumentClock
from devices.frames import FrameCodec
from devices.ledger import Ledger
from devices.remoteex.client import CameraFrame, RemoteExClient
from devices.remoteex.protocol import COMMAND_PORT, parse_integer
from devices.ring import Gap
from devices.source import Info
from devices.stream import (
    STREAM_OPTIONS,
    StreamSource,
    Transfer,
    parse_buffer_settings,
    retry_connect,
)
from devices.uri import Uri
from tofclip.errors import (
    DeviceBusyError,
    DeviceDisconnectedError,
    DeviceError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
)
from tofclip.io.hpdta import TIME_UNITS
from tofclip.storage import Field, Record, Scalar

INSTRUMENT = "Hamamatsu streak camera (RemoteEx)"
STREAK_TUBE = "TD"
GAIN_PARAMETER = "MCP Gain"
OPTIONS = (
    "data_port",
    "buffers",
    "mcp_gain",
    "time_range",
    "time_ranges_ps",
    "timeout_s",
    "reconnect_s",
    *STREAM_OPTIONS,
)
APPLICATION_START_S = 30.0
POLL_INTERVAL_S = 0.05
SYNCHROSCAN_UNIT_S = 1e-12
"""Of the scaling table where the time range is a mere number, as of synchroscan units."""

_PARAMETERS = {"time_range": "Time Range", "mode": "Mode", "mcp_gain": GAIN_PARAMETER}

ConnectFunction = Callable[[], RemoteExClient]


@dataclass(frozen=True)
class LiveSettings:
    """How to acquire."""

    buffers: int = 16  # pictures that HPD-TA keeps for a client that is late
    # of the micro-channel plate, set before the start; None leaves it as it is. It is 0 after the
    # stop in any case: an intensified tube that is not watched must not age in strong light
    gain: int | None = None
    timeout: float = 5.0  # seconds to wait for an answer
    reconnect: float = 5.0  # seconds to wait for HPD-TA to come back when the connection broke
    # set before the start, as HPD-TA writes it: ``20 ns``, or ``3`` for a synchroscan unit; empty
    # leaves it as it is
    time_range: str = ""
    # how long ranges 1, 2, ... of a synchroscan unit last, ps, for cameras that give no scaling
    # table
    time_ranges_ps: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not 1 <= self.buffers <= 4096:
            raise InputError(f"the number of buffers must be within 1..4096, got {self.buffers}")
        if self.gain is not None and not 0 <= self.gain <= 63:
            raise InputError(
                f"the gain of the micro-channel plate must be within 0..63, got {self.gain}"
            )
        if any(not 0 < one < 1e15 for one in self.time_ranges_ps):
            raise InputError("time ranges must be positive numbers of ps, such as 165,500,1000")
        if not (0 < self.timeout <= 600 and 0 <= self.reconnect <= 600):
            raise InputError("times to wait must be within 0 s and 600 s")


class _Announcement(NamedTuple):
    """A message that a picture was taken."""

    number: int
    stamp: float | None  # its time by the camera's computer, s since live mode was started
    received_at: float  # s of `time.monotonic`


class RemoteExFeed:
    """Live pictures in the order of their numbers; see `devices.stream.Feed`.

    Pictures that fell out of the ring buffer before they were asked for are lost by the instrument.
    When the connection breaks, so are those that had been announced.

    `connect`: returns a new connection.
    """

    def __init__(self, connect: ConnectFunction, ledger: Ledger, settings: LiveSettings) -> None:
        self._connect, self._ledger, self._settings = connect, ledger, settings
        self._gap = Gap.NONE
        self._clock = InstrumentClock()
        self._stamps: dict[int, float] = {}
        self._start_camera()
        try:
            first = self._first
            self.codec = FrameCodec(first.rows, first.columns, 8 * first.pixel_bytes)
            self._parameters = self._read_parameters()
            self._row_times = self._read_row_times()
        except BaseException:
            # Also a signal to end: nothing else could turn the gain down now.
            with contextlib.suppress(DeviceError):
                self.close()
            raise

    @property
    def info(self) -> Info:
        details: dict[str, Scalar] = {
            **self._parameters,
            "rows": self.codec.rows,
            "columns": self.codec.columns,
        }
        return Info(INSTRUMENT, "", details)

    @property
    def calibration(self) -> Record | None:
        """Time of each row in s, where the camera sweeps."""
        if self._row_times is None:
            return None
        return Record("streak_calibration", {"row_times": Field(self._row_times, "s", ("row",))})

    def start(self) -> None:
        """Do nothing: the camera runs since the connection was made, which is how the pictures'
        size is known.
        """

    def pull(self, timeout: float) -> Transfer | None:
        while True:
            try:
                picture = self._read_next_frame(timeout)
            except DeviceDisconnectedError:
                self._reconnect()
                continue
            if (picture.rows, picture.columns, 8 * picture.pixel_bytes) != (
                self.codec.rows,
                self.codec.columns,
                self.codec.bits,
            ):
                raise ProtocolError("the pictures' size has changed; open the camera anew")
            gap, self._gap = self._gap, Gap.NONE
            data = memoryview(self.codec.pack_frame(picture.number, picture.pixels))
            return Transfer(data, gap, self._estimate_time(picture.number))

    def stop(self) -> None:
        """Turn the gain down first, whatever the state of the connection, and stop the acquisition.

        Live mode that another program had started goes on, with the gain that it had.
        """
        self._stopped = True
        # Live mode of an operator goes on with the operator's gain; otherwise 0 protects the tube.
        gain = self._gain_before if self._has_joined else "0"
        commands: list[tuple[str, ...]] = [("AcqLiveMonitor", "Off")]
        if not self._has_joined:
            commands.insert(0, ("AcqStop",))
        if gain is not None:
            commands.insert(0, ("DevParamSet", STREAK_TUBE, GAIN_PARAMETER, gain))
        self._link.send_and_wait(*commands)

    def close(self) -> None:
        try:
            if not self._stopped:
                self.stop()
            # What was announced before the stop, and not read by now, is lost.
            with contextlib.suppress(DeviceError):
                while True:
                    self._note_announcement(self._wait_for_announcement(0))
        finally:
            self._count_announced_lost()
            self._link.close()

    def _start_camera(self) -> None:
        """Connect, start the camera and wait for its first picture."""
        self._link = link = self._connect()
        self._stopped = False
        self._has_joined = False
        self._gain_before: str | None = None
        try:
            try:
                self._prepare_live(link)
            # These say nothing about HPD-TA, so that starting it would not help.
            except (DeviceDisconnectedError, DeviceTimeoutError):
                raise
            except DeviceError:
                if not link.start_application(APPLICATION_START_S):
                    raise
                self._prepare_live(link)
            if not link.is_done("AcqStart", "Live"):
                self._join_or_restart(link)
            announced = self._wait_for_announcement(self._settings.timeout)
            self._clock.reset()
            self._stamps.clear()
            self._note_stamp(announced)
            self._first = link.read_frame(announced.number)
        except BaseException:
            with contextlib.suppress(DeviceError):
                self.stop()
            link.close()
            raise
        # The first picture was read for its size, and is delivered as well. Where it has fallen out
        # of the ring buffer already, it is an older one's successor.
        self._unread_frame: CameraFrame | None = self._first
        self._next = self._announced = announced.number
        self._newest = max(announced.number, self._first.number)

    def _prepare_live(self, link: RemoteExClient) -> None:
        """Set what has to be set before live mode, and ask to be notified of every picture."""
        settings = self._settings
        if settings.gain is not None:
            with contextlib.suppress(ProtocolError):
                (self._gain_before,) = link.ask("DevParamGet", STREAK_TUBE, GAIN_PARAMETER)[:1]
            link.ask("DevParamSet", STREAK_TUBE, GAIN_PARAMETER, str(settings.gain))
        if settings.time_range:
            link.ask("DevParamSet", STREAK_TUBE, "Time Range", settings.time_range)
        link.ask("AcqLiveMonitor", "RingBuffer", str(settings.buffers))

    def _join_or_restart(self, link: RemoteExClient) -> None:
        """Join live mode that runs already, or wait until what else keeps the camera busy is over;
        in the end, stop that.
        """
        with contextlib.suppress(ProtocolError):  # not every version knows the question
            state = [word.strip().casefold() for word in link.ask("AcqStatus")]
            if "live" in state:
                self._has_joined = True
                return
        for is_last in (False, True):
            deadline = monotonic() + self._settings.timeout
            while link.ask("AsyncCommandStatus")[:1] != ("0",) and monotonic() < deadline:
                sleep(POLL_INTERVAL_S)
            if link.is_done("AcqStart", "Live"):
                return
            if not is_last:
                link.ask("AcqStop")
        raise DeviceBusyError("the streak camera is busy; end what HPD-TA is doing")

    def _read_next_frame(self, timeout: float) -> CameraFrame:
        deadline = monotonic() + timeout
        picture = self._unread_frame
        while picture is None:
            with contextlib.suppress(DeviceTimeoutError):
                while self._newest >= self._next:  # all that has been announced meanwhile
                    self._note_announcement(self._wait_for_announcement(0))
            while self._newest < self._next:
                left = max(deadline - monotonic(), 0)
                self._note_announcement(self._wait_for_announcement(left))
            try:
                picture = self._link.read_frame(self._next)
            except (DeviceDisconnectedError, DeviceTimeoutError, ProtocolError):
                raise
            except DeviceError:
                # Refused, as no such picture is there: the numbers begin anew when live mode does.
                if not self._have_numbers_restarted():
                    raise
        lost = picture.number - self._next
        if lost < 0:
            raise ProtocolError(f"RemoteEx sent picture {picture.number}, asked for {self._next}")
        if lost:
            self._ledger.lose(lost)
            self._gap = max(self._gap, Gap.LOSS)
        self._unread_frame, self._next = None, picture.number + 1
        self._newest = max(self._newest, picture.number)
        return picture

    def _note_announcement(self, announced: _Announcement) -> None:
        """Note the newest picture; where its number went back, live mode was started anew."""
        number = announced.number
        if number <= self._announced:
            self._count_announced_lost()
            self._next = number
            self._gap = Gap.RESTART
            self._clock.reset()
            self._stamps.clear()
        self._announced = number
        self._newest = max(number, self._next - 1)
        self._note_stamp(announced)

    def _note_stamp(self, announced: _Announcement) -> None:
        if announced.stamp is not None:
            self._clock.observe(announced.stamp, announced.received_at)
            self._stamps[announced.number] = announced.stamp

    def _estimate_time(self, number: int) -> float:
        """Return when a picture was taken, s of `time.monotonic`; 0 where its announcement has not
        come, or had no time.
        """
        # A picture that was sent for one that is gone may be announced right before the answer.
        with contextlib.suppress(DeviceTimeoutError):
            while number not in self._stamps and self._announced < number:
                self._note_announcement(self._wait_for_announcement(0))
        stamp = self._stamps.get(number)
        self._stamps = {later: one for later, one in self._stamps.items() if later > number}
        return 0.0 if stamp is None else self._clock.to_host(stamp)

    def _have_numbers_restarted(self) -> bool:
        """Wait for the next announcement, and say whether it goes back."""
        expected = self._next
        self._note_announcement(self._wait_for_announcement(self._settings.timeout))
        return self._next != expected

    def _wait_for_announcement(self, timeout: float) -> _Announcement:
        """Return the next message that announces a picture."""
        while True:
            message = self._link.read_message(timeout)
            words = message.arguments
            if len(words) >= 2 and words[0].casefold() == "ringbuffer":
                number = parse_integer(words[1], "a picture's number")
                is_stamped = len(words) > 2 and words[2].isdecimal() and len(words[2]) < 16
                return _Announcement(
                    number, int(words[2]) * 1e-3 if is_stamped else None, message.received_at
                )

    def _reconnect(self) -> None:
        self._count_announced_lost()
        self._link.close()
        retry_connect(self._start_camera, self._settings.reconnect)
        self._ledger.reconnect()
        self._gap = Gap.RESTART

    def _count_announced_lost(self) -> None:
        """Enter pictures that were announced and will not come."""
        self._ledger.lose(max(0, self._newest - self._next + 1))
        self._newest, self._unread_frame = self._next - 1, None

    def _read_parameters(self) -> dict[str, Scalar]:
        found: dict[str, Scalar] = {}
        for name, parameter in _PARAMETERS.items():
            with contextlib.suppress(ProtocolError):  # HiPic has no streak tube to ask
                found[name] = ",".join(self._link.ask("DevParamGet", STREAK_TUBE, parameter))
        return found

    def _read_row_times(self) -> NDArray[np.float64] | None:
        """Return the rows' times, s; the table is in the unit of the time range, as the files show."""
        time_range = str(self._parameters.get("time_range", "")).strip()
        is_numbered = time_range.isdecimal() and len(time_range) < 4
        unit = SYNCHROSCAN_UNIT_S if is_numbered else TIME_UNITS.get(time_range.rpartition(" ")[2])
        if unit is None or self._parameters.get("mode") == "Focus":
            return None
        try:
            table = self._link.read_scaling_table().astype(np.float64)
        except ProtocolError:
            ranges = self._settings.time_ranges_ps
            if not is_numbered or not 1 <= int(time_range) <= len(ranges):
                raise
            rows = self.codec.rows
            sweep = ranges[int(time_range) - 1] * unit
            return np.linspace(0, sweep, rows, endpoint=False) + sweep / (2 * rows)
        if (
            table.shape != (self.codec.rows,)
            or not np.all(np.isfinite(table))
            or np.any(np.diff(table) <= 0)
        ):
            raise ProtocolError("RemoteEx's scaling table does not rise row by row of the picture")
        return table * unit


def open_remoteex(uri: Uri) -> StreamSource:
    """Open
    ``remoteex://HOST:1001?data_port=1002&buffers=16&mcp_gain=N&timeout_s=5&reconnect_s=5&buffer_mib=64``.

    ``time_range=20 ns`` (or ``3`` for a synchroscan unit) sets the sweep before the start;
    ``time_ranges_ps=165,500,1000`` says how long a synchroscan unit's ranges last, for one that
    gives no scaling table.
    """
    uri.reject_unknown(*OPTIONS)
    host, port = uri.host_and_port(COMMAND_PORT)
    data_port, settings, held = (
        uri.value("data_port", int, port + 1),
        parse_live_settings(uri),
        parse_buffer_settings(uri),
    )
    ledger = Ledger()
    feed = RemoteExFeed(
        lambda: RemoteExClient(host, port, data_port, settings.timeout), ledger, settings
    )
    return StreamSource(feed, feed.codec, ledger, held)


def parse_live_settings(uri: Uri) -> LiveSettings:
    """Read the values of an address (`OPTIONS`) that say how to acquire."""
    standard = LiveSettings()
    return LiveSettings(
        uri.value("buffers", int, standard.buffers),
        uri.value("mcp_gain", int, 0) if "mcp_gain" in uri.values else None,
        uri.value("timeout_s", float, standard.timeout),
        uri.value("reconnect_s", float, standard.reconnect),
        uri.value("time_range", str, ""),
        uri.value("time_ranges_ps", _parse_numbers, ()),
    )


def _parse_numbers(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.split(","))
