"""A SPAD512's server, made of software, on this computer's loopback."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from devices.address import Uri
from devices.emulation.faults import HOST, Connection, Fault, LoopbackServer
from devices.emulation.scenes import render_array_delays, render_array_light
from devices.frames import GateScan
from devices.source import Info, Ledger
from devices.spad512 import (
    DONE_MARK,
    ERROR_MARK,
    GATE_STEP_PS,
    INFORMATION_COMMAND,
    OPTIONS,
    ROWS,
    ExposureRequest,
    Spad512Feed,
    parse_exposure,
    parse_timeouts,
)
from devices.stream import StreamSource, parse_buffer_settings
from devices.tcp import TcpLink
from tofclip.errors import InputError, ProtocolError, ShapeError

SUPPORTED_FAULTS = ("timeout", "short", "unplug", "corrupt", "stall")
GREETING = b"SPAD512S emulated server, ready\n"
UNLIMITED_FRAMES = 1 << 62
FAULT_DELAY_S = 0.1
"""Seconds by which a fault of amount 1 delays an answer."""

LASER_PERIOD_S = 25e-9
GATE_EDGE_S = 1e-10
"""Standard deviation of the laser's pulse and the gate's edges together."""

AMBIENT_FRACTION = 0.02
"""Of a white pixel's light: what comes at any time."""

TEXTS = {
    INFORMATION_COMMAND: b"\n".join(
        [
            b"Master FPGA serial: EMULATED-1",
            b"Slave FPGA serial: EMULATED-2",
            b"Software version: 0",
            b"Firmware version: 0",
            b"Hardware version: 0",
            b"Hardware flavour: 512",
            b"Intensity imaging: 1",
            b"Gated imaging: 1",
            b"FLIM imaging: 0",
        ]
    ),
    b"V": b"20.0,3.0",
    b"R": b"40.0,40.0,35.0,20.0,40000000.0,100.0",
}
"""Questions that have one answer."""

CONFIRMED_COMMANDS = (b"V,", b"D,", b"AE,", b"S,", b"CALIB,", b"Ga,")


