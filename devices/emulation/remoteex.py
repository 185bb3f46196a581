"""A streak camera with HPD-TA's RemoteEx, made of software, on this computer's loopback.

An emulated streak camera as a source: the real driver, its own connection, a simulated scene.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from devices.address import Uri
from devices.emulation.faults import HOST, Connection, Fault, LoopbackServer
from devices.emulation.scenes import (
    EmulatedLight,
    simulate_demonstration_light,
    simulate_line_light,
)
from devices.remoteex import (
    ANNOUNCEMENT,
    DATA_GREETING,
    GAIN_PARAMETER,
    GREETING,
    OPTIONS,
    STREAK_TUBE,
    TERMINATOR,
    Answer,
    AnswerCode,
    Command,
    LiveSettings,
    RemoteExClient,
    RemoteExFeed,
    parse_live_settings,
)
from devices.source import Info, Ledger
from devices.stream import StreamSource, parse_buffer_settings
from tofclip.camera import Camera
from tofclip.errors import InputError, ProtocolError
from tofclip.storage import Record

SUPPORTED_FAULTS = ("timeout", "short", "unplug", "corrupt", "lost", "overflow")
UNLIMITED_FRAMES = 1 << 62
FAULT_DELAY_S = 0.1
"""Seconds by which a fault of amount 1 delays an answer."""


@dataclass(frozen=True)
class Circumstances:
    """What a client finds."""

    is_application_up: bool = True  # HPD-TA runs; otherwise all but the start of it is refused
    is_live: bool = False  # an operator has started live mode
    busy_for: int = 0  # questions for the state of an asynchronous command after which that is over
    time_range: str = "20 ns"  # ``20 ns`` of a single sweep, ``3`` of a synchroscan unit
    has_scaling_table: bool = True
    stray_bytes: int = 17  # that wait on the data port, right behind the greeting
    # number of the picture after which live mode is started anew, at the computer itself
    restart_at: int | None = None


@dataclass
class _Acquisition:
    """A row of pictures: numbers of those in the ring buffer, and whether more will come."""

    client: Connection | None = None
    is_operators: bool = False
    buffers: int = 1
    oldest: int = 0
    newest: int = -1
    is_running: bool = False


class EmulatedStreakCamera:
    """The server. Pictures are numbered from 0 for each client.

    `frame_rate`: pictures per second; `frames`: pictures until it is dark; `faults`: by number of
    the request for a picture, from 0: ``timeout`` answers `amount` tenths of a second late,
    ``short`` pauses so long in the middle of a picture, ``unplug`` hangs up, ``corrupt`` answers
    nonsense, ``lost`` lets `amount` pictures fall out of the ring buffer, ``overflow`` announces
    more than any picture takes.
    """

    def __init__(
        self,
        light: EmulatedLight,
        frame_rate: float,
        frames: int = UNLIMITED_FRAMES,
        faults: Sequence[Fault] = (),
        found: Circumstances | None = None,
    ) -> None:
        if not 0 < frame_rate <= 1e4:
            raise InputError(
                f"the frame rate must be above 0 and at most 10000 per second, got {frame_rate:g}"
            )
        for fault in faults:
            if fault.kind not in SUPPORTED_FAULTS:
                raise InputError(
                    f"a streak camera's faults are {', '.join(SUPPORTED_FAULTS)}, not {fault.kind}"
                )
        self._light, self._interval, self._frames = light, 1 / frame_rate, frames
        self._faults = {fault.transfer: fault for fault in faults}
        self._found = found or Circumstances()
        self._is_up = self._found.is_application_up
        self._busy_for = self._found.busy_for
        self._restarts = 0
        self._parameters = {
            "Time Range": self._found.time_range,
            "Mode": "Operate",
            GAIN_PARAMETER: "0",
            "Shutter": "Closed",
            "Gate Mode": "Normal",
            "Trig. Mode": "Cont",
            "Trig. level": "1",
            "Trig. slope": "Rising",
            "DeviceName": "C0000",
        }
        self._camera_parameters = {"Exposure": "30 ms", "Binning": "1 x 1"}
        self._acquisition = _Acquisition()
        self._requests = 0
        self.taken = 0
        """Pictures taken since it was switched on, in all rows of them."""
        self.sent = 0
        """Pictures sent, each counted once for every request."""
        self._data: Connection | None = None
        self._lock = threading.Lock()
        self._command_server = LoopbackServer(self._serve_commands)
        self._frame_server = LoopbackServer(self._serve_data)
        if self._found.is_live:
            self._acquisition = _Acquisition(is_operators=True)
            self._run_acquisition()

    @property
    def is_running(self) -> bool:
        """Whether it takes pictures."""
        return self._acquisition.is_running

    @property
    def ports(self) -> tuple[int, int]:
        """Ports of commands and of data."""
        return self._command_server.port, self._frame_server.port

    @property
    def gain(self) -> str:
        """The micro-channel plate's gain, as it was set last."""
        return self._parameters[GAIN_PARAMETER]

    def close(self) -> None:
        """Switch it off."""
        self._acquisition.is_running = False
        self._command_server.close()
        self._frame_server.close()

    def note_taken(self, number: int) -> None:
        """Hear of every picture, at the moment when it is taken; for who watches the camera."""

    def _serve_data(self, connection: Connection) -> None:
        self._data = connection
        stray = b"\xee" * self._found.stray_bytes
        connection.send(DATA_GREETING.encode() + TERMINATOR + stray)
        while (
            connection.read_request(TERMINATOR) is not None
        ):  # nothing is ever said here, only the end is waited for
            pass

    def _serve_commands(self, connection: Connection) -> None:
        connection.send(GREETING.encode() + TERMINATOR)
        while (message := connection.read_request(TERMINATOR)) is not None:
            try:
                command = Command.decode(message)
            except ProtocolError:
                connection.send(Answer(AnswerCode.SYNTAX, "Unknown").encode())
                continue
            name = command.name.casefold()
            if not self._is_up and name not in ("appstart", "appinfo"):
                refusal = Answer(AnswerCode.NOT_NOW, command.name, ("application not running",))
                connection.send(refusal.encode())
                continue
            self._command_handlers().get(name, _send_unknown)(command, connection)
        self._end_acquisition(connection)

    def _command_handlers(self) -> dict[str, Callable[[Command, Connection], None]]:
        # Commands of the handbook; names are not case-sensitive.
        known: dict[str, Callable[[Command, Connection], None]] = {
            "AppStart": self._start_application,
            "AppInfo": _answer_with("9.5 pf4"),
            "AppLicenceGet": _answer_with("1", "1", "1"),
            "AppEnd": _send_done,
            "DevParamGet": self._get_parameter,
            "DevParamSet": self._set_parameter,
            "DevParamInfoEx": self._describe_parameter,
            "DevParamsList": self._list_parameters,
            "CamParamGet": self._get_camera_parameter,
            "CamParamSet": self._set_camera_parameter,
            "CamParamInfoEx": self._describe_camera_parameter,
            "AcqLiveMonitor": self._set_monitor,
            "AcqAcqMonitor": _send_done,
            "AcqStart": self._start_acquisition,
            "AcqStop": self._stop_acquisition,
            "AcqStatus": self._get_status,
            "AsyncCommandStatus": self._get_async_status,
            "SeqStart": _send_done,
            "ImgIndexGet": _answer_with("0"),
            "ImgSave": _send_done,
            "ImgLoad": _send_done,
            "ImgRingBufferGet": self._get_frame,
            "ImgDataGet": self._get_table,
        }
        return {name.casefold(): handler for name, handler in known.items()}

    def _start_application(self, command: Command, connection: Connection) -> None:
        self._is_up = True
        _send_done(command, connection)

    def _describe_parameter(self, command: Command, connection: Connection) -> None:
        name = command.arguments[1] if len(command.arguments) == 2 else ""
        if name == GAIN_PARAMETER:
            # label, current value, type, readable and writable, range
            return _send_done(command, connection, name, self.gain, "1", "1", "1", "0", "63")
        ranges = ("1", "2", "3", "4", "5")
        if not self._found.time_range.isdecimal():
            ranges = ("1 ns", "20 ns", "100 ns", "1 us", "10 \u00b5s")
        current = self._parameters.get(name)
        if current is None:
            return _send_unknown(command, connection)
        return _send_done(command, connection, name, current, "2", "1", "1", "5", *ranges)

    def _list_parameters(self, command: Command, connection: Connection) -> None:
        _send_done(command, connection, str(len(self._parameters)), *self._parameters)

    def _get_camera_parameter(self, command: Command, connection: Connection) -> None:
        value = self._camera_parameters.get(command.arguments[-1] if command.arguments else "")
        if value is None:
            return _send_unknown(command, connection)
        return _send_done(command, connection, value)

    def _set_camera_parameter(self, command: Command, connection: Connection) -> None:
        if len(command.arguments) != 3 or command.arguments[1] not in self._camera_parameters:
            return _send_unknown(command, connection)
        self._camera_parameters[command.arguments[1]] = command.arguments[2]
        return _send_done(command, connection)

    def _describe_camera_parameter(self, command: Command, connection: Connection) -> None:
        name = command.arguments[-1] if command.arguments else ""
        value = self._camera_parameters.get(name)
        if value is None:
            return _send_unknown(command, connection)
        return _send_done(command, connection, name, value, "2", "1", "1", "1", value)

    def _get_status(self, command: Command, connection: Connection) -> None:
        words = ("busy", "Live") if self._acquisition.is_running else ("idle",)
        _send_done(command, connection, *words)

    def _get_async_status(self, command: Command, connection: Connection) -> None:
        self._busy_for = max(0, self._busy_for - 1)
        is_busy = str(int(self._busy_for > 0))
        _send_done(command, connection, is_busy, "0", "0")

    def _get_parameter(self, command: Command, connection: Connection) -> None:
        value = self._parameters.get(command.arguments[1] if len(command.arguments) == 2 else "")
        if value is None or command.arguments[0] != STREAK_TUBE:
            return _send_unknown(command, connection)
        return _send_done(command, connection, value)

    def _set_parameter(self, command: Command, connection: Connection) -> None:
        if len(command.arguments) != 3 or command.arguments[1] not in self._parameters:
            return _send_unknown(command, connection)
        self._parameters[command.arguments[1]] = command.arguments[2]
        return _send_done(command, connection)

    def _set_monitor(self, command: Command, connection: Connection) -> None:
        kind, *numbers = command.arguments or ("",)
        if kind == "RingBuffer" and len(numbers) == 1 and numbers[0].isdecimal():
            buffers = max(1, int(numbers[0]))
            if self._acquisition.is_running and self._acquisition.is_operators:
                self._acquisition.client = connection
                self._acquisition.buffers = buffers
            else:
                self._acquisition.is_running = False
                self._acquisition = _Acquisition(connection, buffers=buffers)
        elif kind == "Off":
            if self._acquisition.is_operators:
                self._acquisition.client = None
        else:
            return _send_unknown(command, connection)
        return _send_done(command, connection)

    def _start_acquisition(self, command: Command, connection: Connection) -> None:
        if self._acquisition.is_running or self._busy_for:
            # The text of an error may hold carriage returns.
            refusal = Answer(AnswerCode.IMPOSSIBLE, command.name).encode().removesuffix(TERMINATOR)
            connection.send(refusal + b",command is\ralready running \xb5\r\n(HAcq)\r")
            return
        _send_done(command, connection)
        self._run_acquisition()

    def _run_acquisition(self) -> None:
        run = self._acquisition
        run.is_running = True
        threading.Thread(target=self._acquire_frames, args=(run,), daemon=True).start()

    def _stop_acquisition(self, command: Command, connection: Connection) -> None:
        with self._lock:  # none is taken after the answer
            self._acquisition.is_running = False
        self._busy_for = 0
        _send_done(command, connection)

    def _end_acquisition(self, connection: Connection) -> None:
        """Take no more pictures for this client; another one may have come by now."""
        if self._acquisition.client is connection:
            self._acquisition.client = None
            if not self._acquisition.is_operators:
                self._acquisition.is_running = False

    def _acquire_frames(self, run: _Acquisition) -> None:
        """Take pictures, one after the other, and say so."""
        began = time.monotonic()
        while run.newest < self._frames - 1:
            with self._lock:
                if not run.is_running:
                    return
                run.newest += 1
                self.taken += 1
                self.note_taken(run.newest)
                run.oldest = max(run.oldest, run.newest - run.buffers + 1)
                number = run.newest
            connection = run.client
            elapsed_ms = str(round((time.monotonic() - began) * 1e3))
            if connection is not None:
                words = ("RingBuffer", str(number), elapsed_ms)
                connection.send(Answer(AnswerCode.MESSAGE, ANNOUNCEMENT, words).encode())
            if number == self._found.restart_at and not self._restarts:
                with self._lock:
                    self._restarts += 1
                    run.oldest = 0
                    run.newest = -1
            time.sleep(max(0.0, began + (number + 1) * self._interval - time.monotonic()))

    def _get_frame(self, command: Command, connection: Connection) -> None:
        if (
            len(command.arguments) != 2
            or not command.arguments[1].isdecimal()
            or self._data is None
        ):
            connection.send(Answer(AnswerCode.NO_DATA_LINK, command.name).encode())
            return
        fault = self._faults.get(self._requests)
        self._requests += 1
        with self._lock:
            number = int(command.arguments[1])
            if fault and fault.kind == "lost":
                self._acquisition.oldest = number + fault.amount
                self._acquisition.newest = max(self._acquisition.newest, self._acquisition.oldest)
            number = max(number, self._acquisition.oldest)
            newest = self._acquisition.newest
        if number > newest:
            connection.send(
                Answer(AnswerCode.IMPOSSIBLE, command.name, (f"current max = {newest}",)).encode()
            )
            return
        self._send_frame(number, fault, connection)

    def _send_frame(self, number: int, fault: Fault | None, connection: Connection) -> None:
        kind, pause = (fault.kind, fault.amount * FAULT_DELAY_S) if fault else ("", 0.0)
        pixels = self._light.draw_frame(number)
        rows, columns = pixels.shape
        if kind == "timeout":
            time.sleep(pause)
        if kind == "unplug":
            self._command_server.close_connections()
            self._frame_server.close_connections()
            return
        if kind == "corrupt":
            connection.send(b"\x00\xff?" + TERMINATOR)
            return
        size = (str(1 << 30), str(1 << 30)) if kind == "overflow" else (str(columns), str(rows))
        connection.send(
            Answer(
                AnswerCode.DONE, "ImgRingBufferGet", (*size, "2", "0", str(number), "0")
            ).encode()
        )
        # In halves, so that a client has to put a picture together.
        data, half = pixels.tobytes(), pixels.nbytes // 2
        self._send_data(data[:half])
        if kind == "short":
            time.sleep(pause)
        self._send_data(data[half:])
        self.sent += 1

    def _get_table(self, command: Command, connection: Connection) -> None:
        is_table = command.arguments[1:] == ("ScalingTable", "Vertical")
        if not is_table or self._data is None or not self._found.has_scaling_table:
            return _send_unknown(command, connection)
        # In the unit of the time range, which is ns, or ps for a synchroscan unit.
        per_s = 1e12 if self._found.time_range.isdecimal() else 1e9
        table = (self._light.row_times * per_s).astype("<f4")
        _send_done(command, connection, str(table.size), "1")
        return self._send_data(table.tobytes())

    def _send_data(self, data: bytes) -> None:
        if self._data is not None:
            self._data.send(data)


