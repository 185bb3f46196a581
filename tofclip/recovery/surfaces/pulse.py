"""The pulse that a shot itself shows: the usual course of light in the pixels of its surfaces.

A camera's file knows one width of its pulse; an instrument's pulse may be longer and have a tail,
as of a phosphor's afterglow. On surfaces each pixel's light follows the pulse, so that the median
over many pixels, each seen from its own return, is the pulse, whatever lies before or behind.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.lidar.pulse import Pulse
from tofclip.shots import Frames
from tofclip.units import SPEED_OF_LIGHT

Image = NDArray[np.float32]

FWHM_PER_SIGMA = 2 * np.sqrt(2 * np.log(2))
REACH_BEFORE, REACH_AFTER = 4.0, 14.0  # of the camera's pulse widths: what is looked at
BRIGHT_QUANTILE = 0.5  # of the pixels: the brighter half shows the pulse
# Frames of a Gaussian pulse show up to 1.18 of its width, as rows integrate it, and no tail.
SHORTER, GAUSSIAN_WIDTH, GAUSSIAN_TAIL = 0.5, 1.3, 0.05
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
    ratio = Pulse(shape, 1.0, 0.0).fwhm / width
    if ratio < SHORTER:  # than the camera says, as where nobody told it
        shorter = frames.camera.replace(pulse_fwhm=ratio * frames.camera.pulse_fwhm)
        return measure_pulse(replace(frames, camera=shorter), pixels, distance)
    tail = float(shape[lags > TAIL_START * width].sum() / shape.sum())
    if ratio < GAUSSIAN_WIDTH and tail < GAUSSIAN_TAIL:
        return usual
    # A Gaussian core at some lags, by non-negative least squares: the widest that explains the pulse
    # as well as any. One that explains nothing better than the samples' own roundness is too narrow.
    allowed = lags[lags >= -LAGS_BEFORE * width]
    cores = CORES * width / FWHM_PER_SIGMA
    designs = (np.exp(-(((lags[:, np.newaxis] - allowed) / core) ** 2) / 2) for core in cores)
    fits = [scipy.optimize.nnls(design, shape) for design in designs]
    enough = CORE_EXCESS * min(misfit for _, misfit in fits) + 1e-9
    best = max(number for number, (_, misfit) in enumerate(fits) if misfit <= enough)
    shares = fits[best][0]
    kept = shares > LEAST_SHARE * shares.sum()
    # where the pulse is at its peak is its return, as for a search of returns
    sigma = float(np.sqrt(max(cores[best] ** 2 - ROW_VARIANCE, ROW_VARIANCE)))
    own = allowed[kept].astype(np.intp)
    return ShotPulse(sigma, own, shares[kept] / shares[kept].sum(), tail)


def find_usual_course(
    frames: Frames,
    pixels: NDArray[np.intp],
    distance: FloatArray,
    lags: NDArray[np.int64],
    width: float,
) -> FloatArray:
    """Return the median course of light about the returns of bright pixels, its peak 1, at lags, rows
    after the return; `width`: of the camera's pulse, rows.
    """
    traces = frames.values.reshape(frames.values.shape[0], -1)
    row = np.interp(2 * distance / SPEED_OF_LIGHT, frames.times, np.arange(frames.times.size))
    place = row[:, np.newaxis] + lags
    before = np.clip(np.floor(place).astype(np.intp), 0, len(traces) - 2)
    between = np.clip(place - before, 0, 1)
    own = pixels[:, np.newaxis]
    light = traces[before, own] * (1 - between) + traces[before + 1, own] * between
    core = light[:, np.abs(lags) <= width].sum(axis=1)
    usual = float(np.quantile(core, BRIGHT_QUANTILE))
    bright = core >= max(usual, float(np.finfo(np.float32).tiny))
    shape = np.median(light[bright] / core[bright, np.newaxis], axis=0)
    return np.asarray(shape / max(float(shape.max()), float(np.finfo(np.float64).tiny)))


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
