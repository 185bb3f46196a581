"""A streak camera with HPD-TA's RemoteEx, made of software, on this computer's loopback: the real
driver, its own connection, a simulated scene.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from devices.address import Uri, option
from devices.emulation.harness import (
    FAULT_DELAY_S,
    FOREVER,
    HOST,
    Connection,
    Fault,
    LoopbackServer,
    index_faults,
    open_on,
)
from devices.emulation.scenes import EmulatedLight, simulate_light
from devices.remoteex import (
    ANNOUNCEMENT,
    DATA_GREETING,
    GAIN_PARAMETER,
    GREETING,
    STREAK_TUBE,
    TERMINATOR,
    Answer,
    AnswerCode,
    Command,
    RemoteExFeed,
    StreakOptions,
)
from devices.stream import StreamSource
from tofclip.errors import InputError, ProtocolError
from tofclip.storage import Record

SUPPORTED_FAULTS = ("timeout", "short", "unplug", "corrupt", "lost", "overflow")


@dataclass
class _Acquisition:
    """A row of pictures: numbers of those in the ring buffer, and whether more will come."""

    client: Connection | None = None
    is_operators: bool = False
    buffers: int = 1
    oldest: int = 0
    newest: int = -1
    is_running: bool = False


class _RefusedError(Exception):
    """A command that is answered by a code: `AnswerCode`, then what is said."""


class EmulatedStreakCamera:
    """The server. Pictures are numbered from 0 for each client. `frame_rate`: pictures per second;
    `frames`: pictures until it is dark; `faults`: by number of the request for a picture, from 0:
    ``timeout`` answers `amount` tenths of a second late, ``short`` pauses so long in the middle of
    a picture, ``unplug`` hangs up, ``corrupt`` answers nonsense, ``lost`` lets `amount` pictures
    fall out of the ring buffer, ``overflow`` announces more than any picture takes. What a client
    finds besides is the class's: subclasses differ.
    """

    is_application_up = True  # HPD-TA runs; otherwise all but the start of it is refused
    is_live = False  # an operator has started live mode
    busy_for = 0  # questions for the state of an asynchronous command after which that is over
    time_range = "20 ns"  # of a single sweep; ``3`` of a synchroscan unit
    has_scaling_table = True
    stray_bytes = 17  # that wait on the data port, right behind the greeting
    # number of the picture after which live mode is started anew, at the computer itself
    restart_at: int | None = None

    def __init__(
        self,
        light: EmulatedLight,
        frame_rate: float,
        frames: int = FOREVER,
        faults: Sequence[Fault] = (),
    ) -> None:
        if not 0 < frame_rate <= 1e4:
            raise InputError(
                f"the frame rate must be above 0 and at most 10000 per second, got {frame_rate:g}"
            )
        self._light, self._interval, self._frames = light, 1 / frame_rate, frames
        self._faults = index_faults(faults, SUPPORTED_FAULTS)
        self._tube = {"Time Range": self.time_range, "Mode": "Operate", GAIN_PARAMETER: "0"}
        self._run = _Acquisition()
        self._requests = 0
        self.taken = 0
        """Pictures taken since it was switched on, in all rows of them."""
        self.sent = 0
        """Pictures sent, each counted once for every request."""
        self._data: Connection | None = None
        self._lock = threading.Lock()
        self._command_server = LoopbackServer(self._serve_commands)
        self._frame_server = LoopbackServer(self._serve_data)
        self.ports = self._command_server.port, self._frame_server.port
        """Of commands and of data."""
        if self.is_live:
            self._run = _Acquisition(is_operators=True)
            self._start_acquisition()

    @property
    def is_running(self) -> bool:
        return self._run.is_running

    @property
    def gain(self) -> str:
        return self._tube[GAIN_PARAMETER]

    @gain.setter
    def gain(self, value: str) -> None:
        self._tube[GAIN_PARAMETER] = value

    def close(self) -> None:
        self._run.is_running = False
        self._command_server.close()
        self._frame_server.close()

    def note_taken(self, number: int) -> None:
        """Hear of every picture, at the moment when it is taken; for who watches the camera."""

    def _serve_data(self, connection: Connection) -> None:
        self._data = connection
        connection.send(DATA_GREETING.encode() + TERMINATOR + b"\xee" * self.stray_bytes)
        while connection.read_request(TERMINATOR) is not None:
            pass  # nothing is ever said here, only the end is waited for

    def _serve_commands(self, connection: Connection) -> None:
        connection.send(GREETING.encode() + TERMINATOR)
        while (message := connection.read_request(TERMINATOR)) is not None:
            name = "Unknown"
            try:
                command = Command.decode(message)
                name = command.name
                words = self._execute(command, connection)
                if words is not None:
                    _send_done(connection, name, *words)
            except ProtocolError:
                connection.send(Answer(AnswerCode.SYNTAX, name).encode())
            except _RefusedError as refusal:
                code, *said = refusal.args
                connection.send(Answer(code, name, tuple(said)).encode())
        # No more pictures for this client; another one may have come by now.
        if self._run.client is connection:
            self._run.client = None
            if not self._run.is_operators:
                self._run.is_running = False

    def _execute(  # noqa: C901 - a table
        self, command: Command, connection: Connection
    ) -> tuple[str, ...] | None:
        """Do what the handbook says of what drivers ask; return what is answered, None where that has
        been sent.
        """
        tube, run = self._tube, self._run
        match (command.name.casefold(), *command.arguments):
            case (name, *_) if not self.is_application_up and name != "appstart":
                raise _RefusedError(AnswerCode.NOT_NOW, "application not running")
            case ("appstart", *_):
                self.is_application_up = True
                return ()
            case ("devparamget", place, name) if place == STREAK_TUBE and name in tube:
                return (tube[name],)
            case ("devparamset", _, name, value) if name in tube:
                tube[name] = value
                return ()
            case ("acqlivemonitor", "RingBuffer", number) if number.isdecimal():
                buffers = max(1, int(number))
                if run.is_running and run.is_operators:
                    run.client, run.buffers = connection, buffers
                else:
                    run.is_running = False
                    self._run = _Acquisition(connection, buffers=buffers)
                return ()
            case ("acqlivemonitor", "Off", *_):
                if run.is_operators:
                    run.client = None
                return ()
            case ("acqstart", *_) if run.is_running or self.busy_for:
                # The text of an error may hold carriage returns.
                refusal = Answer(AnswerCode.IMPOSSIBLE, command.name).encode()
                said = b",command is\ralready running \xb5\r\n(HAcq)\r"
                connection.send(refusal.removesuffix(TERMINATOR) + said)
                return None
            case ("acqstart", *_):
                _send_done(connection, command.name)
                self._start_acquisition()
                return None
            case ("acqstop", *_):
                with self._lock:  # none is taken after the answer
                    run.is_running = False
                self.busy_for = 0
                return ()
            case ("acqstatus", *_):
                return ("busy", "Live") if run.is_running else ("idle",)
            case ("asynccommandstatus", *_):
                self.busy_for = max(0, self.busy_for - 1)
                return (str(int(self.busy_for > 0)), "0", "0")
            case ("imgringbufferget", _, number) if number.isdecimal() and self._data:
                self._send_frame(int(number), connection)
                return None
            case ("imgringbufferget", *_):
                raise _RefusedError(AnswerCode.NO_DATA_LINK)
            case ("imgdataget", _, "ScalingTable", "Vertical") if (
                self._data and self.has_scaling_table
            ):
                # In the unit of the time range: ns, or ps for a synchroscan unit.
                per_s = 1e12 if self.time_range.isdecimal() else 1e9
                table = (self._light.row_times * per_s).astype("<f4")
                _send_done(connection, command.name, str(table.size), "1")
                self._send_data(table.tobytes())
                return None
            case _:
                raise _RefusedError(AnswerCode.UNKNOWN)

    def _start_acquisition(self) -> None:
        self._run.is_running = True
        threading.Thread(target=self._acquire_frames, args=(self._run,), daemon=True).start()

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
            if number == self.restart_at:
                self.restart_at = None
                with self._lock:
                    run.oldest, run.newest = 0, -1
            time.sleep(max(0.0, began + (number + 1) * self._interval - time.monotonic()))

    def _send_frame(self, number: int, connection: Connection) -> None:
        fault = self._faults.get(self._requests)
        self._requests += 1
        kind, amount = (fault.kind, fault.amount) if fault else ("", 0)
        run = self._run
        with self._lock:
            if kind == "lost":
                run.oldest = number + amount
                run.newest = max(run.newest, run.oldest)
            number, newest = max(number, run.oldest), run.newest
        if number > newest:
            raise _RefusedError(AnswerCode.IMPOSSIBLE, f"current max = {newest}")
        pixels = self._light.draw_frame(number)
        rows, columns = pixels.shape
        if kind == "timeout":
            time.sleep(amount * FAULT_DELAY_S)
        if kind == "unplug":
            self._command_server.close_connections()
            self._frame_server.close_connections()
            return
        if kind == "corrupt":
            connection.send(b"\x00\xff?" + TERMINATOR)
            return
        size = (str(1 << 30), str(1 << 30)) if kind == "overflow" else (str(columns), str(rows))
        _send_done(connection, "ImgRingBufferGet", *size, "2", "0", str(number), "0")
        # In halves, so that a client has to put a picture together.
        data, half = pixels.tobytes(), pixels.nbytes // 2
        self._send_data(data[:half])
        if kind == "short":
            time.sleep(amount * FAULT_DELAY_S)
        self._send_data(data[half:])
        self.sent += 1

    def _send_data(self, data: bytes) -> None:
        if self._data is not None:
            self._data.send(data)


def _send_done(connection: Connection, name: str, *words: str) -> None:
    connection.send(Answer(AnswerCode.DONE, name, words).encode())


@dataclass(frozen=True)
class EmulationOptions(StreakOptions):
    """Values of the emulation besides the driver's own."""

    seed: int = option(0, least=0)
    scene: str = option("", choices=("demo", "small"))  # a small one has a slit of 256 pixels
    frame_rate: float = option(10.0)
    frames: int = option(FOREVER)  # then it is dark
    faults: tuple[Fault, ...] = option((), Fault.parse)


def open_emulated(uri: Uri) -> StreamSource:
    """Open ``sim+remoteex://``, an emulated camera behind TCP; `EmulationOptions` has its values."""
    options = EmulationOptions.from_uri(uri)
    seen = simulate_light(options.scene)
    light = EmulatedLight.of(seen, options.seed)
    server = EmulatedStreakCamera(light, options.frame_rate, options.frames, options.faults)

    def describe(known: Record | None) -> Record | None:
        """Add what the calibration of the lenslets before the camera would tell."""
        return known and replace(known, children={"camera": seen.camera.to_record()})

    return open_on(server, lambda: RemoteExFeed(HOST, server.ports, options), options, describe)
