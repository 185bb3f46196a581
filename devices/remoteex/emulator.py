"""A streak camera with HPD-TA's RemoteEx, made of software, on this computer's loopback."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from devices.emulation.faults import Fault
from devices.loopback import Connection, LoopbackServer
from devices.remoteex.protocol import DATA_GREETING, END, GREETING, Answer, Code, Command
from devices.remoteex.source import GAIN, STREAK_TUBE
from devices.scenes import LineLight
from tofclip.errors import InputError, ProtocolError

FAULTS = ("timeout", "short", "unplug", "corrupt", "lost", "overflow")
FOREVER = 1 << 62
TENTH = 0.1
"""Seconds by which a fault of amount 1 delays an answer."""


@dataclass(frozen=True)
class EmulatedLight:
    """What falls on the screen, and how it is swept.

    Parameters
    ----------
    photons : (rows, columns) array
        Expected photons of each pixel in one exposure.
    row_times : (rows,) array
        s.
    full_scale : int
        Reading at which a pixel saturates.
    seed : int
    """

    photons: NDArray[np.float64]
    row_times: NDArray[np.float64]
    full_scale: int = 65535
    seed: int = 0

    def exposure(self, number: int) -> NDArray[np.uint16]:
        """Draw picture `number`; the same number gives the same picture."""
        drawn = np.random.default_rng([self.seed, number]).poisson(self.photons)
        return np.minimum(drawn, self.full_scale).astype("<u2")

    @classmethod
    def of(cls, light: LineLight, seed: int) -> EmulatedLight:
        """Let a scene's light fall on the screen."""
        return cls(light.photons, light.row_times, seed=seed)


@dataclass
class _Run:
    """A row of pictures: numbers of those in the ring buffer, and whether more will come."""

    client: Connection | None = None
    buffers: int = 1
    oldest: int = 0
    newest: int = -1
    runs: bool = False


