"""The shape of a single return: the instrument's response to a short pulse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofclip.errors import InputError

SAMPLES_PER_WIDTH = 128  # linear interpolation then errs by less than 2e-5 of the peak
REACH_IN_WIDTHS = 2.0  # a Gaussian is 1.5e-5 of its peak there
SIGNIFICANT = 0.01  # below this share of its peak a pulse says nothing about where it is


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
        Fewer than three samples, nothing positive, a spacing that is not positive, or an origin outside.
    """

    samples: NDArray[np.float64]
    spacing: float
    origin: float

    def __post_init__(self) -> None:
        samples = np.array(self.samples, dtype=np.float64)
        if samples.ndim != 1 or samples.size < 3 or not np.all(np.isfinite(samples)) or samples.max() <= 0:
            raise InputError("a pulse needs at least three finite samples, one of them positive")
        if not (np.isfinite(self.spacing) and self.spacing > 0):
            raise InputError(f"the spacing of a pulse's samples must be a positive time, got {self.spacing}")
        if not 0 <= self.origin <= samples.size - 1:
            raise InputError(f"the origin of a pulse must lie within its samples, got {self.origin}")
        samples /= samples.max()
        samples.flags.writeable = False
        object.__setattr__(self, "samples", samples)

    @classmethod
    def gaussian(cls, fwhm: float) -> Pulse:
        """Return a Gaussian of full width at half maximum `fwhm`, s, whose arrival is its peak."""
        if not (np.isfinite(fwhm) and fwhm > 0):
            raise InputError(f"the width of a pulse must be a positive time, got {fwhm}")
        half = int(REACH_IN_WIDTHS * SAMPLES_PER_WIDTH)
        widths = np.arange(-half, half + 1) / SAMPLES_PER_WIDTH
        return cls(np.exp2(-((2 * widths) ** 2)), fwhm / SAMPLES_PER_WIDTH, float(half))

    def compressed(self, factor: float) -> Pulse:
        """Return the same shape, `factor` times shorter."""
        return Pulse(self.samples, self.spacing / factor, self.origin)

    def __call__(self, time: ArrayLike) -> NDArray[np.float64]:
        """Brightness at `time`, s, after the arrival; the peak is 1."""
        position = np.asarray(time, dtype=np.float64) / self.spacing + self.origin
        return np.interp(position, np.arange(self.samples.size), self.samples, left=0.0, right=0.0)

    @property
    def slope(self) -> NDArray[np.float64]:
        """Change of brightness per second at each sample."""
        return np.gradient(self.samples, self.spacing)

    @property
    def fwhm(self) -> float:
        """Full width at half maximum, s."""
        first, last = self._extent(0.5)
        return last - first

    @property
    def support(self) -> tuple[float, float]:
        """First and last instant, s after the arrival, at which the pulse matters."""
        return self._extent(SIGNIFICANT)

    def _extent(self, level: float) -> tuple[float, float]:
        """Where the curve first rises through `level` and last falls through it."""
        above = np.flatnonzero(self.samples >= level)
        first, last = float(above[0]), float(above[-1])
        if above[0] > 0:
            low, high = self.samples[above[0] - 1 : above[0] + 1]
            first -= (high - level) / (high - low)
        if above[-1] < self.samples.size - 1:
            high, low = self.samples[above[-1] : above[-1] + 2]
            last += (high - level) / (high - low)
        return (first - self.origin) * self.spacing, (last - self.origin) * self.spacing
