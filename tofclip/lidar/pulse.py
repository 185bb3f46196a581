"""The shape of a single return: the instrument's response to a short pulse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tofclip.arrays import FloatArray
from tofclip.errors import InputError, require_positive
from tofclip.units import FWHM_PER_SIGMA

SAMPLES_PER_FWHM = 128  # linear interpolation then errs by less than 2e-5 of the peak
EXTENT_FWHM = 2.0  # a Gaussian is 1.5e-5 of its peak there
EXTENT_DECAYS = 11.0  # an exponential is 1.7e-5 of its start there
SAMPLES_PER_BIN = 64  # of a pulse that was summed over bins
MAX_SAMPLES = 1 << 23
"""Of a pulse: 10,000 times as long as a bin and as long as its tail may be."""
SUPPORT_THRESHOLD = 0.01  # below this fraction of its peak a pulse says nothing about where it is

Table = tuple[FloatArray, tuple[float, float, float, float]]


@dataclass(frozen=True)
class Pulse:
    """A pulse shape as a finely sampled curve; between samples it is linear, beyond them zero.

    Parameters
    ----------
    samples : (n,) array
        Brightness, evenly sampled; scaled to a peak of one.
    spacing : float
        Time between samples, s.
    origin : float
        Position, in samples, of the instant that counts as the arrival.

    Raises
    ------
    InputError
        Fewer than three samples, nothing positive, a spacing that is not positive, or an origin
        outside.
    """

    samples: FloatArray
    spacing: float
    origin: float

    def __post_init__(self) -> None:
        samples = np.array(self.samples, dtype=np.float64)
        usable = samples.ndim == 1 and samples.size >= 3 and np.all(np.isfinite(samples))
        if not (usable and samples.max() > 0):
            raise InputError("a pulse needs at least three finite samples, one of them positive")
        require_positive("the spacing of a pulse's samples", self.spacing, "time")
        if not 0 <= self.origin <= samples.size - 1:
            raise InputError(
                f"the origin of a pulse must lie within its samples, got {self.origin}"
            )
        samples /= samples.max()
        samples.flags.writeable = False
        object.__setattr__(self, "samples", samples)

    @classmethod
    def gaussian(cls, fwhm: float) -> Pulse:
        """Return a Gaussian of full width at half maximum `fwhm`, s, whose arrival is its peak."""
        require_positive("the width of a pulse", fwhm, "time")
        half = int(EXTENT_FWHM * SAMPLES_PER_FWHM)
        widths = np.arange(-half, half + 1) / SAMPLES_PER_FWHM
        return cls(np.exp2(-((2 * widths) ** 2)), fwhm / SAMPLES_PER_FWHM, float(half))

    @classmethod
    def exponentially_modified(cls, fwhm: float, decay: float) -> Pulse:
        """Return a Gaussian convolved with an exponential decay, as photon-counting diodes answer a
        short pulse: of full width at half maximum `fwhm`, s, its middle, before the decay, being the
        arrival, and a time constant `decay`, s. `InputError` where these are no positive times, or
        the decay is thousands of widths.
        """
        from scipy.stats import exponnorm

        require_positive("the width of a pulse", fwhm, "time")
        require_positive("the decay of a pulse", decay, "time")
        if not EXTENT_DECAYS * decay * SAMPLES_PER_FWHM <= MAX_SAMPLES * fwhm:
            raise InputError(
                f"a decay of {decay:g} s does not go with a width of {fwhm:g} s; check their units"
            )
        before = int(EXTENT_FWHM * SAMPLES_PER_FWHM)
        after = before + int(EXTENT_DECAYS * decay / fwhm * SAMPLES_PER_FWHM)
        spacing, sigma = fwhm / SAMPLES_PER_FWHM, fwhm / FWHM_PER_SIGMA
        time = np.arange(-before, after + 1) * spacing
        return cls(exponnorm.pdf(time, decay / sigma, scale=sigma), spacing, float(before))

    def integrate_bins(self, bin_width: float) -> Pulse:
        """Return the shape that bins of `bin_width`, s, show: its light summed from half a bin
        before to half after. Sampled at the middles of bins it is, up to one factor, each bin's
        fraction of the light. `InputError` where the width is not positive, or so far from the
        pulse's that one of the units is wrong.
        """
        require_positive("the width of a bin", bin_width, "time")
        spacing = min(self.spacing, bin_width / SAMPLES_PER_BIN)
        length = (self.samples.size - 1) * self.spacing + bin_width
        if not length <= MAX_SAMPLES * spacing:
            raise InputError(
                f"a bin of {bin_width:g} s does not go with a pulse of {self.fwhm:g} s; check their units"
            )
        before, after = (
            int(np.ceil((samples * self.spacing + bin_width / 2) / spacing))
            for samples in (self.origin, self.samples.size - 1 - self.origin)
        )
        time = np.arange(-before, after + 1) * spacing
        # Integral up to each sample, by trapezoids; the light of a bin is the difference at its
        # edges.
        arrived = np.concatenate([[0.0], np.cumsum((self.samples[1:] + self.samples[:-1]) / 2)])
        edges = time[:, np.newaxis] + np.array([-0.5, 0.5]) * bin_width
        position = edges / self.spacing + self.origin
        start, end = np.interp(position, np.arange(self.samples.size), arrived).T
        return Pulse(end - start, spacing, float(before))

    def compress(self, factor: float) -> Pulse:
        """Return the same shape, `factor` times shorter."""
        return Pulse(self.samples, self.spacing / factor, self.origin)

    def __call__(self, time: ArrayLike) -> FloatArray:
        """Brightness at `time`, s, after the arrival; the peak is 1."""
        return self._interpolate(time, self.samples)

    def slope_at(self, time: ArrayLike) -> FloatArray:
        """Change of brightness per second at `time`, s, after the arrival."""
        return self._interpolate(time, self.slope)

    def _interpolate(self, time: ArrayLike, values: FloatArray) -> FloatArray:
        position = np.asarray(time, dtype=np.float64) / self.spacing + self.origin
        return np.interp(position, np.arange(values.size), values, left=0.0, right=0.0)

    @property
    def area(self) -> float:
        """Brightness summed over time, s."""
        return float(np.sum(self.samples[1:] + self.samples[:-1]) / 2 * self.spacing)

    @property
    def slope(self) -> FloatArray:
        """Change of brightness per second at each sample."""
        return np.gradient(self.samples, self.spacing)

    @property
    def fwhm(self) -> float:
        """Full width at half maximum, s."""
        first, last = self.extent(0.5)
        return last - first

    @property
    def support(self) -> tuple[float, float]:
        """First and last instant, s after the arrival, at which the pulse matters."""
        return self.extent(SUPPORT_THRESHOLD)

    def kernel_table(self, level: float = SUPPORT_THRESHOLD) -> Table:
        """Return what the compiled loops take: (n, 2) samples and their slopes, per second; and samples
        per second, origin, and the `extent` of `level`.
        """
        curve = np.stack([self.samples, self.slope], axis=1)
        return curve, (1 / self.spacing, self.origin, *self.extent(level))

    def extent(self, level: float) -> tuple[float, float]:
        """Return when the curve first rises through `level` of its peak and last falls through it,
        s after arrival.
        """
        above = np.flatnonzero(self.samples >= level)
        first, last = float(above[0]), float(above[-1])
        if above[0] > 0:
            low, high = self.samples[above[0] - 1 : above[0] + 1]
            first -= (high - level) / (high - low)
        if above[-1] < self.samples.size - 1:
            high, low = self.samples[above[-1] : above[-1] + 2]
            last += (high - level) / (high - low)
        return (first - self.origin) * self.spacing, (last - self.origin) * self.spacing
