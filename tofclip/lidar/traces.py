"""Where the search for returns takes its traces from: the brightness of each pixel over time, some
pixels at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.shots import Frames


@dataclass(frozen=True)
class TraceBins:
    """Which bins of a time axis traces hold."""

    numbers: NDArray[np.int64]  # (n,), increasing
    # (n,), whether a return may lie there. Wherever one may, all bins that its search and its fit
    # look at are held
    search_mask: NDArray[np.bool_]
    # (n,), for how many bins of the axis each one stands where background and noise are concerned
    bin_weights: NDArray[np.float32]

    @classmethod
    def all_bins(cls, bins: int) -> TraceBins:
        """Return all bins of an axis, every one for itself."""
        return cls(np.arange(bins), np.ones(bins, bool), np.ones(bins, np.float32))


class Traces(Protocol):
    """Anything that hands out pixels' traces."""

    pixels: NDArray[np.int64]
    """Numbers of the pixels, counted in raster order, in the order in which their traces are
    cheapest to have.
    """

    bins: TraceBins
    """The bins that they hold."""

    def fill(self, piece: slice, traces: NDArray[np.float32]) -> None:
        """Write the traces of ``pixels[piece]`` into (n, bins) contiguous memory.

        `piece`: of the pixels; `traces` (n, bins): overwritten.
        """
        ...


class PictureTraces:
    """Traces of pictures at some bins that are there already.

    `pictures` (bins, rows, columns); `bins`: which ones they show.
    """

    def __init__(self, pictures: NDArray[np.float32], bins: TraceBins) -> None:
        self._pictures = pictures.reshape(len(pictures), -1).astype(np.float32, copy=False)
        self.pixels, self.bins = np.arange(self._pictures.shape[1]), bins

    def fill(self, piece: slice, traces: NDArray[np.float32]) -> None:
        """Write traces of neighbours in raster order.

        Arguments and result are those of `Traces.fill`.
        """
        from tofclip.solvers.kernels import copy_lanes_to_frames

        # contiguous: the loop is compiled for solvers' blocks, and copying short runs costs little
        copy_lanes_to_frames(np.ascontiguousarray(self._pictures[:, piece]), traces)


class FrameTraces(PictureTraces):
    """Traces of a transient cube."""

    def __init__(self, frames: Frames) -> None:
        super().__init__(frames.values, TraceBins.all_bins(frames.times.size))
