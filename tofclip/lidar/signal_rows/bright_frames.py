"""In which frames a pixel stands out, without looking at every pixel of every frame.

The filter that is matched to a lone pixel is a product with the transpose of the operator, as large
as the recovery itself. But only whether any pixel reaches a limit is asked for, and of a few
neighbours in a row it can be said for an eighth of the work that none does: each view's light falls
between two neighbouring measurements, at nearly the same fraction for all of them, so that none gets
more than the highest value that interpolation there has in a short window.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.lidar.signal_rows.windows import FRACTION_SLACK, FRACTIONS, WINDOW
from tofclip.operators.sparse import Tiles
from tofclip.threads import LANES, count_block_threads, run_blocks

Mask = NDArray[np.bool_]

ROUNDING_MARGIN = 1e-4
"""By which a bound is raised: sums in float32 may be off by a tenth of it."""


class BrightFrameFinder:
    """Says in which frames the matched filter of any pixel reaches a limit.

    `tiles`: the operator's transpose, a row for each pixel; its entries are not negative;
    `measurements`: columns of it; `group_pixels`: successive rows that are ruled out together:
    neighbours in a row of the picture.
    """

    def __init__(self, tiles: Tiles, measurements: int, group_pixels: int) -> None:
        if tiles.values.size and tiles.values.min() < 0:
            raise InputError("bright frames are found for operators without negative entries")
        self._tiles, self._group_pixels = tiles, group_pixels
        pixel, column, weight, fraction = _list_pairs(tiles)
        pixels = tiles.starts.shape[1] - 1
        entries = np.repeat(np.tile(np.arange(pixels), len(tiles.starts)), _count_entries(tiles))
        energy = np.bincount(entries, tiles.values.astype(np.float64) ** 2, minlength=pixels)
        scales = np.divide(1, np.sqrt(energy), out=np.zeros(pixels), where=energy > 0)
        self._scales = scales.astype(tiles.values.dtype)

        # Pairs of a group at nearly the same fraction share a window, as far as it reaches.
        group = pixel // group_pixels
        part = np.clip((FRACTIONS * fraction + FRACTION_SLACK).astype(np.int64), 0, FRACTIONS - 1)
        order = np.lexsort((column, part, group))
        group, part, column = group[order], part[order], column[order]
        run = np.flatnonzero(
            (np.diff(group, prepend=-1) != 0)
            | (np.diff(part, prepend=-1) != 0)
            | (np.diff(column, prepend=0) > WINDOW)
        )
        offset = column - np.repeat(column[run], np.diff(run, append=column.size))
        run_number = np.repeat(np.arange(run.size), np.diff(run, append=column.size))
        step = offset // WINDOW
        begins = np.flatnonzero(
            (np.diff(run_number, prepend=-1) != 0) | (np.diff(step, prepend=-1) != 0)
        )
        self._windows = (part[begins] * measurements + column[begins]).astype(np.int32)
        self._group_starts = np.searchsorted(
            group[begins], np.arange(-(-pixels // group_pixels) + 1)
        )
        # the most that a window of ones adds to any pixel of the group
        window = np.repeat(np.arange(begins.size), np.diff(begins, append=column.size))
        share = np.bincount(
            window * group_pixels + pixel[order] % group_pixels,
            (weight * scales[pixel])[order],
            minlength=begins.size * group_pixels,
        )
        highest = share.reshape(-1, group_pixels).max(axis=1, initial=0)
        self._weights = (highest * (1 + ROUNDING_MARGIN)).astype(np.float32)

    def find(self, readings: NDArray[np.float32], span: slice, limit: float) -> Mask:
        """Say in which frames a pixel stands out.

        `readings` (measurements, frames): in units of their noise. Whole blocks of twice `LANES`
        frames from the first of the span on lie within it; `span`: of the frames; `limit`: response
        of the filter ``a'f / |a|`` from which a pixel stands out, a being its column of the
        operator. Returns (frames of the span,).
        """
        # the compiler takes as long to import as all else
        from tofclip.lidar.signal_rows.kernels import find_bright_frames

        number = span.stop - span.start
        bright = np.full(number, limit <= 0)
        if limit > 0:
            threads = count_block_threads()
            run_blocks(
                lambda piece: find_bright_frames(
                    *self._tiles,
                    self._scales,
                    self._group_pixels,
                    self._group_starts,
                    self._windows,
                    self._weights,
                    readings,
                    span.start + piece.start,
                    np.float32(limit),
                    bright[piece],
                ),
                number,
                -(-number // (2 * LANES * threads)) * 2 * LANES,
            )
        return bright


def _count_entries(tiles: Tiles) -> NDArray[np.int64]:
    """How many entries each row has, tile by tile."""
    return np.diff(tiles.starts, axis=1).ravel()


def _list_pairs(
    tiles: Tiles,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """List each row's entries two by two, as far as they are neighbours.

    Returns `row` (pairs,); `column` (pairs,): the first of two; `weight` (pairs,): sum of both;
    `fraction` (pairs,): what the second one has of it.
    """
    pixels = tiles.starts.shape[1] - 1
    row = np.repeat(np.tile(np.arange(pixels), len(tiles.starts)), _count_entries(tiles))
    order = np.lexsort((tiles.columns, row))
    row, column, value = row[order], tiles.columns[order].astype(np.int64), tiles.values[order]
    # the place of each entry in its run of neighbours: the even ones begin a pair
    begins = np.flatnonzero((np.diff(row, prepend=-1) != 0) | (np.diff(column, prepend=-2) != 1))
    place = np.arange(row.size) - np.repeat(begins, np.diff(begins, append=row.size))
    first = np.flatnonzero(place % 2 == 0)
    alone = np.append(place[1:], 0)[first] != place[first] + 1
    second = np.where(alone, 0.0, np.append(value[1:], 0)[first])
    weight = value[first] + second
    fraction = np.divide(second, weight, out=np.zeros(weight.size), where=weight > 0)
    return row[first], column[first], weight, fraction
