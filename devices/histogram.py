"""Bins of time, and the sum over everything that was put into them.

One histogram for each kind of photon record.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from devices.linospad2 import CLOCK_PERIOD_S, PIXELS, BoardCalibration
from devices.source import Records
from devices.timetag_codec import DELTA
from tofclip.arrays import AnyArray, FloatArray, IntArray
from tofclip.errors import InputError, require_positive
from tofclip.shots import Streak
from tofclip.threads import run_blocks, thread_count

MAX_CELLS = 1 << 26  # Bins of all pixels together: half a gigabyte for each thread

# Bins over which a photon is shared out at least; a step of no width would be infinitely high
MIN_WIDTH_BINS = 1e-3
ROUNDING_PHOTONS = 1e-6  # Photons in a bin that are rounding errors of adding up steps, not photons
_MIN_PIECE = 1 << 16


@dataclass(frozen=True)
class BinAxis:
    """`bins` bins of `bin_width` s; bin k lies around ``start + k * bin_width``, `start` s after the
    laser's pulse. Photons of all the laser's periods of `period` s add up; None: there is one pulse
    only, or every photon is already counted from its own.
    """

    bin_width: float
    bins: int
    start: float = 0.0
    period: float | None = None

    def __post_init__(self) -> None:
        if not (0 < self.bin_width < math.inf and math.isfinite(self.start) and self.bins >= 1):
            raise InputError(f"bins need a positive width, a number and a start, got {self}")
        if self.period is None:
            return
        require_positive("the laser's period", self.period, "number of seconds")
        # A relative tolerance, because a width is often computed as period / bins.
        if self.bins * self.bin_width > self.period * (1 + 1e-9):
            raise InputError(
                f"{self.bins} bins of {self.bin_width:.4g} s are longer than the laser's period of {self.period:.4g} s"
            )

    @property
    def times(self) -> FloatArray:
        """Middle of each bin, s."""
        return self.start + np.arange(self.bins) * np.float64(self.bin_width)

    @property
    def shift_bins(self) -> float:
        """Where the laser's pulse lies, bins."""
        return 0.5 - self.start / self.bin_width

    @property
    def period_bins(self) -> float:
        return 0.0 if self.period is None else self.period / self.bin_width


