"""Which bins a return at each bin reaches, and which are too near it for another one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def list_windows(
    times: FloatArray, scale: tuple[float, float, float, float], distance: float
) -> NDArray[np.int64]:
    """List the bins that a return at each bin reaches, and those too near for another return.

    `times` (bins,): seconds, increasing; `scale` (4,): of the pulse; see
    `tofclip.lidar.Pulse.kernel_table`; `distance`: seconds. Returns (bins, 4): first bin reached
    and the one after the last; first bin nearer than `distance` and the one after the last.

    Bins are often just `distance` apart; what then is nearer is for the rounding of their
    difference to say, and not for that of a sum with the distance.
    """
    first = np.searchsorted(times, times - distance)
    last = np.searchsorted(times, times + distance, side="right")
    first += times - times[first] >= distance
    last -= times[last - 1] - times >= distance
    claimed = [np.searchsorted(times, times + reach) for reach in scale[2:]]
    return np.stack([*claimed, first, last], axis=1).astype(np.int64)
