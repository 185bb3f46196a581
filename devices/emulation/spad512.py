"""A SPAD512's server, made of software, on this computer's loopback."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

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
from devices.emulation.scenes import render_array_delays, render_array_light
from devices.spad512 import (
    DONE_MARK,
    ERROR_MARK,
    GATE_STEP_PS,
    INFORMATION_COMMAND,
    ROWS,
    Spad512Feed,
    SpadOptions,
)
from devices.stream import StreamSource
from tofclip.arrays import FloatArray
from tofclip.errors import ProtocolError

SUPPORTED_FAULTS = ("timeout", "short", "unplug", "corrupt", "stall")
GREETING = b"SPAD512S emulated server, ready\n"
LASER_PERIOD_S = 25e-9
GATE_EDGE_S = 1e-10  # Standard deviation of the laser's pulse and the gate's edges together
AMBIENT_FRACTION = 0.02  # Of a white pixel's light: what comes at any time

# Questions that have one answer
TEXTS = {
    INFORMATION_COMMAND: (
        b"Master FPGA serial: EMULATED-1\nSlave FPGA serial: EMULATED-2\n"
        b"Software version: 0\nFirmware version: 0\nHardware version: 0\nHardware flavour: 512\n"
        b"Intensity imaging: 1\nGated imaging: 1\nFLIM imaging: 0"
    ),
    b"V": b"20.0,3.0",
    b"R": b"40.0,40.0,35.0,20.0,40000000.0,100.0",
}
CONFIRMED_COMMANDS = (b"V,", b"D,", b"AE,", b"S,", b"CALIB,", b"Ga,")


class EmulatedSpadArray:
    """The server. `photons` (512, 512): expected photons of each pixel in one second; `delays`
    (512, 512): when each pixel's light comes back after the laser's pulse, s; NaN where none does.
    Pictures behind a gate need it; `pictures`: until it is dark: then a request finds no answer;
    `faults`: by number of the request, from 0: ``timeout`` answers `amount` tenths of a second
    late, ``short`` pauses so long in the middle of a picture, ``unplug`` hangs up there,
    ``corrupt`` ends with other letters, ``stall`` says that it failed: with the mark at the end,
    with amount 2 with the mark in front, with amount 3 in the middle of a picture.
    """

    is_framed = True  # it ends its texts with `DONE_MARK`
    must_calibrate = False  # it calibrates itself when it is first asked

    def __init__(
        self,
        photons: FloatArray,
        seed: int,
        pictures: int = FOREVER,
        faults: Sequence[Fault] = (),
        delays: FloatArray | None = None,
    ) -> None:
        self._photons, self._seed, self._left = photons, seed, pictures
        self._faults = index_faults(faults, SUPPORTED_FAULTS)
        self._delays = np.full((ROWS, ROWS), np.nan) if delays is None else delays
        self._end = b"\n" + DONE_MARK if self.is_framed else b""
        self._requests = 0
        self._server = LoopbackServer(self._serve_client)
        self.port = self._server.port

    def draw_frame(self, request: int, number: int, exposure: SpadOptions) -> NDArray[np.uint8]:
        """Return picture `number` of a request; the same numbers give the same bytes."""
        light = self._photons[:, : exposure.width] * exposure.seconds
        if exposure.is_gated:
            light = self._gate_light(light, exposure, number)
        drawn = np.random.default_rng([self._seed, request, number]).poisson(light)
        # a pixel's counter stops at the largest number it can hold
        counts = np.minimum(drawn, 2**exposure.bits - 1)
        if exposure.bits == 1:
            turned = np.rot90(counts.astype(np.uint8), -exposure.codec.quarter_turns)
            return np.packbits(turned, axis=1).ravel()
        kind = "<u2" if exposure.codec.bits == 16 else "u1"
        return counts.astype(kind).ravel().view(np.uint8)

    def close(self) -> None:
        self._server.close()

    def _gate_light(self, light: FloatArray, gate: SpadOptions, number: int) -> FloatArray:
        """Return what comes while the gate is open, of light that comes once in a laser's period."""
        opens = gate.opening_times[number % gate.gate_steps]
        width = gate.gate_width_ns * 1e-9
        since = (self._delays[:, : light.shape[1]] - opens) / GATE_EDGE_S
        passed = np.nan_to_num(ndtr(since) - ndtr(since - width / GATE_EDGE_S))
        ambient = AMBIENT_FRACTION * float(light.max(initial=0.0)) * width / LASER_PERIOD_S
        return light * passed + ambient

    def _serve_client(self, connection: Connection) -> None:
        connection.send(GREETING)
        pile_up = False
        # What comes at once is one command: they have no end.
        while (command := connection.read_available()) is not None:
            command = command.strip()
            if command.startswith(b"PU,"):
                pile_up = command == b"PU,1"
                said = b"Pile-up correction is " + (b"on" if pile_up else b"off")
            elif command == INFORMATION_COMMAND and self.must_calibrate:
                self.must_calibrate = False
                connection.send(b"The breakdown calibration process will start soon." + self._end)
                time.sleep(0.3)
                said = b"The breakdown is around 24.5"
            elif command in TEXTS:
                said = TEXTS[command]
            elif command.startswith(CONFIRMED_COMMANDS):
                said = b"OK " + command
            elif command.startswith(b"Gf,"):
                said = _suggest_gate(command)
            else:
                try:
                    exposure = SpadOptions.decode(command, pile_up)
                except ProtocolError:
                    said = ERROR_MARK + b": unknown command"
                else:
                    self._send_exposure(exposure, connection)
                    continue
            connection.send(said + self._end)

    def _send_exposure(self, exposure: SpadOptions, connection: Connection) -> None:
        request, self._requests = self._requests, self._requests + 1
        fault = self._faults.get(request)
        kind, pause = (fault.kind, fault.amount * FAULT_DELAY_S) if fault else ("", 0.0)
        if fault is not None and kind == "stall":
            if fault.amount == 3:
                connection.send(b"\x81" * 1000)
            framed = ERROR_MARK + b": the FIFO is full.\n" + DONE_MARK
            connection.send(framed if fault.amount == 2 else b"The FIFO is full.\n" + ERROR_MARK)
            return
        time.sleep(pause if kind == "timeout" else 0)
        for number in range(exposure.frames):
            if self._left <= 0:
                return
            self._left -= 1
            data = self.draw_frame(request, number, exposure).tobytes()
            half = len(data) // 2
            connection.send(data[:half])
            if kind == "unplug":
                connection.close()
                return
            time.sleep(pause if kind == "short" else 0)
            connection.send(data[half:])
        connection.send(b"GONE" if kind == "corrupt" else DONE_MARK)


