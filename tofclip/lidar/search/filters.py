"""What the search takes from the pulse, for one time axis: filters and tables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.lidar.pulse import Pulse, Table
from tofclip.lidar.search.phase_table import PhaseTable

# of the filter that looks for candidates; it costs a tenth of the matched filter's sensitivity
SHARPENING_FACTOR = 2.0


@dataclass(frozen=True)
class PulseFilters:
    """A pulse as the search for returns on a time axis needs it."""

    # (width, bins), filter that shows candidates, and the one that judges them. Entry w is the
    # weight of bin ``j + w - width // 2`` for a return at bin j
    sharp: NDArray[np.float32]
    # (width, bins), filter that shows candidates, and the one that judges them. Entry w is the
    # weight of bin ``j + w - width // 2`` for a return at bin j
    matched: NDArray[np.float32]
    sums: NDArray[np.float64]  # (bins,), of the matched filters
    gains: tuple[float, float]  # (2,), largest sums of either
    table: PhaseTable
    kernel: Table  # (curve, scale), `tofclip.lidar.Pulse.kernel_table`
    fwhm: float  # of the pulse, s

    @classmethod
    def build(cls, pulse: Pulse, times: NDArray[np.float64]) -> PulseFilters:
        """Work them out.

        `times` (bins,): seconds.
        """
        sharp, matched = build_filters(pulse, times)
        sums = matched.sum(axis=0)
        return cls(
            sharp,
            matched,
            sums.astype(np.float64),
            (float(sharp.sum(axis=0).max()), float(sums.max())),
            PhaseTable.tabulate(pulse, times),
            pulse.kernel_table(),
            pulse.fwhm,
        )


def build_filters(
    pulse: Pulse, times: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Work out the sharp filter and the matched one of a time axis.

    `times` (bins,): seconds. Returns as for `PulseFilters`.
    """
    return _build_filter(pulse.compress(SHARPENING_FACTOR), times), _build_filter(pulse, times)


def _build_filter(pulse: Pulse, times: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit-energy filter for a return at each bin, (width, bins); the time axis may be uneven.

    What a measured pulse has below zero is noise and left out. Where the axis cuts off most of the
    pulse the energy stays below one: little would be known of such a return.
    """
    before, after = pulse.support
    # what lies between two bins is reached by neither: without it rows of zeros would be applied
    half = int(np.floor(max(-before, after) / np.diff(times).min())) + 1
    filters = np.zeros((2 * half, times.size))
    for row, shift in enumerate(range(-half, half)):
        here = np.arange(max(0, -shift), min(times.size, times.size - shift))
        filters[row, here] = np.maximum(pulse(times[here + shift] - times[here]), 0)
    energy = np.sum(filters**2, axis=0)
    filters /= np.sqrt(np.maximum(energy, np.median(energy) / 2))
    return filters.astype(np.float32)
