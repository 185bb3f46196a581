"""The pulse that a shot itself shows: the usual course of light in the pixels of its surfaces.

A camera's file knows one width of its pulse; an instrument's pulse may be longer and have a tail,
as of a phosphor's afterglow. On surfaces each pixel's light follows the pulse, so that the median
over many pixels, each seen from its own return, is the pulse, whatever lies before or behind.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.shots import Frames
from tofclip.units import SPEED_OF_LIGHT

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]

FWHM_PER_SIGMA = 2 * np.sqrt(2 * np.log(2))
REACH_BEFORE, REACH_AFTER = 4.0, 14.0  # of the camera's pulse widths: what is looked at
BRIGHT_QUANTILE = 0.5  # of the pixels: the brighter half shows the pulse
# Frames of a Gaussian pulse show up to 1.18 of its width, as rows integrate it, and no tail.
GAUSSIAN_WIDTH, GAUSSIAN_TAIL = 1.3, 0.05
TAIL_START = 1.5  # camera's pulse widths after the return
CORES = np.arange(0.7, 2.5, 0.1)  # widths that are tried, of the camera's
CORE_EXCESS = 1.1  # of the least misfit: the widest core that is as good
LAGS_BEFORE = 0.5  # camera's pulse widths: where the core may lie before the peak
ROW_VARIANCE = 1 / 12  # rows^2, by which a row's own duration widens what frames show
LEAST_SHARE = 1e-3  # of the pulse's light: below, a lag is none of the tail's
EXTENT_SIGMAS = 3.5  # 5e-4 of a pulse lie outside
SPLINE_LEFT_VARIANCE = 1 / 6  # rows^2: a B-spline's 1/4 without the 1/12 of the row itself
MIN_VARIANCE = 0.02  # rows^2, of the smoothing that is left of a pulse shorter than a row


@dataclass(frozen=True)
class ShotPulse:
    """A Gaussian core and what follows it."""

    sigma: float  # of the core, rows
    # (n,), rows after the return at which the core appears
    lags: NDArray[np.intp] = field(default_factory=lambda: np.zeros(1, np.intp))
    # (n,), its light there; the sum is 1
    shares: FloatArray = field(default_factory=lambda: np.ones(1))
    # full width at half maximum, as the shot shows it, over the camera's; 1 where nothing was
    # measured
    width_ratio: float = 1.0
    # of its light, what comes more than one and a half of the camera's widths after the peak
    tail_share: float = 0.0

    @property
    def reach(self) -> int:
        """Rows that the shares reach to either side."""
        return int(np.abs(self.lags).max(initial=0))

    def extend(self, core: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a core, sampled symmetrically, with all that follows it, `reach` samples longer at
        either end.
        """
        reach = self.reach
        tail = np.zeros(2 * reach + 1)
        tail[self.lags + reach] = self.shares
        found: NDArray[np.float32] = np.convolve(core, tail).astype(np.float32)
        return found


def measure_pulse(frames: Frames, pixels: NDArray[np.intp], distance: FloatArray) -> ShotPulse:
    """Measure the pulse of a shot in its frames; the camera's where it is as short as that.

    `pixels` (n,): raster numbers of pixels that lie on surfaces; `distance` (n,): range of the
    strongest return of each, m.
    """
    width = frames.camera.pulse_fwhm / frames.bin_width
    usual = ShotPulse(width / FWHM_PER_SIGMA)
    if pixels.size == 0:
        return usual
    lags = np.arange(-int(np.ceil(REACH_BEFORE * width)), int(np.ceil(REACH_AFTER * width)) + 1)
    shape = find_usual_course(frames, pixels, distance, lags, width)
    ratio = measure_width(shape) / width
    tail = float(shape[lags > TAIL_START * width].sum() / shape.sum())
    if ratio < GAUSSIAN_WIDTH and tail < GAUSSIAN_TAIL:
        return usual
    sigma, shares = split_core(shape, lags, width)
    kept = shares > LEAST_SHARE * shares.sum()
    own = lags[kept]
    # where the pulse is at its peak is its return, as for a search of returns
    sigma = float(np.sqrt(max(sigma**2 - ROW_VARIANCE, ROW_VARIANCE)))
    return ShotPulse(sigma, own.astype(np.intp), shares[kept] / shares[kept].sum(), ratio, tail)