class Histogram(abc.ABC):
    """Photons of a line of `pixels`, added up over any number of batches; nothing of `hot_pixels` can
    be believed. Memory: 8 bytes for each bin, pixel and thread, however many photons come.
    """

    def __init__(
        self, pixels: int, axis: BinAxis, hot_pixels: IntArray | tuple[int, ...] = ()
    ) -> None:
        if pixels < 1 or pixels * axis.bins > MAX_CELLS:
            raise InputError(
                f"{pixels} pixels of {axis.bins} bins are none, or more than {MAX_CELLS} cells"
            )
        self.pixels, self.axis = pixels, axis
        self._hot = np.asarray(hot_pixels, np.int64)
        self._parts: list[FloatArray] = []

    @abc.abstractmethod
    def add(self, records: Records, after_gap: bool = False) -> None:
        """Add photons (n,), records of the histogram's own kind; `after_gap`: some are missing before
        them.
        """

    @property
    def counts(self) -> FloatArray:
        """Photons so far, (bins, pixels); right to a millionth of a photon."""
        total = np.zeros((self.pixels, self.axis.bins + 2))
        for part in self._parts:
            total += part
        # steps add up to the density; the last two bins hold what lies beyond the axis
        photons = np.cumsum(total[:, : self.axis.bins], axis=1).T
        # steps up and down cancel to rounding only
        photons[photons < ROUNDING_PHOTONS] = 0
        return photons

    def to_streak(self) -> Streak:
        """Return the sum so far as a streak image: rows are instants after the laser's pulse, columns
        are pixels, of which hot ones are marked as saturated; `InputError` where no photon came.
        """
        counts = self.counts.astype(np.float32)
        untrusted = np.zeros(counts.shape, bool)
        untrusted[:, self._hot] = True
        return Streak(counts, self.axis.times, untrusted, source="photon histogram")

    def _add_in_parallel(self, add: Callable[[slice, AnyArray], None], total: int) -> None:
        """Call `add` on pieces of ``range(total)``, each with steps that no other thread uses."""
        size = max(_MIN_PIECE, -(-total // thread_count()))
        # a sum for each piece, so that threads never write to the same one
        while len(self._parts) * size < total:
            self._parts.append(np.zeros((self.pixels, self.axis.bins + 2)))
        run_blocks(lambda piece: add(piece, self._parts[piece.start // size]), total, size)


class StampHistogram(Histogram):
    """Time stamps of LinoSPAD2 (`devices.linospad2.STAMP_DTYPE`, with or without counter), by the
    tables of its board.

    The laser's pulses are locked to the board's clock and a cycle begins with one of them, so that
    a stamp's time since its cycle began, modulo the laser's period, is its time after a pulse. A
    photon is shared out evenly over the instants that its code covers.
    """

    def __init__(self, axis: BinAxis, calibration: BoardCalibration) -> None:
        super().__init__(PIXELS, axis, calibration.hot_pixels)
        first = calibration.code_begins + calibration.offsets[:, np.newaxis]
        begins = first / axis.bin_width + axis.shift_bins
        widths = (calibration.code_ends - calibration.code_begins) / axis.bin_width
        if axis.period is not None:
            begins %= axis.period_bins  # small numbers keep their digits in float32
        codes = [begins, np.maximum(widths, MIN_WIDTH_BINS)]
        self._codes = np.stack(codes, axis=-1).astype(np.float32)

    def add(self, records: Records, after_gap: bool = False) -> None:
        if records.dtype.names is None or records.dtype.names[-2:] != ("code", "pixel"):
            raise InputError(f"LinoSPAD2's time stamps end in code and pixel, got {records.dtype}")
        from devices.histogram_kernels import add_stamps

        rows = np.ascontiguousarray(records).view("<u4").reshape(len(records), -1)
        clock, period = CLOCK_PERIOD_S / self.axis.bin_width, self.axis.period_bins

        strays: list[int] = []  # appending is safe on several threads

        def add(piece: slice, steps: AnyArray) -> None:
            strays.append(add_stamps(rows[piece], clock, self._codes, period, steps))

        self._add_in_parallel(add, len(records))
        if any(strays):
            raise InputError(
                f"LinoSPAD2 has {PIXELS} pixels; {sum(strays)} time stamps are of others"
            )


class TagHistogram(Histogram):
    """Time tags (`devices.timetag_codec.RECORD_DTYPE`) of a counter with a few channels and ticks of
    `tick` s. `sync_channel` sees the laser, `pixel_channels` are those of the line's pixels.

    A photon's time is counted from the last pulse before it; after a gap, photons are left out
    until the next pulse.
    """

    def __init__(
        self, axis: BinAxis, sync_channel: int, pixel_channels: tuple[int, ...], tick: float
    ) -> None:
        super().__init__(len(pixel_channels), axis)
        channels = [sync_channel, *pixel_channels]
        if len(set(channels)) < len(channels) or not all(0 <= channel < 8 for channel in channels):
            raise InputError(
                f"sync and pixels need channels of their own within 0..7, got {channels}"
            )
        require_positive("a tick", tick, "number of seconds")
        self._sync = 1 << sync_channel
        self._pixel_of = np.full(max(channels) + 1, -1, np.int64)
        self._pixel_of[list(pixel_channels)] = np.arange(len(pixel_channels))
        self._tick_bins = tick / axis.bin_width
        self._known = -1

    def add(self, records: Records, after_gap: bool = False) -> None:
        from devices.histogram_kernels import add_tags, find_last_sync

        # Sync pulses may be among the missing records, so that the last known one may be of an
        # earlier period.
        known = -1 if after_gap else self._known
        columns = [records[name] for name in ("time_ticks", "channels", "flags")]
        place = (self._pixel_of, self._tick_bins, self.axis.shift_bins, self.axis.period_bins)

        def add(piece: slice, steps: AnyArray) -> None:
            # Each thread begins in the middle of the batch and looks back for the pulse that counts
            # there.
            start = find_last_sync(*columns, DELTA, self._sync, piece.start, known)
            own = (column[piece] for column in columns)
            add_tags(*own, DELTA, self._sync, start, *place, steps)

        self._add_in_parallel(add, len(records))
        self._known = find_last_sync(*columns, DELTA, self._sync, len(records), known)


class BinHistogram(Histogram):
    """Photons as files of photon-counting electronics hold them (`devices.files.PHOTON_DTYPE`): each
    is shared out over its bin of `resolution` s, which begins ``bin * resolution`` after the pulse.
    """

    def __init__(self, pixels: int, axis: BinAxis, resolution: float) -> None:
        super().__init__(pixels, axis)
        require_positive("a resolution", resolution, "number of seconds")
        self._resolution = resolution

    def add(self, records: Records, after_gap: bool = False) -> None:
        from devices.histogram_kernels import add_times

        pixels, times = records["channel"], records["bin"] * self._resolution
        if len(pixels) and not 0 <= pixels.min() <= pixels.max() < self.pixels:
            raise InputError(f"there are {self.pixels} pixels, got {pixels.min()}..{pixels.max()}")
        scale, shift, period = 1 / self.axis.bin_width, self.axis.shift_bins, self.axis.period_bins
        width = max(self._resolution * scale, MIN_WIDTH_BINS)

        def add(piece: slice, steps: AnyArray) -> None:
            add_times(pixels[piece], times[piece], scale, shift, width, period, steps)

        self._add_in_parallel(add, len(records))