def _answer_with(*words: str) -> Callable[[Command, Connection], None]:
    """Return a handler that always gives the same answer."""
    return lambda command, connection: _send_done(command, connection, *words)


def _send_done(command: Command, connection: Connection, *arguments: str) -> None:
    connection.send(Answer(AnswerCode.DONE, command.name, arguments).encode())


def _send_unknown(command: Command, connection: Connection) -> None:
    connection.send(Answer(AnswerCode.UNKNOWN, command.name).encode())


class EmulatedFeed(RemoteExFeed):
    """A camera's pictures, with what the calibration of the lenslets before it would tell.

    Closing switches the emulated camera off.
    """

    def __init__(
        self, server: EmulatedStreakCamera, camera: Camera, ledger: Ledger, settings: LiveSettings
    ) -> None:
        self._server, self._camera = server, camera
        port, data_port = server.ports
        super().__init__(
            lambda: RemoteExClient(HOST, port, data_port, settings.timeout), ledger, settings
        )

    @property
    def info(self) -> Info:
        known = super().info
        return replace(known, instrument=f"emulated {known.instrument}")

    @property
    def calibration(self) -> Record | None:
        known = super().calibration
        return (
            None if known is None else replace(known, children={"camera": self._camera.to_record()})
        )

    def close(self) -> None:
        try:
            super().close()
        finally:
            self._server.close()


