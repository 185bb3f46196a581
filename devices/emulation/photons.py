"""Light for emulated instruments."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from devices.codec import ByteView
from devices.emulation.kernels import fill_poisson_words
from devices.timetag.codec import RECORD_BYTES
from tofclip.errors import InputError

MAX_TICK = (1 << 62) - 1
"""A tick that never comes."""


class TagStream(Protocol):
    """What falls on a time tagger, as the words that it makes of it."""

    def next_words(self, limit: int, last: int) -> ByteView:
        """Return the next words: `limit` at most, none of them later than tick `last`; fewer is for
        good.

        Wraps of the counter are among them. How a stream is cut into calls does not change it.

        Parameters
        ----------
        limit : int
            Words.
        last : int
            Tick.

        Returns
        -------
        (6 * words,) uint8 array
        """


class PoissonStream:
    """Photons at random, at a constant rate.

    Parameters
    ----------
    rate : float
        Photons per second on all channels together.
    clock_hz : int
        Ticks per second. There is one record at most per tick.
    seed : int
    weights : tuple of four floats
        How the photons are shared among the channels; any positive scale.
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
        words = np.empty(limit * RECORD_BYTES, np.uint8)
        written = fill_poisson_words(
            self._state, self._now, self._scale, self._weights, last, words
        )
        return words[: written * RECORD_BYTES]
