"""The pulse that a shot itself shows: the course of light that explains it best, from where surfaces are.

A camera's file knows one width of its pulse; an instrument's pulse may be shorter, longer, and have a
tail, as of a phosphor's afterglow. Frames show it blurred by what they mix, and wider where a pixel
spans several rows of range; a model of surfaces knows where each light comes from.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.lidar.pulse import Pulse
from tofclip.units import FWHM_PER_SIGMA

Image = NDArray[np.float32]

REACH_BEFORE, REACH_AFTER = 2.0, 14.0  # camera's pulse widths: what is looked at
SHOWN = 15_000  # lit measurements, of evenly chosen columns, say as much of a few dozen lags as all
COURSE_RIDGE = 1e-4  # of a lag's own information
# Times the camera's width: what is nearer the fit finds itself
NARROW, WIDE = 0.9, 1.1
TAIL_START = 1.5  # camera's pulse widths after the return
# Of the pulse's light, and of what a pulse without it leaves unexplained: a tail that is less may be
# light of surfaces that are off, or missing (0.4 in few photons; tails 0.5 to 1.1).
LEAST_TAIL, LEAST_EXPLAINED = 0.05, 0.45
CORES = np.arange(0.7, 1.5, 0.1)  # widths that are tried, of the one that the course shows
CORE_EXCESS = 1.1  # of the least misfit: the widest core that is as good
LAGS_BEFORE = 0.5  # pulse widths: where the core may lie before the peak
LEAST_SHARE = 1e-3  # of the pulse's light: below, a lag is none of the tail's
EXTENT_SIGMAS = 3.5  # 5e-4 of a pulse lie outside
SPLINE_LEFT_VARIANCE = 1 / 6  # rows^2: a B-spline's 1/4 without the 1/12 of the row itself
TINY = float(np.finfo(np.float32).tiny)
MIN_VARIANCE = 0.02  # rows^2, of the smoothing that is left of a pulse shorter than a row


@dataclass(frozen=True)
class ShotPulse:
    """A Gaussian core and what follows it."""

    sigma: float  # of the core, rows
    # (n,), rows after the return at which the core appears
    lags: NDArray[np.intp] = field(default_factory=lambda: np.zeros(1, np.intp))
    # (n,), its light there; the sum is 1
    shares: FloatArray = field(default_factory=lambda: np.ones(1))
    # of its light, what comes more than one and a half of the camera's widths after the peak
    tail_share: float = 0.0

    @property
    def reach(self) -> int:
        """Rows that the shares reach to either side."""
        return int(np.abs(self.lags).max(initial=0))

    def extend(self, core: Image) -> Image:
        """Return a core with all that follows it, `reach` samples longer at either end."""
        reach = self.reach
        tail = np.zeros(2 * reach + 1)
        tail[self.lags + reach] = self.shares
        return np.asarray(np.convolve(core, tail).astype(np.float32))


def measure_pulse(
    light: Image, image: Image, weights: Image, width: float, least_tail: float
) -> ShotPulse:
    """Measure the pulse of a shot, (rows, columns); the camera's, `width` rows wide at half its height,
    where it is nearly that and no more than `least_tail` of it comes late. `light`: of surfaces, as a
    pulse of an instant would show it, but for what light between rows is spread.
    """
    lags = np.arange(-int(np.ceil(REACH_BEFORE * width)), int(np.ceil(REACH_AFTER * width)) + 1)
    course = find_course(light, image, weights, lags)
    left = SPLINE_LEFT_VARIANCE / 2
    whole = np.convolve(course, [left, 1 - 2 * left, left], "same")
    own = Pulse(np.maximum(whole, 0), 1.0, 0.0).fwhm
    tail = float(course[lags > TAIL_START * width].sum() / course.sum())
    if tail < least_tail:
        usual = width if NARROW < own / width < WIDE else own
        return ShotPulse(usual / FWHM_PER_SIGMA, tail_share=tail)
    # A Gaussian core at some lags, by non-negative least squares: the widest that explains the pulse
    # as well as any. One that explains nothing better than the samples' own roundness is too narrow.
    allowed = lags[lags >= -LAGS_BEFORE * own]
    sigmas = CORES * own / FWHM_PER_SIGMA
    variances = np.maximum(sigmas**2 - SPLINE_LEFT_VARIANCE, MIN_VARIANCE)
    designs = (np.exp(-((lags[:, np.newaxis] - allowed) ** 2) / 2 / one) for one in variances)
    fits = [scipy.optimize.nnls(design, course) for design in designs]
    enough = CORE_EXCESS * min(misfit for _, misfit in fits) + 1e-9
    best = max(number for number, (_, misfit) in enumerate(fits) if misfit <= enough)
    shares = fits[best][0]
    kept = shares > LEAST_SHARE * shares.sum()
    own_lags = allowed[kept].astype(np.intp)
    return ShotPulse(float(sigmas[best]), own_lags, shares[kept] / shares[kept].sum(), tail)


def find_course(light: Image, image: Image, weights: Image, lags: NDArray[np.int64]) -> FloatArray:
    """Return how much light comes at each lag, rows, as least squares of the image."""
    before, after = int(-lags[0]), int(lags[-1])
    lit = np.flatnonzero(light.any(axis=1))
    rows = slice(max(int(lit.min(initial=0)) - before, 0), int(lit.max(initial=0)) + after + 1)
    some = rows, slice(None, None, 1 + np.count_nonzero(light) // SHOWN)
    image, root = image[some], np.sqrt(weights[some])
    seen = np.pad(light[some], ((after, before), (0, 0)))
    shifted = np.lib.stride_tricks.sliding_window_view(seen, len(image), axis=0)
    moved = np.stack([(shifted[after - lag].T * root).ravel() for lag in lags])
    information = moved @ moved.T
    usual = np.trace(information) / lags.size
    information += COURSE_RIDGE * max(float(usual), TINY) * np.eye(lags.size, dtype=np.float32)
    pull = moved @ (image * root).ravel()
    return np.linalg.solve(information.astype(np.float64), pull.astype(np.float64))


def make_pulse(sigma: float, half: int, variance: float = SPLINE_LEFT_VARIANCE) -> Image:
    """Return the samples, so many to either side, of a Gaussian pulse that are left to smooth with,
    less the variance, rows^2, that is there already; `sigma` is in rows.
    """
    rest = max(sigma**2 - variance, MIN_VARIANCE)
    taps = np.arange(-half, half + 1)
    pulse = np.exp(-(taps**2) / (2 * rest))
    pulse[np.abs(taps) > EXTENT_SIGMAS * np.sqrt(rest) + 1] = 0  # which smoothing skips
    return np.asarray((pulse / pulse.sum()).astype(np.float32))


def differentiate_pulse(kernel: Image) -> Image:
    """Derivative of a smoothed image by the light's row, as a kernel of the same length."""
    steepness = -2j * np.pi * np.fft.rfftfreq(kernel.size)  # light that is later moves on
    slope = np.fft.irfft(steepness * np.fft.rfft(kernel), kernel.size)
    return slope.astype(np.float32)