def open_emulated(uri: Uri) -> StreamSource:
    """Open ``sim+remoteex://?seed=1&scene=demo&frame_rate=10&frames=N&faults=...``, an emulated
    camera behind TCP.

    Besides the driver's own (`devices.remoteex.OPTIONS`) it takes ``scene`` (``demo``, or
    ``small`` for a slit of 256 pixels), ``frames`` (then it is dark) and ``faults`` (as
    `devices.emulation.faults.Fault.parse` reads them).
    """
    uri.reject_unknown(
        *(name for name in OPTIONS if name != "data_port"),
        "seed",
        "scene",
        "frame_rate",
        "frames",
        "faults",
    )
    seed = uri.value("seed", int, 0)
    if seed < 0:
        raise InputError(f"'{uri.text}': a seed must not be negative")
    settings, held = parse_live_settings(uri), parse_buffer_settings(uri)
    rate, frames = uri.value("frame_rate", float, 10.0), uri.value("frames", int, UNLIMITED_FRAMES)
    faults = Fault.parse(uri.value("faults", str, ""))
    scene = (
        simulate_demonstration_light()
        if uri.choice("scene", "demo", "small") == "demo"
        else simulate_line_light()
    )
    server = EmulatedStreakCamera(EmulatedLight.of(scene, seed), rate, frames, faults)
    ledger = Ledger()
    try:
        feed = EmulatedFeed(server, scene.camera, ledger, settings)
    except BaseException:
        server.close()
        raise
    return StreamSource(feed, feed.codec, ledger, held)
