"""Where the search for returns takes its traces from: the brightness of each pixel over time, some pixels at once."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.transient import Frames


class Traces(Protocol):
    """Anything that hands out pixels' traces."""

    pixels: NDArray[np.int64]
    """Numbers of the pixels, counted in raster order, in the order in which their traces are cheapest to have."""

    def fill(self, piece: slice, traces: NDArray[np.float32]) -> None:
        """Write the traces of ``pixels[piece]`` into (n, bins) contiguous memory."""
        ...


class FrameTraces:
    """Traces of a transient cube that is there already.

    Parameters
    ----------
    frames : Frames
    """

    def __init__(self, frames: Frames) -> None:
        self._pictures = frames.values.reshape(frames.times.size, -1).astype(np.float32, copy=False)
        self.pixels = np.arange(self._pictures.shape[1])

    def fill(self, piece: slice, traces: NDArray[np.float32]) -> None:
        """Write traces of neighbours in raster order."""
        from tofclip.recovery.kernels import lanes_to_frames

        lanes_to_frames(self._pictures[:, piece], traces)