class EmulatedSpadArray:
    """The server.

    `photons` (512, 512): expected photons of each pixel in one second; `delays` (512, 512): when
    each pixel's light comes back after the laser's pulse, s; NaN where none does. Pictures behind a
    gate need it; `pictures`: until it is dark: then a request finds no answer; `faults`: by number
    of the request, from 0: ``timeout`` answers `amount` tenths of a second late, ``short`` pauses
    so long in the middle of a picture, ``unplug`` hangs up there, ``corrupt`` ends with other
    letters, ``stall`` says that it failed: with the mark at the end, with amount 2 with the mark in
    front, with amount 3 in the middle of a picture; `is_framed`: whether it ends its texts with
    `DONE_MARK`; `calibrates`: whether it calibrates itself when it is first asked.
    """

    def __init__(
        self,
        photons: NDArray[np.float64],
        seed: int,
        pictures: int = UNLIMITED_FRAMES,
        faults: Sequence[Fault] = (),
        delays: NDArray[np.float64] | None = None,
        is_framed: bool = True,
        calibrates: bool = False,
    ) -> None:
        if photons.shape != (ROWS, ROWS):
            raise ShapeError("a SPAD512's light", (ROWS, ROWS), photons.shape)
        for fault in faults:
            if fault.kind not in SUPPORTED_FAULTS:
                raise InputError(
                    f"a SPAD array's faults are {', '.join(SUPPORTED_FAULTS)}, not {fault.kind}"
                )
        self._photons, self._seed, self._left = photons, seed, pictures
        self._faults = {fault.transfer: fault for fault in faults}
        self._delays = np.full((ROWS, ROWS), np.nan) if delays is None else delays
        self._end = b"\n" + DONE_MARK if is_framed else b""
        self._must_calibrate = calibrates
        self._requests = 0
        self._server = LoopbackServer(self._serve_client)

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._server.port

    def draw_frame(self, request: int, number: int, exposure: ExposureRequest) -> NDArray[np.uint8]:
        """Return the bytes of picture `number` of a request; the same numbers give the same
        picture.

        Returns (bytes,).
        """
        light = self._photons[:, : exposure.width] * exposure.seconds
        if exposure.gate is not None:
            light = self._gate_light(light, exposure.gate, number)
        drawn = np.random.default_rng([self._seed, request, number]).poisson(light)
        # a pixel's counter stops at the largest number it can hold
        counts = np.minimum(drawn, 2**exposure.bits - 1)
        if exposure.bits == 1:
            turned = np.rot90(counts.astype(np.uint8), -exposure.codec.quarter_turns)
            return np.packbits(turned, axis=1).ravel()
        pixels: NDArray[np.uint8] = (
            counts.astype("<u2" if exposure.codec.bits == 16 else "u1").ravel().view(np.uint8)
        )
        return pixels

    def close(self) -> None:
        """Switch it off."""
        self._server.close()

    def _gate_light(
        self, light: NDArray[np.float64], gate: GateScan, number: int
    ) -> NDArray[np.float64]:
        """Return what comes while the gate is open, of light that comes once in a laser's period."""
        opens = gate.opening_times[number % gate.steps]
        width = gate.width_ns * 1e-9
        since = (self._delays[:, : light.shape[1]] - opens) / GATE_EDGE_S
        passed = np.nan_to_num(ndtr(since) - ndtr(since - width / GATE_EDGE_S))
        ambient = AMBIENT_FRACTION * float(light.max(initial=0.0)) * width / LASER_PERIOD_S
        return np.asarray(light * passed + ambient)

    def _serve_client(self, connection: Connection) -> None:
        connection.send(GREETING)
        pile_up = False
        # What comes at once is one command: they have no end.
        while (command := connection.read_available()) is not None:
            command = command.strip()
            if command.startswith(b"PU,"):
                pile_up = command == b"PU,1"
                said = b"Pile-up correction is " + (b"on" if pile_up else b"off")
            elif command == INFORMATION_COMMAND and self._must_calibrate:
                self._must_calibrate = False
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
                    exposure = ExposureRequest.decode(command, pile_up)
                except ProtocolError:
                    said = ERROR_MARK + b": unknown command"
                else:
                    self._send_exposure(exposure, connection)
                    continue
            connection.send(said + self._end)

    def _send_exposure(self, exposure: ExposureRequest, connection: Connection) -> None:
        request, self._requests = self._requests, self._requests + 1
        fault = self._faults.get(request)
        kind, pause = (fault.kind, fault.amount * FAULT_DELAY_S) if fault else ("", 0.0)
        if fault is not None and kind == "stall":
            if fault.amount == 3:
                connection.send(b"\x81" * 1000)
            connection.send(
                ERROR_MARK + b": the FIFO is full.\n" + DONE_MARK
                if fault.amount == 2
                else b"The FIFO is full.\n" + ERROR_MARK
            )
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


class EmulatedFeed(Spad512Feed):
    """Pictures of an emulated array, which is switched off when they are closed."""

    def __init__(
        self,
        server: EmulatedSpadArray,
        ledger: Ledger,
        exposure: ExposureRequest,
        patience: float,
        reconnect: float,
    ) -> None:
        self._server = server
        super().__init__(
            lambda: TcpLink(HOST, server.port, patience), ledger, exposure, patience, reconnect
        )

    @property
    def info(self) -> Info:
        known = super().info
        return replace(known, instrument=f"emulated {known.instrument}")

    def close(self) -> None:
        super().close()
        self._server.close()


def open_emulated(uri: Uri) -> StreamSource:
    """Open ``sim+spad512://?seed=1&rate=20000&faults=...``: an emulated array that sees the
    demonstration.

    Besides the driver's own (`devices.spad512.OPTIONS`) it takes ``rate`` (photons per
    second on a white pixel), ``pictures`` (then it is dark) and ``faults`` (as
    `devices.emulation.faults.Fault.parse` reads them).
    """
    uri.reject_unknown(*OPTIONS, "seed", "rate", "pictures", "faults")
    seed, rate = uri.value("seed", int, 0), uri.value("rate", float, 2e4)
    if seed < 0 or not 0 <= rate <= 1e9:
        raise InputError(f"'{uri.text}': a seed must not be negative, a rate within 0..1e9")
    (patience, back), exposure, held = (
        parse_timeouts(uri),
        parse_exposure(uri),
        parse_buffer_settings(uri),
    )
    pictures = uri.value("pictures", int, UNLIMITED_FRAMES)
    server = EmulatedSpadArray(
        render_array_light() * rate,
        seed,
        pictures,
        Fault.parse(uri.value("faults", str, "")),
        None if exposure.gate is None else render_array_delays(),
    )
    ledger = Ledger()
    try:
        feed = EmulatedFeed(server, ledger, exposure, patience, back)
    except BaseException:
        server.close()
        raise
    return StreamSource(feed, feed.codec, ledger, held)
