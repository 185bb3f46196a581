"""The response to a single return, learnt from the photons of a scene whose surfaces are unknown.

Two photons of one surface in one pixel differ in time by what the response spreads them: the
histogram of such differences is the response's autocorrelation, whatever the scene. It gives the
width; the shape is what photons show around a surface that other photons found.

What a picture's photons are made of: the response to a return, and the background.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.lidar.photons.image import FloatArray, PhotonImage
from tofclip.lidar.pulse import Pulse
from tofclip.units import PICOSECOND

MAX_LAG_FRACTION = 0.25
"""Of the time axis: photons further apart than this are not of one pulse."""

MIN_LAG_SIGNIFICANCE = 8.0
"""Standard deviations by which pairs of photons must exceed those that meet by chance."""

SAMPLES_PER_WIDTH = 24
SMOOTHING_WIDTHS = 1 / 12
EXTENT_WIDTHS = (-3.0, 9.0)
"""Full widths before and after the surface in which the response is learnt: tails are long."""

BACKGROUND_WIDTHS = (-8.0, -4.0)
"""Full widths before the surface where only background is expected."""

MIN_PULSE_S = 1e-12
"""Superconducting counters, the quickest there are, spread a pulse over 3 ps."""

STEP_QUANTILE, MIN_STEP_BINS, MIN_PHOTONS_PER_STEP = 0.05, 64, 4.0
"""Of the gaps between bins with photons, the one that is taken for the counter's step; and how many
such bins with how many photons each say that the bins between them stay empty for a reason."""

DENSITY_FLOOR = 1e-4
"""Of the peak: no instant is impossible, so that no single photon decides."""


@dataclass(frozen=True)
class BinnedResponse:
    """Density of a signal photon's time around its surface, as bins show it."""

    pulse: Pulse  # shape of a return, bins included
    bin_width: float  # s

    @classmethod
    def from_pulse(cls, pulse: Pulse, bin_width: float) -> BinnedResponse:
        """Spread a pulse over the bins in which it is counted.

        `bin_width`: seconds.
        """
        return cls(pulse.integrate_bins(bin_width), bin_width)

    @property
    def step(self) -> float:
        """Time between two samples, in bins."""
        return self.pulse.spacing / self.bin_width

    @property
    def start(self) -> float:
        """Time of the first sample after the surface, in bins."""
        return -self.pulse.origin * self.step

    @property
    def width(self) -> float:
        """Full width at half maximum, in bins."""
        return self.pulse.fwhm / self.bin_width

    @cached_property
    def density(self) -> FloatArray:
        """Probability density of a photon's time at each sample, per bin."""
        samples = np.maximum(self.pulse.samples, DENSITY_FLOOR)
        density: FloatArray = samples / (samples.sum() * self.step)
        return density

    @cached_property
    def log_slope(self) -> FloatArray:
        """Minus the slope of the density's logarithm at each sample, per bin."""
        slope: FloatArray = -np.gradient(np.log(self.density), self.step)
        return slope

    def coarse_shares(self, coarse: int) -> tuple[FloatArray, int]:
        """Share of the photons in each coarse bin around the one that holds the surface.

        `coarse`: bins in a coarse one. Returns (n,): the shares, and the number of the first coarse
        bin relative to the surface's. The surface may lie anywhere in its coarse bin.
        """
        times = self.start + self.step * np.arange(self.density.size)
        # The surface may lie anywhere in its coarse bin: eight places, in the middles of eighths.
        inside = np.arange(8) / 8 + 1 / 16 - 0.5
        position = times[:, np.newaxis] / coarse + inside
        number = np.floor(position + 0.5).astype(np.int64)
        first = int(number.min())
        weight = np.repeat(self.density[:, np.newaxis], inside.size, axis=1)
        shares = np.bincount((number - first).ravel(), weight.ravel()).astype(np.float64)
        shares /= shares.sum()
        # Shares of a thousandth of the greatest change no decision, but make every sum longer.
        kept = np.flatnonzero(shares > 1e-3 * shares.max())
        return shares[kept[0] : kept[-1] + 1], first + int(kept[0])


def find_time_step(photons: PhotonImage) -> int:
    """Return the bins between the instants that a counter tells apart: photon times in units of
    1 ps come in steps of its converter, and pairs of equal times are no pulse.
    """
    filled = np.flatnonzero(photons.time_profile)
    if filled.size < MIN_STEP_BINS or photons.photons < MIN_PHOTONS_PER_STEP * filled.size:
        return 1
    return int(np.quantile(np.diff(filled), STEP_QUANTILE))


def require_plausible_pulse(photons: PhotonImage, pulse: Pulse) -> None:
    """Refuse a pulse that no counter shows, or that is longer than the record, as of a wrong unit."""
    if pulse.fwhm < MIN_PULSE_S:
        fault = "shorter than any counter's"
    elif pulse.fwhm > photons.bins * photons.bin_width:
        fault = f"longer than all {photons.bins} bins"
    else:
        return
    raise InputError(
        f"a pulse of {pulse.fwhm / PICOSECOND:.3g} ps in bins of {photons.bin_width / PICOSECOND:.4g} "
        f"ps is {fault}; check the unit of `bin_width`"
    )