class EmulatedStreakCamera:
    """The server. Pictures are numbered from 0 for each client.

    Parameters
    ----------
    light : EmulatedLight
    frame_rate : float
        Pictures per second.
    frames : int
        Pictures until it is dark.
    faults : sequence of Fault
        By number of the request for a picture, from 0: ``timeout`` answers `amount` tenths of a second late, ``short``
        pauses so long in the middle of a picture, ``unplug`` hangs up, ``corrupt`` answers nonsense, ``lost`` lets
        `amount` pictures fall out of the ring buffer, ``overflow`` announces more than any picture takes.
    """

    def __init__(
        self, light: EmulatedLight, frame_rate: float, frames: int = FOREVER, faults: Sequence[Fault] = ()
    ) -> None:
        if not 0 < frame_rate <= 1e4:
            raise InputError(f"the frame rate must be above 0 and at most 10000 per second, got {frame_rate:g}")
        for fault in faults:
            if fault.kind not in FAULTS:
                raise InputError(f"a streak camera's faults are {', '.join(FAULTS)}, not {fault.kind}")
        self._light, self._interval, self._frames = light, 1 / frame_rate, frames
        self._faults = {fault.transfer: fault for fault in faults}
        self._parameters = {"Time Range": "20 ns", "Mode": "Operate", GAIN: "0"}
        self._run = _Run()
        self._requests = 0
        self._data: Connection | None = None
        self._lock = threading.Lock()
        self._commands = LoopbackServer(self._serve_commands)
        self._pictures = LoopbackServer(self._serve_data)

    @property
    def ports(self) -> tuple[int, int]:
        """Ports of commands and of data."""
        return self._commands.port, self._pictures.port

    @property
    def gain(self) -> str:
        """The micro-channel plate's gain, as it was set last."""
        return self._parameters[GAIN]

    def close(self) -> None:
        """Switch it off."""
        self._run.runs = False
        self._commands.close()
        self._pictures.close()

    def _serve_data(self, connection: Connection) -> None:
        self._data = connection
        connection.send(DATA_GREETING.encode() + END)
        while connection.request(END) is not None:  # nothing is ever said here, only the end is waited for
            pass

    def _serve_commands(self, connection: Connection) -> None:
        connection.send(GREETING.encode() + END)
        while (message := connection.request(END)) is not None:
            try:
                command = Command.decode(message)
            except ProtocolError:
                connection.send(Answer(Code.SYNTAX, "Unknown").encode())
                continue
            handler = self._handlers().get(command.name, _unknown)
            handler(command, connection)
        self._end_run(connection)

    def _handlers(self) -> dict[str, Callable[[Command, Connection], None]]:
        return {
            "DevParamGet": self._get,
            "DevParamSet": self._set,
            "AcqLiveMonitor": self._monitor,
            "AcqStart": self._start,
            "AcqStop": self._stop,
            "ImgRingBufferGet": self._picture,
            "ImgDataGet": self._table,
        }

    def _get(self, command: Command, connection: Connection) -> None:
        value = self._parameters.get(command.arguments[1] if len(command.arguments) == 2 else "")
        if value is None or command.arguments[0] != STREAK_TUBE:
            return _unknown(command, connection)
        return _done(command, connection, value)

    def _set(self, command: Command, connection: Connection) -> None:
        if len(command.arguments) != 3 or command.arguments[1] not in self._parameters:
            return _unknown(command, connection)
        self._parameters[command.arguments[1]] = command.arguments[2]
        return _done(command, connection)

    def _monitor(self, command: Command, connection: Connection) -> None:
        kind, *numbers = command.arguments or ("",)
        if kind == "RingBuffer" and len(numbers) == 1 and numbers[0].isdecimal():
            self._run.runs = False
            self._run = _Run(connection, max(1, int(numbers[0])))
        elif kind != "Off":
            return _unknown(command, connection)
        return _done(command, connection)

    def _start(self, command: Command, connection: Connection) -> None:
        if self._run.runs:
            connection.send(Answer(Code.NOT_NOW, command.name, ("acquisition runs",)).encode())
            return
        self._run.runs = True
        _done(command, connection)
        ticker = threading.Thread(target=self._tick, args=(self._run, connection), daemon=True)
        ticker.start()

    def _stop(self, command: Command, connection: Connection) -> None:
        self._end_run(connection)
        _done(command, connection)

    def _end_run(self, connection: Connection) -> None:
        """Take no more pictures for this client; another one may have come by now."""
        if self._run.client is connection:
            self._run.runs = False

    def _tick(self, run: _Run, connection: Connection) -> None:
        """Take pictures, one after the other, and say so."""
        began = time.monotonic()
        while run.runs and run.newest < self._frames - 1:
            with self._lock:
                run.newest += 1
                run.oldest = max(run.oldest, run.newest - run.buffers + 1)
                number = run.newest
            elapsed_ms = str(round((time.monotonic() - began) * 1e3))
            connection.send(Answer(Code.MESSAGE, "LiveMonitor", ("RingBuffer", str(number), elapsed_ms)).encode())
            time.sleep(max(0.0, began + (number + 1) * self._interval - time.monotonic()))

    def _picture(self, command: Command, connection: Connection) -> None:
        if len(command.arguments) != 2 or not command.arguments[1].isdecimal() or self._data is None:
            connection.send(Answer(Code.NO_DATA_LINK, command.name).encode())
            return
        fault = self._faults.get(self._requests)
        self._requests += 1
        with self._lock:
            number = int(command.arguments[1])
            if fault and fault.kind == "lost":
                self._run.oldest = number + fault.amount
                self._run.newest = max(self._run.newest, self._run.oldest)
            number = max(number, self._run.oldest)
            newest = self._run.newest
        if number > newest:
            connection.send(Answer(Code.IMPOSSIBLE, command.name, (f"current max = {newest}",)).encode())
            return
        self._send_picture(number, fault, connection)

    def _send_picture(self, number: int, fault: Fault | None, connection: Connection) -> None:
        kind, pause = (fault.kind, fault.amount * TENTH) if fault else ("", 0.0)
        pixels = self._light.exposure(number)
        rows, columns = pixels.shape
        if kind == "timeout":
            time.sleep(pause)
        if kind == "unplug":
            self._commands.hang_up()
            self._pictures.hang_up()
            return
        if kind == "corrupt":
            connection.send(b"\x00\xff?" + END)
            return
        size = (str(1 << 30), str(1 << 30)) if kind == "overflow" else (str(columns), str(rows))
        connection.send(Answer(Code.DONE, "ImgRingBufferGet", (*size, "2", "0", str(number), "0")).encode())
        data, half = pixels.tobytes(), pixels.nbytes // 2
        self._send_data(data[:half])
        if kind == "short":
            time.sleep(pause)
        self._send_data(data[half:])

    def _table(self, command: Command, connection: Connection) -> None:
        if command.arguments[1:] != ("ScalingTable", "Vertical") or self._data is None:
            return _unknown(command, connection)
        table = (self._light.row_times * 1e9).astype("<f4")  # the time range is in ns
        _done(command, connection, str(table.size), "1")
        return self._send_data(table.tobytes())

    def _send_data(self, data: bytes) -> None:
        if self._data is not None:
            self._data.send(data)


def _done(command: Command, connection: Connection, *arguments: str) -> None:
    connection.send(Answer(Code.DONE, command.name, arguments).encode())


def _unknown(command: Command, connection: Connection) -> None:
    connection.send(Answer(Code.UNKNOWN, command.name).encode())
