"""From photons, one by one, to line transients: how many came to each pixel of a line at each
instant.
"""

from devices.histogram.accumulator import Accumulator, BinAxis
from devices.histogram.photons import StampHistogram, TagHistogram, TimeHistogram

__all__ = ["Accumulator", "BinAxis", "StampHistogram", "TagHistogram", "TimeHistogram"]
