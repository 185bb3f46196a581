"""LinoSPAD2 made of software: photons of a simulated scene, as the words that a board with uneven
codes would send.

There is no wire to emulate, because the board's USB commands are not public; the stream begins
where the words do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from time import monotonic, sleep

import numpy as np

from devices.address import Uri, option
from devices.emulation.scenes import LineLight, draw_cells, simulate_light
from devices.linospad2 import (
    CLOCK_PERIOD_S,
    CODES_PER_PERIOD,
    FIRMWARES,
    PIXELS,
    BoardCalibration,
    LinoSpad2Codec,
    make_calibration_record,
)
from devices.linospad2_kernels import ADDRESSES
from devices.source import Info, Ledger
from devices.stream import Feed, StreamOptions, StreamSource, Transfer
from tofclip.arrays import FloatArray
from tofclip.errors import InputError

INSTRUMENT = "simulated LinoSPAD2"
LASER_PERIOD_S = 25e-9
CYCLE_TIME_S = 4e-3  # A cycle lasts as long, s; a code has room for 4.8 ms
COUNTER_TICK_S = 7.5e-9


@dataclass(frozen=True)
class SimulatedBoard:
    """A board before which a scene is lit by a pulsed laser."""

    light: LineLight  # of 256 pixels, and shorter than the laser's period
    calibration: BoardCalibration
    codec: LinoSpad2Codec
    photons_per_cycle: float  # expected photons on all pixels together
    seed: int

    def __post_init__(self) -> None:
        most = PIXELS // ADDRESSES * self.codec.timestamps
        if not 0 < self.photons_per_cycle <= most:
            raise InputError(
                f"photons per cycle must be above 0 and at most {most}, got {self.photons_per_cycle:g}"
            )

    @cached_property
    def _cumulative_photons(self) -> FloatArray:
        """Photons up to each cell of the light, in raster order."""
        return np.cumsum(self.light.photons)

    @cached_property
    def _code_ends(self) -> FloatArray:
        """Ends of all pixels' codes in one table that rises throughout, s: two periods apart."""
        begins = 2 * CLOCK_PERIOD_S * np.arange(PIXELS)
        return (self.calibration.code_ends + begins[:, np.newaxis]).ravel()

    def encode_cycle(self, number: int) -> bytes:
        """Return a cycle's words; photons that find their converter's memory full are left out."""
        random = np.random.default_rng([self.seed, number])
        total = random.poisson(self.photons_per_cycle)
        row, pixel = draw_cells(random, self._cumulative_photons, total, PIXELS)
        # The last pulses of a cycle are left out, so that the board's offsets cannot carry a photon
        # beyond it.
        pulse = random.integers(1, round(CYCLE_TIME_S / LASER_PERIOD_S) - 1, total) * LASER_PERIOD_S
        width = self.light.row_times[1] - self.light.row_times[0]
        time = pulse + self.light.row_times[row] + (random.uniform(-0.5, 0.5, total) * width)
        # The code in which each time lies, for its own pixel's converter
        periods, phase = np.divmod(time - self.calibration.offsets[pixel], CLOCK_PERIOD_S)
        place = np.searchsorted(self._code_ends, phase + 2 * CLOCK_PERIOD_S * pixel, side="right")
        code = np.clip(place - pixel * CODES_PER_PERIOD, 0, CODES_PER_PERIOD - 1)
        records = np.zeros(total, self.codec.dtype)
        records["pixel"] = pixel
        records["code"] = periods.astype(np.int64) * CODES_PER_PERIOD + code
        if self.codec.counter:
            records["counter"] = round(number * CYCLE_TIME_S / COUNTER_TICK_S)
        # A converter keeps its first photons in time; later ones find its memory full.
        records = self.codec.sort_stamps(records[np.argsort(records["code"], kind="stable")])
        converter = self.codec.address_of[records["pixel"]] // ADDRESSES
        place_in_queue = np.arange(total) - np.searchsorted(converter, converter)
        cycle = self.codec.encode(records[place_in_queue < self.codec.timestamps])
        return cycle or bytes(self.codec.unit_bytes)


def draw_uneven_calibration(seed: int) -> BoardCalibration:
    """Return a board of uneven codes, 0.1 to 2 widths, and pixels out of step by 10 ns."""
    random = np.random.default_rng([seed, 1])
    ends = np.cumsum(random.uniform(0.1, 1.9, (PIXELS, CODES_PER_PERIOD)), axis=1)
    return BoardCalibration(
        ends * (CLOCK_PERIOD_S / ends[:, -1:]), random.uniform(-6e-9, 4e-9, PIXELS)
    )


class SimulatedFeed(Feed):
    """A board's cycles, one after the other; see `devices.stream.Feed`. `cycles`: until the stream
    ends; `cycle_time`: seconds that a cycle takes at least; 0: as fast as they are read.
    """

    def __init__(self, board: SimulatedBoard, cycles: int, cycle_time: float) -> None:
        self.ledger, self.codec = Ledger(), board.codec
        self._board, self._left, self._cycle_time = board, cycles, cycle_time
        self._number = 0
        limits = "LinoSPAD2's USB commands are not public: recordings are read, and boards simulated, not driven"
        self.info = Info(INSTRUMENT, f"SIM{board.seed}", {"limits": limits, **board.codec.settings})
        camera = board.light.camera.to_record()
        self.calibration = make_calibration_record(board.calibration, LASER_PERIOD_S, camera)

    def start(self) -> None:
        self._began = monotonic()

    def pull(self, timeout: float) -> Transfer | None:
        if self._left <= 0:
            return None
        self._left -= 1
        data = self._board.encode_cycle(self._number)
        self._number += 1
        sleep(max(0.0, self._began + self._number * self._cycle_time - monotonic()))
        return Transfer(memoryview(data))

    def stop(self) -> None:
        self._left = 0


@dataclass(frozen=True)
class SimulationOptions(StreamOptions):
    """Values of an address."""

    seed: int = option(0, least=0)
    cycles: int = option(250, least=0)
    photons: float = option(6000.0)  # expected number in a cycle
    firmware: str = option("", choices=FIRMWARES)
    timestamps: int = option(512)
    counter: bool = option(False)
    pace: str = option("", choices=("fast", "realtime"))  # realtime: a cycle takes its 4 ms


def open_simulated(uri: Uri) -> StreamSource:
    """Open ``sim+linospad2://``; `SimulationOptions` has its values."""
    options = SimulationOptions.from_uri(uri)
    board = SimulatedBoard(
        simulate_light("small"),
        draw_uneven_calibration(options.seed),
        LinoSpad2Codec(options.firmware, options.timestamps, options.counter),
        options.photons,
        options.seed,
    )
    cycle_time = CYCLE_TIME_S if options.pace == "realtime" else 0.0
    return StreamSource(SimulatedFeed(board, options.cycles, cycle_time), options)
