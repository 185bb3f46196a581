"""A SPAD512's server, made of software, on this computer's loopback."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from devices.emulation.faults import Fault
from devices.ledger import Ledger
from devices.loopback import HOST, Connection, LoopbackServer
from devices.scenes import render_array_light
from devices.source import Info
from devices.spad512.protocol import DONE_MARK, ERROR_MARK, ROWS, TERMINATOR, ExposureRequest
from devices.spad512.source import OPTIONS, Spad512Feed, parse_exposure, parse_timeouts
from devices.stream import StreamSource
from devices.stream_options import parse_buffer_settings
from devices.tcp import TcpLink
from devices.uri import Uri
from tofclip.errors import InputError, ProtocolError, ShapeError

SUPPORTED_FAULTS = ("timeout", "short", "unplug", "corrupt", "stall")
GREETING = b"SPAD512S emulated server, ready\n"
UNLIMITED_FRAMES = 1 << 62
FAULT_DELAY_S = 0.1
"""Seconds by which a fault of amount 1 delays an answer."""


class EmulatedSpadArray:
    """The server.

    Parameters
    ----------
    photons : (512, 512) array
        Expected photons of each pixel in one second.
    seed : int
    pictures : int
        Until it is dark: then a request finds no answer.
    faults : sequence of Fault
        By number of the request, from 0: ``timeout`` answers `amount` tenths of a second late,
        ``short`` pauses so long in the middle of a picture, ``unplug`` hangs up there, ``corrupt``
        ends with other letters, ``stall`` answers that it failed.
    """

    def __init__(
        self,
        photons: NDArray[np.float64],
        seed: int,
        pictures: int = UNLIMITED_FRAMES,
        faults: Sequence[Fault] = (),
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
        self._requests = 0
        self._server = LoopbackServer(self._serve_client)

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._server.port

    def draw_frame(self, request: int, number: int, exposure: ExposureRequest) -> NDArray[np.uint8]:
        """Return the bytes of picture `number` of a request; the same numbers give the same
        picture.

        Parameters
        ----------
        request, number : int
        exposure : ExposureRequest

        Returns
        -------
        (bytes,) uint8 array
        """
        light = self._photons[:, : exposure.width] * exposure.seconds
        drawn = np.random.default_rng([self._seed, request, number]).poisson(light)
        # a pixel's counter stops at the largest number it can hold
        counts = np.minimum(drawn, 2**exposure.bits - 1)
        if exposure.bits == 1:
            return np.packbits(counts.astype(np.uint8), axis=1).ravel()
        pixels: NDArray[np.uint8] = (
            counts.astype("<u2" if exposure.codec.bits == 16 else "u1").ravel().view(np.uint8)
        )
        return pixels

    def close(self) -> None:
        """Switch it off."""
        self._server.close()

    def _serve_client(self, connection: Connection) -> None:
        connection.send(GREETING)
        pile_up = False
        while (line := connection.read_request(TERMINATOR)) is not None:
            if line.startswith(b"PU,"):
                pile_up = line == b"PU,1"
                connection.send(b"Pile-up correction is " + (b"on\n" if pile_up else b"off\n"))
                continue
            try:
                self._send_exposure(ExposureRequest.decode(line, pile_up), connection)
            except ProtocolError:
                connection.send(b"unknown command\n" + ERROR_MARK)

    def _send_exposure(self, exposure: ExposureRequest, connection: Connection) -> None:
        request, self._requests = self._requests, self._requests + 1
        fault = self._faults.get(request)
        kind, pause = (fault.kind, fault.amount * FAULT_DELAY_S) if fault else ("", 0.0)
        if kind == "stall":
            connection.send(b"The FIFO is full.\n" + ERROR_MARK)
            return
        time.sleep(pause if kind == "timeout" else 0)
        for number in range(exposure.images):
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

    Besides the driver's own (`devices.spad512.source.OPTIONS`) it takes ``rate`` (photons per
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
        render_array_light() * rate, seed, pictures, Fault.parse(uri.value("faults", str, ""))
    )
    ledger = Ledger()
    try:
        feed = EmulatedFeed(server, ledger, exposure, patience, back)
    except BaseException:
        server.close()
        raise
    return StreamSource(feed, feed.codec, ledger, held)
