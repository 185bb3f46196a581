"""Pile-up: what a detector that goes blind after each photon would have counted without."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError


def correct_pile_up(
    counts: NDArray[np.integer] | NDArray[np.floating], cycles: int, dead_bins: int | None = None
) -> NDArray[np.float64]:
    """Turn a histogram of a detector with dead time into the photons that arrived (Coates 1968).

    A bin counts only in the cycles in which no photon shortly before has blinded the detector. The
    fraction of these live cycles with a count is ``1 - exp(-rate)``, which is solved for the rate.
    Bins that few cycles reach become noisier than Poisson.

    Parameters
    ----------
    counts : (..., bins) array
        Photons counted in each bin; at most one a cycle and bin.
    cycles : int
        Laser cycles that made the histogram; every cycle starts with a ready detector.
    dead_bins : int, optional
        Bins after a count during which nothing is counted. By default the rest of the cycle: the
        detector counts only the first photon of a cycle.

    Returns
    -------
    (..., bins) float64 array
        Expected photons in each bin over all cycles; NaN in bins that no live cycle reached, and
        where every live cycle counted, which leaves the rate without a bound.

    Raises
    ------
    InputError
        Negative counts, no cycle, a dead time that is not positive, or more counts than live
        cycles.

    Notes
    -----
    P. B. Coates, "The correction for photon pile-up in the measurement of radiative lifetimes", J.
    Phys. E 1, 878 (1968), Eq. 4; for a dead time shorter than the cycle the sum runs over the dead
    time only (S. Isbaner et al., Opt. Express 24, 9429, 2016).
    """
    seen, live = count_live_cycles(counts, cycles, dead_bins)
    fraction = np.divide(seen, live, out=np.ones_like(seen), where=live > 0)
    arrived = np.full_like(seen, np.nan)
    np.log1p(-fraction, out=arrived, where=fraction < 1)
    return -cycles * arrived


def count_live_cycles(
    counts: NDArray[np.integer] | NDArray[np.floating], cycles: int, dead_bins: int | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Count the cycles in which the detector was ready, bin by bin.

    `counts, cycles, dead_bins`: as for `correct_pile_up`. Returns `counts, live` (..., bins):
    photons counted, and cycles that no photon before had blinded.
    """
    seen = np.asarray(counts, dtype=np.float64)
    if cycles < 1 or not np.all(np.isfinite(seen) & (seen >= 0)):
        raise InputError(
            "pile-up needs at least one cycle and counts that are finite and not negative"
        )
    dead = seen.shape[-1] if dead_bins is None else dead_bins
    if dead < 1:
        raise InputError(f"a dead time lasts at least one bin, got {dead}")
    before = np.cumsum(seen, axis=-1) - seen
    blind = before.copy()
    blind[..., dead:] -= before[..., :-dead]
    live = cycles - blind
    if np.any(seen > live):
        raise InputError(
            f"more photons were counted than {cycles} cycles with this dead time allow"
        )
    return seen, live
