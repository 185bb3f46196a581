"""Light that falls on an emulated time tagger, as its words: even, or of a pulsed scene."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from devices.codec import ByteView, Records
from devices.scenes import LineLight
from devices.timetag.codec import COUNTER_RANGE, RECORD_BYTES, RECORD_DTYPE, WRAP
from tofclip.errors import InputError

MAX_TICK = (1 << 62) - 1
"""A tick that never comes."""


class TagStream(Protocol):
    """What falls on a time tagger, as the words that it makes of it."""

    def next_words(self, limit: int, last: int) -> ByteView:
        """Return the next words: `limit` at most, none of them later than tick `last`; fewer is for
        good.

        Wraps of the counter are among them. How a stream is cut into calls does not change it.

        `limit`: words; `last`: tick. Returns (6 * words,).
        """


class PoissonStream:
    """Photons at random, at a constant rate.

    `rate`: photons per second on all channels together; `clock_hz`: ticks per second. There is one
    record at most per tick; `weights`: how the photons are shared among the channels; any positive
    scale.
    """

    def __init__(
        self,
        rate: float,
        clock_hz: int,
        seed: int,
        weights: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0),
    ) -> None:
        if not 0 < rate < clock_hz:
            raise InputError(
                f"a rate must be above 0 and below the clock's {clock_hz} per second, got {rate:g}"
            )
        # The whole part of an exponential variable is geometric, here with mean (ticks per photon)
        # - 1.
        self._scale = 1 / math.log1p(1 / (clock_hz / rate - 1))
        self._weights = np.cumsum(weights) / np.sum(weights)
        self._state = np.array([seed], np.uint64)
        self._now = np.zeros(1, np.int64)

    def next_words(self, limit: int, last: int) -> ByteView:
        """Return the next words; see `TagStream`.

        Arguments and result are those of `TagStream.next_words`.
        """
        from devices.timetag.kernels import fill_poisson_words

        words = np.empty(limit * RECORD_BYTES, np.uint8)
        written = fill_poisson_words(
            self._state, self._now, self._scale, self._weights, last, words
        )
        return words[: written * RECORD_BYTES]


SYNC_MASK = 1
"""Channel 0 sees the laser."""

PIXEL_MASKS = np.array([2, 4, 8], np.uint32)
PERIOD_TICKS = 1 << 7
PULSES_PER_BLOCK = 1 << 13
SCENE_SCALE = 64
"""The scene is this many times as large as a table-top one, and its light takes as many times as long: the counter's
ticks are 1.2 m of range."""

BLOCK_TICKS = (
    PERIOD_TICKS * PULSES_PER_BLOCK
)  # a divisor of the counter's range: it wraps where a block begins


class PulsedSceneStream:
    """Photons of a line of pixels after each pulse of a laser; see
    `devices.timetag.light.TagStream`.

    Three detectors stand at a sixth, a half and five sixths of the line. Photons that one of them
    sees within a tick count as one; what several channels see within a tick is one record. Memory:
    one block of 8192 pulses.

    `light`: of the scene before it is enlarged; after that, all within the laser's period of 128
    ticks; `rate`: photons per second on the three pixels together.
    """

    def __init__(self, light: LineLight, rate: float, clock_hz: int, seed: int) -> None:
        columns = light.photons.shape[1] * np.array([1, 3, 5]) // 6
        self._cumulative_photons = np.cumsum(light.photons[:, columns])
        times = light.row_times * SCENE_SCALE
        self._row_ticks = (times[1] - times[0]) * clock_hz
        self._delays = times * clock_hz - self._row_ticks / 2
        if not 0 < rate <= clock_hz:
            raise InputError(
                f"a rate must be above 0 and at most {clock_hz} per second, got {rate:g}"
            )
        if self._delays[0] < -self._row_ticks or self._delays[-1] + self._row_ticks >= PERIOD_TICKS:
            raise InputError(
                f"the light must come within the laser's period of {PERIOD_TICKS / clock_hz:.3g} s"
            )
        self._photons_per_block = rate * BLOCK_TICKS / clock_hz
        self._seed, self._block = seed, 0
        self._ticks: NDArray[np.int64] = np.empty(0, np.int64)
        self._words: ByteView = np.empty(0, np.uint8)

    def next_words(self, limit: int, last: int) -> ByteView:
        """Return the next words; see `TagStream`.

        Arguments and result are those of `TagStream.next_words`.
        """
        taken, left = [], limit
        while left:
            if not len(self._ticks):
                self._fill_block()
            ready = min(left, int(np.searchsorted(self._ticks, last, side="right")))
            taken.append(self._words[: ready * RECORD_BYTES])
            left -= ready
            self._ticks, self._words = self._ticks[ready:], self._words[ready * RECORD_BYTES :]
            if len(self._ticks):
                break
        return np.concatenate(taken) if taken else np.empty(0, np.uint8)

    def _fill_block(self) -> None:
        """Make the records of the next pulses; the same number of a block gives the same records."""
        from devices.timetag.kernels import encode_timetags

        records = self._draw_records(np.random.default_rng([self._seed, self._block]))
        first = self._block * BLOCK_TICKS
        self._block += 1
        if first == 0:
            records = records[records["time_ticks"] > 0]  # a zero would be taken for a wrap
        elif first % COUNTER_RANGE == 0:
            records["flags"][0] = WRAP
        self._ticks = records["time_ticks"] + first
        self._words = np.empty(len(records) * RECORD_BYTES, np.uint8)
        encode_timetags(self._ticks, records["channels"], records["flags"], self._words)

    def _draw_records(self, random: np.random.Generator) -> Records:
        """Draw a block's pulses and photons, in ticks since the block began."""
        total = random.poisson(self._photons_per_block)
        row, pixel = np.divmod(
            np.searchsorted(
                self._cumulative_photons,
                random.uniform(0, self._cumulative_photons[-1], total),
                "right",
            ),
            3,
        )
        delay = self._delays[row] + random.uniform(0, self._row_ticks, total)
        # The half of the first row that lies before its pulse belongs to the pulse before, in
        # blocks as in the counter.
        ticks = (
            random.integers(0, PULSES_PER_BLOCK, total) * PERIOD_TICKS + np.floor(delay).astype(int)
        ) % BLOCK_TICKS
        pulses = np.arange(PULSES_PER_BLOCK) * PERIOD_TICKS
        all_ticks = np.concatenate([pulses, ticks])
        channels = np.concatenate(
            [np.full(PULSES_PER_BLOCK, SYNC_MASK, np.uint32), PIXEL_MASKS[pixel]]
        )
        order = np.argsort(all_ticks, kind="stable")
        distinct, begins = np.unique(all_ticks[order], return_index=True)
        records = np.zeros(len(distinct), RECORD_DTYPE)
        records["time_ticks"] = distinct
        records["channels"] = np.bitwise_or.reduceat(channels[order], begins)
        return records