def find_usual_course(
    frames: Frames,
    pixels: NDArray[np.intp],
    distance: FloatArray,
    lags: NDArray[np.int64],
    width: float,
) -> FloatArray:
    """Return the median course of light about the returns of bright pixels, its peak 1.

    `pixels` (n,); `distance` (n,): m; `lags` (m,): rows after the return; `width`: of the camera's
    pulse, rows. Returns (m,).
    """
    traces = frames.values.reshape(frames.values.shape[0], -1)
    row = np.interp(2 * distance / SPEED_OF_LIGHT, frames.times, np.arange(frames.times.size))
    place = row[:, np.newaxis] + lags
    before = np.clip(np.floor(place).astype(np.intp), 0, len(traces) - 2)
    between = np.clip(place - before, 0, 1)
    own = pixels[:, np.newaxis]
    light = traces[before, own] * (1 - between) + traces[before + 1, own] * between
    core = light[:, np.abs(lags) <= width].sum(axis=1)
    bright = core >= max(
        float(np.quantile(core, BRIGHT_QUANTILE)), float(np.finfo(np.float32).tiny)
    )
    shape = np.median(light[bright] / core[bright, np.newaxis], axis=0)
    found: FloatArray = shape / max(float(shape.max()), float(np.finfo(np.float64).tiny))
    return found


def measure_width(shape: FloatArray) -> float:
    """Full width at half maximum of a course of light, samples, with linear interpolation."""
    above = np.flatnonzero(shape >= 0.5 * shape.max())
    first, last = float(above[0]), float(above[-1])
    half = 0.5 * shape.max()
    if above[0] > 0:
        low, high = shape[above[0] - 1 : above[0] + 1]
        first -= (high - half) / (high - low)
    if above[-1] < shape.size - 1:
        high, low = shape[above[-1] : above[-1] + 2]
        last += (high - half) / (high - low)
    return last - first


def split_core(
    shape: FloatArray, lags: NDArray[np.int64], width: float
) -> tuple[float, FloatArray]:
    """Explain a pulse as a Gaussian core at some lags, by non-negative least squares.

    `shape` (m,); `lags` (m,): rows after the return; `width`: of the camera's pulse, rows. Returns
    `sigma`: of the core, rows: the widest that explains the pulse as well as any; `shares` (m,): of
    the core at each lag.
    """
    allowed = np.flatnonzero(lags >= -LAGS_BEFORE * width)
    found = []
    for core in CORES * width / FWHM_PER_SIGMA:
        design = np.exp(-(((lags[:, np.newaxis] - lags[allowed]) / core) ** 2) / 2)
        shares, misfit = scipy.optimize.nnls(design, shape)
        found.append((core, shares, misfit))
    least = min(misfit for _, _, misfit in found)
    # One that explains nothing better than the samples' own roundness is too narrow to be smooth.
    sigma, shares, _ = next(one for one in reversed(found) if one[2] <= CORE_EXCESS * least + 1e-9)
    whole = np.zeros(lags.size)
    whole[allowed] = shares
    return float(sigma), whole


def make_pulse(sigma: float, half: int, variance: float = SPLINE_LEFT_VARIANCE) -> Image:
    """Return the samples of a Gaussian pulse that are left to smooth with.

    `sigma`: standard deviation of the pulse, rows; `half`: samples to either side; `variance`:
    already there, rows^2.
    """
    rest = max(sigma**2 - variance, MIN_VARIANCE)
    taps = np.arange(-half, half + 1)
    pulse = np.exp(-(taps**2) / (2 * rest))
    pulse[np.abs(taps) > EXTENT_SIGMAS * np.sqrt(rest) + 1] = 0  # which smoothing skips
    found: Image = (pulse / pulse.sum()).astype(np.float32)
    return found


def differentiate_pulse(kernel: Image) -> Image:
    """Derivative of a smoothed image by the light's row, as a kernel of the same length."""
    steepness = -2j * np.pi * np.fft.rfftfreq(kernel.size)  # light that is later moves on
    slope = np.fft.irfft(steepness * np.fft.rfft(kernel), kernel.size)
    return slope.astype(np.float32)
