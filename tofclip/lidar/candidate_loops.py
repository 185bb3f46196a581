"""Loops over candidates: what each is compared with, and which of them are returns.

Only methods that have candidates import this module: the compiler takes as long to import as all
else.
"""

from __future__ import annotations

import math

import numpy as np

from tofclip.compiling import ONE, compile_loop, inlined
from tofclip.units import SPEED_OF_LIGHT


@compile_loop()
def raise_maxima(pixel, time, intensity, axis, strongest, brightest):
    """Raise the largest intensity of each pixel and of each instant to those of some candidates.

    `pixel` (n,); `time, intensity` (n,); `axis`: first instant, s, and how many slots there are in
    a second; `strongest` (pixels,): raised; `brightest` (slots,): raised.
    """
    for number in range(pixel.size):
        here, own, at = intensity[number], pixel[number], find_slot(time[number], axis)
        strongest[own] = max(strongest[own], here)
        brightest[at] = max(brightest[at], here)


@inlined
def find_slot(time, axis):
    """Number of the slot that is nearest to an instant.

    `time`: s; `axis`: as for `raise_maxima`.
    """
    return int((time - axis[0]) * axis[1] + 0.5)


@compile_loop()
def mark_strong(pixel, time, intensity, axis, of_pixel, of_slot, strong):
    """Say which candidates are as bright as their pixel and their instant ask.

    `pixel, time, intensity, axis`: as for `raise_maxima`; `of_pixel` (pixels,): least intensity in
    each pixel; `of_slot` (slots,): least intensity at each instant; `strong` (n,): overwritten.
    """
    for number in range(pixel.size):
        here = intensity[number] >= of_pixel[pixel[number]]
        strong[number] = here & (intensity[number] >= of_slot[find_slot(time[number], axis)])


@compile_loop()
def list_kept(pixel, values, kept, columns, pixels, places, numbers, lengths, intensity):
    """List the candidates that are returns.

    `pixel` (n,): not decreasing; `values` (3, n): instants, s, intensities, and deviations of the
    instants, s; `kept` (n,); `columns`: of the picture; `pixels` (k,): overwritten: pixels of those
    that are kept; `places` (2, k): overwritten: their rows and columns; `numbers` (k,):
    overwritten: 1 for the first of a pixel; `lengths` (3, k): overwritten: instants, s, ranges and
    deviations of these, m; `intensity` (k,): overwritten.
    """
    listed, before, rank, row, row_start = np.uintp(0), -1, 0, 0, 0
    for number in range(pixel.size):
        if not kept[number]:
            continue
        own = pixel[number]
        rank = rank + 1 if own == before else 1
        before = own
        # pixels come in their order: a division for each would take as long as all else
        while own >= row_start + columns:
            row += 1
            row_start += columns
        pixels[listed] = own
        places[0, listed], places[1, listed] = row, own - row_start
        numbers[listed] = rank
        lengths[0, listed] = values[0, number]
        lengths[1, listed] = SPEED_OF_LIGHT / 2 * values[0, number]
        lengths[2, listed] = SPEED_OF_LIGHT / 2 * values[2, number]
        intensity[listed] = values[1, number]
        listed += ONE


@compile_loop()
def pool_significance(pixel, at, distance, own, starts, image_shape, limits, pooled):
    """Add to each candidate's significance those of its neighbours at the same range.

    `pixel` (n,): not decreasing; `at` (n,): range at which neighbours are looked for, m; `distance`
    (n,): range of each candidate, m; `own` (n,); `starts` (pixels + 1,): first candidate of each
    pixel; `limits`: radius in pixels, and gate in m for each of them; `pooled` (n,): overwritten.
    """
    rows, columns = image_shape
    radius, gate = limits
    reach = int(radius)
    for number in range(pixel.size):
        y, x = pixel[number] // columns, pixel[number] % columns
        total = own[number]
        for j in range(-reach, reach + 1):
            for i in range(-reach, reach + 1):
                left = radius * radius - j * j - i * i
                inside = 0 <= y + j < rows and 0 <= x + i < columns
                if not inside or left < 0 or (j == 0 and i == 0):
                    continue
                # A ball, not a box: a neighbour farther across may differ less in range.
                most = gate * math.sqrt(left)
                there = (y + j) * columns + x + i
                for k in range(starts[there], starts[there + 1]):
                    if math.fabs(distance[k] - at[number]) <= most:
                        total += own[k]
        pooled[number] = total
