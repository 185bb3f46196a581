"""How well a return can be located at all: the Cramer-Rao bound of counted photons."""

from __future__ import annotations

import numpy as np

from tofclip.errors import InputError
from tofclip.lidar.pulse import Pulse
from tofclip.units import SPEED_OF_LIGHT

BIN_PHASES = 16  # positions of the arrival within a bin that the bound is averaged over
MAX_PHOTONS = 1e15
"""Sums of counts up to here are exact in double precision, and generators of chance take them."""


def compute_range_bound(pulse: Pulse, bin_width: float, photons: float, background: float) -> float:
    """Least standard deviation of the range that an unbiased estimate can have (Cramer-Rao).

    Photons are Poisson distributed; arrival and number of photons are unknown, the background is
    known. The variance is averaged over where in a bin the pulse arrives.

    Parameters
    ----------
    pulse : Pulse
        Shape of a return.
    bin_width : float
        Duration of a bin, s.
    photons : float
        Expected photons of the return.
    background : float
        Expected background photons in a bin.

    Returns
    -------
    float
        Metres: the bound of the time of flight times half the speed of light.

    Raises
    ------
    InputError
        A bin width or number of photons that is not positive, a negative background, or more than
        `MAX_PHOTONS` of either.
    """
    if not (bin_width > 0 and 0 < photons <= MAX_PHOTONS and 0 <= background <= MAX_PHOTONS):
        raise InputError(
            "bin width and photons must be positive, the background not negative, and either at most "
            f"{MAX_PHOTONS:g}; got {bin_width}, {photons} and {background}"
        )
    shape = pulse.integrate_bins(bin_width)
    first, last = shape.extent(0.0)
    bins = np.arange(np.floor(first / bin_width) - 1, np.ceil(last / bin_width) + 2) * bin_width
    # Where the pulse lies in its bin decides how well it can be located: all places count alike.
    late = bins - ((np.arange(BIN_PHASES) + 0.5) / BIN_PHASES - 0.5)[:, np.newaxis] * bin_width
    height = photons * bin_width / shape.area
    signal, slope = height * shape(late), height * shape.slope_at(late)
    expected = signal + background
    # Fisher's information of Poisson counts: derivatives squared over the expected number. A bin in
    # which nothing is expected says nothing.
    weight = np.divide(1.0, expected, out=np.zeros_like(expected), where=expected > 0)
    delay, mixed, amount = (
        np.sum(weight * term, axis=1) for term in (slope**2, slope * signal, signal**2)
    )
    # The number of photons has to be found as well: what it shares with the arrival is lost (Schur
    # complement of the 2 x 2 information matrix).
    variance = 1 / (delay - mixed**2 / amount)
    return float(SPEED_OF_LIGHT / 2 * np.sqrt(variance.mean()))
