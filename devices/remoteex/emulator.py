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
from devices.remoteex.protocol import (
    DATA_GREETING,
    GREETING,
    TERMINATOR,
    Answer,
    AnswerCode,
    Command,
)
from devices.remoteex.source import GAIN_PARAMETER, STREAK_TUBE
from devices.scenes import LineLight
from tofclip.errors import InputError, ProtocolError

SUPPORTED_FAULTS = ("timeout", "short", "unplug", "corrupt", "lost", "overflow")
UNLIMITED_FRAMES = 1 << 62
FAULT_DELAY_S = 0.1
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

    def draw_frame(self, number: int) -> NDArray[np.uint16]:
        """Draw picture `number`; the same number gives the same picture."""
        drawn = np.random.default_rng([self.seed, number]).poisson(self.photons)
        return np.minimum(drawn, self.full_scale).astype("<u2")

    @classmethod
    def of(cls, light: LineLight, seed: int) -> EmulatedLight:
        """Let a scene's light fall on the screen.

        Parameters
        ----------
        light : LineLight
        seed : int
            Of the photons.

        Returns
        -------
        EmulatedLight
        """
        return cls(light.photons, light.row_times, seed=seed)


@dataclass
class _Acquisition:
    """A row of pictures: numbers of those in the ring buffer, and whether more will come."""

    client: Connection | None = None
    buffers: int = 1
    oldest: int = 0
    newest: int = -1
    is_running: bool = False


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
        By number of the request for a picture, from 0: ``timeout`` answers `amount` tenths of a
        second late, ``short`` pauses so long in the middle of a picture, ``unplug`` hangs up,
        ``corrupt`` answers nonsense, ``lost`` lets `amount` pictures fall out of the ring buffer,
        ``overflow`` announces more than any picture takes.
    """

    def __init__(
        self,
        light: EmulatedLight,
        frame_rate: float,
        frames: int = UNLIMITED_FRAMES,
        faults: Sequence[Fault] = (),
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
        self._parameters = {"Time Range": "20 ns", "Mode": "Operate", GAIN_PARAMETER: "0"}
        self._acquisition = _Acquisition()
        self._requests = 0
        self._data: Connection | None = None
        self._lock = threading.Lock()
        self._command_server = LoopbackServer(self._serve_commands)
        self._frame_server = LoopbackServer(self._serve_data)

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

    def _serve_data(self, connection: Connection) -> None:
        self._data = connection
        connection.send(DATA_GREETING.encode() + TERMINATOR)
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
            handler = self._command_handlers().get(command.name, _send_unknown)
            handler(command, connection)
        self._end_acquisition(connection)

    def _command_handlers(self) -> dict[str, Callable[[Command, Connection], None]]:
        return {
            "DevParamGet": self._get_parameter,
            "DevParamSet": self._set_parameter,
            "AcqLiveMonitor": self._set_monitor,
            "AcqStart": self._start_acquisition,
            "AcqStop": self._stop_acquisition,
            "ImgRingBufferGet": self._get_frame,
            "ImgDataGet": self._get_table,
        }

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
            self._acquisition.is_running = False
            self._acquisition = _Acquisition(connection, max(1, int(numbers[0])))
        elif kind != "Off":
            return _send_unknown(command, connection)
        return _send_done(command, connection)

    def _start_acquisition(self, command: Command, connection: Connection) -> None:
        if self._acquisition.is_running:
            connection.send(
                Answer(AnswerCode.NOT_NOW, command.name, ("acquisition runs",)).encode()
            )
            return
        self._acquisition.is_running = True
        _send_done(command, connection)
        ticker = threading.Thread(
            target=self._acquire_frames, args=(self._acquisition, connection), daemon=True
        )
        ticker.start()

    def _stop_acquisition(self, command: Command, connection: Connection) -> None:
        self._end_acquisition(connection)
        _send_done(command, connection)

    def _end_acquisition(self, connection: Connection) -> None:
        """Take no more pictures for this client; another one may have come by now."""
        if self._acquisition.client is connection:
            self._acquisition.is_running = False

    def _acquire_frames(self, run: _Acquisition, connection: Connection) -> None:
        """Take pictures, one after the other, and say so."""
        began = time.monotonic()
        while run.is_running and run.newest < self._frames - 1:
            with self._lock:
                run.newest += 1
                run.oldest = max(run.oldest, run.newest - run.buffers + 1)
                number = run.newest
            elapsed_ms = str(round((time.monotonic() - began) * 1e3))
            connection.send(
                Answer(
                    AnswerCode.MESSAGE, "LiveMonitor", ("RingBuffer", str(number), elapsed_ms)
                ).encode()
            )
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
        data, half = pixels.tobytes(), pixels.nbytes // 2
        self._send_data(data[:half])
        if kind == "short":
            time.sleep(pause)
        self._send_data(data[half:])

    def _get_table(self, command: Command, connection: Connection) -> None:
        if command.arguments[1:] != ("ScalingTable", "Vertical") or self._data is None:
            return _send_unknown(command, connection)
        table = (self._light.row_times * 1e9).astype("<f4")  # the time range is in ns
        _send_done(command, connection, str(table.size), "1")
        return self._send_data(table.tobytes())

    def _send_data(self, data: bytes) -> None:
        if self._data is not None:
            self._data.send(data)


def _send_done(command: Command, connection: Connection, *arguments: str) -> None:
    connection.send(Answer(AnswerCode.DONE, command.name, arguments).encode())


def _send_unknown(command: Command, connection: Connection) -> None:
    connection.send(Answer(AnswerCode.UNKNOWN, command.name).encode())