def _suggest_gate(command: bytes) -> bytes:
    """Answer which steps cover the laser's period: ``Gf,1,STEP_PS,WIDTH_NS,1``."""
    fields = command.split(b",")
    try:
        step = max(GATE_STEP_PS, round(float(fields[2])))
    except (IndexError, ValueError):
        return ERROR_MARK + b": unknown command"
    lines = (
        "Gate settings",
        "for one period of the laser:",
        f"The number of gate steps is {int(LASER_PERIOD_S * 1e12) // step}",
        "The gate offset is 0 ps",
        f"The minimum gate step size is {step} ps",
    )
    return "\n".join(lines).encode()


@dataclass(frozen=True)
class EmulationOptions(SpadOptions):
    """Values of the emulation besides the driver's own."""

    seed: int = option(0, least=0)
    rate: float = option(2e4, least=0, most=1e9)  # photons per second on a white pixel
    pictures: int = option(FOREVER)  # then it is dark
    faults: tuple[Fault, ...] = option((), Fault.parse)


def open_emulated(uri: Uri) -> StreamSource:
    """Open ``sim+spad512://``, before the demonstration; `EmulationOptions` has its values."""
    options = EmulationOptions.from_uri(uri)
    server = EmulatedSpadArray(
        render_array_light() * options.rate,
        options.seed,
        options.pictures,
        options.faults,
        render_array_delays() if options.is_gated else None,
    )
    return open_on(server, lambda: Spad512Feed(HOST, server.port, options), options)