def measure_pulse_width(photons: PhotonImage) -> float:
    """Estimate the full width at half maximum of the response from pairs of photons.

    Returns s; that of the Gaussian whose autocorrelation falls to half as soon.
    """
    from tofclip.lidar.photons.surface_kernels import sum_pair_lags

    number = max(8, int(MAX_LAG_FRACTION * photons.bins))
    lags = np.zeros(number)
    sum_pair_lags(photons.offsets, photons.bin, photons.count, lags)
    lags[0] *= 2  # the others come with both signs
    # Photons that meet by chance: the further apart, the fewer bins there are for both.
    open_bins = photons.bins - np.arange(number)
    chance = np.median((lags / open_bins)[number // 2 :].reshape(-1)) * open_bins
    group = 1
    while number // group >= 8:
        pieces = number // group
        pairs = lags[: pieces * group].reshape(pieces, group).sum(axis=1)
        expected = chance[: pieces * group].reshape(pieces, group).sum(axis=1)
        excess = pairs - expected
        # counts below one make negative pairs: a photon is none with itself
        if excess[0] > MIN_LAG_SIGNIFICANCE * np.sqrt(max(expected[0] + pairs[0], 0.0) + 1):
            below = np.flatnonzero(excess < excess[0] / 2)
            if below.size:
                last = int(below[0])
                part = (excess[last - 1] - excess[0] / 2) / (excess[last - 1] - excess[last])
                half = (last - 1 + part + (0.5 if group > 1 else 0.0)) * group
                return float(np.sqrt(2) * max(half, 0.5) * photons.bin_width)
        group *= 2
    raise InputError(
        "no pulse stands out from the background in these photons; give its width (`pulse`)"
    )


def learn_response(
    residual_bins: NDArray[np.float64], count: NDArray[np.float32], width: float, bin_width: float
) -> tuple[Pulse, float]:
    """Estimate the shape of the response from the times of photons after their surface.

    `residual_bins` (photons,): time after the surface, which other photons found, in bins; `count`
    (photons,); `width`: rough full width at half maximum, in bins; `bin_width`: s. Returns the
    response, whose arrival is its highest point, and by how many bins later this is than the
    arrival was before.
    """
    step = width / SAMPLES_PER_WIDTH
    first, last = (round(edge * SAMPLES_PER_WIDTH) for edge in EXTENT_WIDTHS)
    early = [round(edge * SAMPLES_PER_WIDTH) for edge in BACKGROUND_WIDTHS]
    number = np.rint(residual_bins / step).astype(np.int64)
    known = (number >= early[0]) & (number <= last)
    photons = np.bincount(number[known] - early[0], count[known], last - early[0] + 1)
    # Before the pulse there is only background; behind it its own tail would count as one.
    level = float(np.mean(photons[: early[1] - early[0]]))
    shape = scipy.ndimage.gaussian_filter1d(photons, SMOOTHING_WIDTHS * SAMPLES_PER_WIDTH)[
        first - early[0] :
    ]
    # A density is not negative, whatever noise does to the tail.
    shape = np.maximum(shape - level, 0.0)
    if not shape.any():
        raise InputError("there is no light around the surface to learn the pulse from")
    peak = int(np.argmax(shape))
    edge = max(1, min(peak, shape.size - 1 - peak))
    before, here, after = shape[max(peak - 1, 0)], shape[peak], shape[min(peak + 1, shape.size - 1)]
    # Vertex of the parabola through the highest sample and its neighbours.
    bend = 2 * here - before - after
    part = float((after - before) / (2 * bend)) if edge >= 1 and bend > 0 else 0.0
    return Pulse(shape, step * bin_width, peak + part), (first + peak + part) * step


MIN_SIGNAL_PHOTONS = 0.05

BACKGROUND_QUANTILE, BACKGROUND_GROUPS = 0.2, 64

MIN_BACKGROUND_PHOTONS = 1.0
"""Of the whole picture: no background is exactly zero."""


@dataclass(frozen=True)
class Scene:
    """What a picture's photons are taken to be made of."""

    response: BinnedResponse
    background: float  # photons of a pixel in a bin

    def scale(self, fraction: float) -> Scene:
        """Return what remains with a fraction of the photons."""
        return Scene(self.response, self.background * fraction)

    def count_signal(self, photons: PhotonImage) -> float:
        """Mean signal photons of a pixel."""
        mean = photons.photons / (photons.offsets.size - 1)
        return max(mean - self.background * photons.bins, MIN_SIGNAL_PHOTONS)


def estimate_background(photons: PhotonImage) -> float:
    """Background photons of a pixel in a bin: what most instants have, surfaces being at few."""
    groups = min(BACKGROUND_GROUPS, photons.bins)
    edges = np.linspace(0, photons.bins, groups + 1).astype(np.int64)
    level = np.add.reduceat(photons.time_profile, edges[:-1]) / np.diff(edges)
    pixels = photons.offsets.size - 1
    # a low quantile: bins with a surface in them are brighter than the background
    quiet = float(np.quantile(level, BACKGROUND_QUANTILE))
    return max(quiet, MIN_BACKGROUND_PHOTONS / photons.bins) / pixels
