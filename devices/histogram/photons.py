"""One histogram for each kind of photon record."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from devices.codec import Records
from devices.histogram.accumulator import MIN_WIDTH_BINS, Accumulator, BinAxis
from devices.linospad2.calibration import CLOCK_PERIOD_S, BoardCalibration
from devices.linospad2.codec import PIXELS
from devices.timetag.codec import DELTA
from tofclip.errors import InputError, ShapeError

_WORD_DTYPE = np.dtype("<u4")


class StampHistogram(Accumulator):
    """Time stamps of LinoSPAD2.

    The laser's pulses are locked to the board's clock and a cycle begins with one of them, so that
    a stamp's time since its cycle began, modulo the laser's period, is its time after a pulse. A
    photon is shared out evenly over the instants that its code covers.

    Parameters
    ----------
    axis : BinAxis
    calibration : BoardCalibration
    """

    def __init__(self, axis: BinAxis, calibration: BoardCalibration) -> None:
        super().__init__(PIXELS, axis, calibration.hot_pixels)
        begins = (
            calibration.code_begins + calibration.offsets[:, np.newaxis]
        ) / axis.bin_width + axis.shift_bins
        widths = np.maximum(
            (calibration.code_ends - calibration.code_begins) / axis.bin_width, MIN_WIDTH_BINS
        )
        if axis.period is not None:
            begins %= axis.period_bins  # small numbers keep their digits in float32
        self._codes = np.stack([begins, widths], axis=-1).astype(np.float32)

    def add(self, records: Records) -> None:
        """Add time stamps, an array of `devices.linospad2.codec.STAMP_DTYPE` (with or without
        counter).
        """
        if records.dtype.names is None or records.dtype.names[-2:] != ("code", "pixel"):
            raise InputError(f"LinoSPAD2's time stamps end in code and pixel, got {records.dtype}")
        from devices.histogram.kernels import add_stamps

        rows = np.ascontiguousarray(records).view(_WORD_DTYPE).reshape(len(records), -1)
        clock, period = CLOCK_PERIOD_S / self.axis.bin_width, self.axis.period_bins

        strays: list[int] = []  # appending is safe on several threads

        def add(piece: slice, steps: NDArray[Any]) -> None:
            strays.append(add_stamps(rows[piece], clock, self._codes, period, steps))

        self._add_in_parallel(add, len(records))
        if any(strays):
            raise InputError(
                f"LinoSPAD2 has {PIXELS} pixels; {sum(strays)} time stamps are of others"
            )


class TagHistogram(Accumulator):
    """Time tags of a counter with a few channels, one of which sees the laser.

    A photon's time is counted from the last pulse before it; after a gap, photons are left out
    until the next pulse.

    Parameters
    ----------
    axis : BinAxis
    sync_channel : int
        Where the laser's pulses arrive.
    pixel_channels : tuple of int
        The channel of each pixel of the line.
    tick : float
        Duration of a tick of the counter, s.
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
        if not (np.isfinite(tick) and tick > 0):
            raise InputError(f"a tick must be a positive number of seconds, got {tick}")
        self._sync = 1 << sync_channel
        self._pixel_of = np.full(max(channels) + 1, -1, np.int64)
        self._pixel_of[list(pixel_channels)] = np.arange(len(pixel_channels))
        self._tick_bins = tick / axis.bin_width
        self._known = -1

    def add(self, records: Records, after_gap: bool = False) -> None:
        """Add time tags, an array of `devices.timetag.codec.RECORD_DTYPE`; `after_gap`: some are
        missing before them.

        Parameters
        ----------
        records : (n,) array of `devices.timetag.codec.RECORD_DTYPE`
        after_gap : bool
        """
        from devices.histogram.kernels import add_tags, find_last_sync

        # Sync pulses may be among the missing records, so that the last known one may be of an
        # earlier period.
        if after_gap:
            self._known = -1
        known, columns = (
            self._known,
            [records[name] for name in ("time_ticks", "channels", "flags")],
        )

        def add(piece: slice, steps: NDArray[Any]) -> None:
            # Each thread begins in the middle of the batch and looks back for the pulse that counts
            # there.
            start = find_last_sync(*columns, DELTA, self._sync, piece.start, known)
            place = (self._pixel_of, self._tick_bins, self.axis.shift_bins, self.axis.period_bins)
            add_tags(
                *(column[piece] for column in columns), DELTA, self._sync, start, *place, steps
            )

        self._add_in_parallel(add, len(records))
        self._known = find_last_sync(*columns, DELTA, self._sync, len(records), known)


class TimeHistogram(Accumulator):
    """Photons of which pixel and time are known, as files of photon-counting electronics hold them.

    Parameters
    ----------
    pixels : int
    axis : BinAxis
    resolution : float
        Width of the electronics' own bins, s, over which a photon is shared out.
    """

    def __init__(self, pixels: int, axis: BinAxis, resolution: float = 0.0) -> None:
        super().__init__(pixels, axis)
        if not (np.isfinite(resolution) and resolution >= 0):
            raise InputError(f"a resolution must be a number of seconds from 0, got {resolution}")
        self._width = max(resolution / axis.bin_width, MIN_WIDTH_BINS)

    def add(self, pixels: NDArray[Any], times: NDArray[Any]) -> None:
        """Add photons.

        Parameters
        ----------
        pixels : (n,) int array
        times : (n,) array
            Beginning of the electronics' bin, s after the laser's pulse.

        Raises
        ------
        ShapeError
            Pixels and times differ in number.
        InputError
            There is no such pixel, or a time is not finite.
        """
        if pixels.ndim != 1 or pixels.shape != times.shape:
            raise ShapeError("pixels and times", "(photons,) both", (pixels.shape, times.shape))
        if len(pixels) and not (pixels.min() >= 0 and pixels.max() < self.pixels):
            raise InputError(f"there are {self.pixels} pixels, got {pixels.min()}..{pixels.max()}")
        if not np.all(np.isfinite(times)):
            raise InputError("a photon's time must be finite")
        from devices.histogram.kernels import add_times

        scale, shift, period = 1 / self.axis.bin_width, self.axis.shift_bins, self.axis.period_bins

        def add(piece: slice, steps: NDArray[Any]) -> None:
            add_times(pixels[piece], times[piece], scale, shift, self._width, period, steps)

        self._add_in_parallel(add, len(pixels))
