"""Compiled loops that put photons into bins.

A photon is known to lie within an interval, the width of its converter's code: it is shared out
evenly over the interval, bin by bin. So codes of uneven width leave no ripple, which rounding every
photon to one bin would.

An interval may cover many bins. Its density is a step up by ``1 / width`` where it begins and a
step down where it ends, so only *steps* are added, each in two neighbouring bins, and the sum over
all earlier bins turns them into photons (`devices.histogram`). The cost of a photon
does not depend on its interval, and there is no branch that the processor could guess wrong.

Positions are in bins: bin k reaches from k to k + 1. An array of steps is (pixels, bins + 2)
float64.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tofclip.compiling import compile_and_keep

compiled = compile_and_keep(error_model="numpy")
inlined = njit(inline="always", error_model="numpy")


@inlined
def _add_step(row, position, height):
    """Add a step; one before the first bin counts from there, one behind the last not at all."""
    # clamped: light before the axis steps up in its first bin, light after it in the two spare ones
    inside = min(max(position, 0.0), row.size - 2.0)
    place = int(inside)
    # the step lies within a bin: the rest of its height comes into effect one bin later
    late = height * (inside - place)
    row[place] += height - late
    row[place + 1] += late


@inlined
def _add_photon(row, position, width, density, period, per_period):
    """Add one photon, folded into the first of all periods; a period of 0 means that there is none."""
    if period > 0:
        position -= math.floor(position * per_period) * period
        if (
            position + width > period
        ):  # what reaches beyond the end of a period belongs to the beginning of the next
            _add_step(row, position - period, density)
            _add_step(row, position - period + width, -density)
    _add_step(row, position, density)
    _add_step(row, position + width, -density)


@compiled
def add_stamps(stamps, clock_bins, codes, period, steps):
    """Add LinoSPAD2's time stamps, whose last two columns are code and pixel; return how many are of
    no pixel. `codes` (pixels, codes, 2): where a code begins within the first period of the clock,
    offset and start of the axis included, and its length.
    """
    number = np.uint32(codes.shape[1])
    last = stamps.shape[1] - 1
    per_period = 1.0 / period
    strays = 0
    for stamp in range(stamps.shape[0]):
        code, pixel = stamps[stamp, last - 1], stamps[stamp, last]
        if pixel >= codes.shape[0]:
            strays += 1
            continue
        # the code counts whole clock periods and a phase, whose steps are uneven (calibrated)
        periods = code // number
        phase = code - periods * number
        begin, width = np.float64(codes[pixel, phase, 0]), np.float64(codes[pixel, phase, 1])
        _add_photon(
            steps[pixel], periods * clock_bins + begin, width, 1.0 / width, period, per_period
        )
    return strays


@compiled
def add_times(pixels, times, scale, shift, width, period, steps):
    """Add photons at ``times * scale + shift``, each spread over `width` bins."""
    density, per_period = 1.0 / width, 1.0 / period
    for photon in range(times.size):
        _add_photon(
            steps[pixels[photon]], times[photon] * scale + shift, width, density, period, per_period
        )


@compiled
def find_last_sync(ticks, channels, flags, ignored, sync, before, known):
    """Return the ticks of the last sync pulse before record `before`, `known` if there is none. A
    record with one of the `ignored` flags reports levels, not edges.
    """
    for record in range(before - 1, -1, -1):
        if channels[record] & sync and not flags[record] & ignored:
            return ticks[record]
    return known


@compiled
def add_tags(ticks, channels, flags, ignored, sync, known, pixel_of, scale, shift, period, steps):
    """Add time tags, each at ``ticks since the last sync pulse * scale + shift``. `channels`: one bit
    for each that saw an edge; `ignored`: flags of records that report none; `known`: ticks at the
    last sync before the first record, -1 where there was none: photons before the first one are
    left out; `pixel_of` (channels,): negative: not a pixel.
    """
    density, per_period = 1.0 / scale, 1.0 / period
    for record in range(ticks.size):
        lines = channels[record]
        if flags[record] & ignored:
            continue
        if lines & sync:
            known = ticks[record]
        # no sync pulse yet: the photon has no time
        if known < 0:
            continue
        position = (ticks[record] - known) * scale + shift
        for channel in range(pixel_of.size):
            if (lines >> channel) & 1 and pixel_of[channel] >= 0:
                _add_photon(steps[pixel_of[channel]], position, scale, density, period, per_period)
