"""The search for returns with the array API standard: all pixels of a piece at once, in arrays of any
library and on any device.

The steps are those of `tofclip.lidar.search`. Functions that do the same have the same names in
`tofclip.lidar.search.candidates` and `tofclip.lidar.pulse_fit`, where they take one pixel after the
other. Here a loop runs over the returns of a pixel, at most `Detection.max_returns`, and arrays hold
one entry for each pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, as_type, namespace, to_numpy
from tofclip.lidar.detection import Detection
from tofclip.lidar.pulse import Pulse
from tofclip.lidar.search.array_fit import PulseFitter
from tofclip.lidar.search.array_peaks import Filters, FloatArray, PeakSearch
from tofclip.shots import Frames
from tofclip.threads import split_blocks

Candidates = tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray]

WORKING_BYTES = 1 << 30
"""What a search may take for the pixels that it looks at at once."""

# arrays of the traces' size at once: they, centred, two filters' responses, maxima, temporaries
WORKING_ARRAYS = 8


class ArrayTraces:
    """Traces of a transient cube in an array of any library."""

    def __init__(self, frames: Frames) -> None:
        self.values = namespace(frames.values).reshape(
            as_type(frames.values, np.float32), (frames.times.size, -1)
        )


class ArraySearch:
    """What `tofclip.lidar.search.trace_search.TraceSearch` does, for many pixels at once.

    Peaks and fits are found step for step as there; only what was found, a few numbers for each
    return, is fetched. Memory on the device: 1 GiB beside the frames.

    `times` (bins,): s, increasing; `filters`: see `PeakSearch`.
    """

    def __init__(
        self, times: FloatArray, filters: Filters, pulse: Pulse, detection: Detection
    ) -> None:
        self._peaks, self._fit = (
            PeakSearch(times, filters, pulse, detection),
            PulseFitter(times, pulse),
        )
        self._min_signal_to_noise = detection.signal_to_noise

    def find_candidates(self, traces: Array) -> Candidates:
        """Return pixel number, instant, counts and deviation of every candidate, in raster and time
        order.

        `traces` (bins, pixels).
        """
        bins, pixels = traces.shape
        at_once = max(1, WORKING_BYTES // (WORKING_ARRAYS * bins * np.dtype(np.float32).itemsize))
        found = [
            self._search_pixels(traces[:, piece], piece.start)
            for piece in split_blocks(pixels, at_once)
        ]
        pixel, time, signal, deviation = (np.concatenate(part) for part in zip(*found, strict=True))
        return pixel, time, signal, deviation

    def _search_pixels(self, traces: Array, number: int) -> Candidates:
        """Search some pixels, the first of which has the given number."""
        xp = namespace(traces)
        peaks = self._peaks.take_strongest_peaks(traces)
        (pixels,) = xp.nonzero(xp.any(peaks.valid, axis=0))
        chosen = peaks.select(pixels)
        fit = self._fit.refine_returns(xp.take(traces, pixels, axis=1), chosen)
        described = self._fit.measure_returns(
            fit, chosen.noise, self._min_signal_to_noise * chosen.noise
        )
        proven, signal, deviation = (
            to_numpy(xp.stack(list(part))) for part in zip(*described, strict=True)
        )
        time, numbers = to_numpy(xp.stack(fit.arrival)), number + to_numpy(pixels).astype(np.int64)
        pixel = np.broadcast_to(numbers, proven.shape)[proven]
        order = np.lexsort((time[proven], pixel))
        return pixel[order], time[proven][order], signal[proven][order], deviation[proven][order]
