"""Which candidates count as returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.errors import InputError

FloatArray = NDArray[np.float64]

SLOTS_PER_WIDTH = 4

# Of the share of the strongest return that a candidate needs before the fit, which does not make up
# for more than the rest.
PREFIT_THRESHOLD_FACTOR = 0.7

# Gauss-Newton from near the top has converged after two rounds; more are for returns that overlap.
MAX_FIT_ROUNDS = 8

# A return that moved by less is done: its next step would be smaller by far.
CONVERGENCE_STEP_BINS = 5e-3

SCENE_BRIGHTNESS_QUANTILE = (
    0.999  # the scene's brightness is that of its brightest pixels, but not of a single glint
)


@dataclass(frozen=True)
class Detection:
    """What counts as a return.

    Parameters
    ----------
    signal_to_noise : float
        Least response of the matched filter, in standard deviations of the pixel's background.
    min_scene_fraction : float
        Least intensity relative to the brightest returns of the scene.
    min_time_bin_fraction : float
        Least intensity relative to the brightest return of any pixel at the same instant, within a
        pulse width: leaves out the streaks that recovery from few views draws across a frame around
        its bright objects.
    min_pixel_fraction : float
        Least intensity relative to the pixel's strongest return: leaves out echoes inside the
        instrument.
    max_returns : int
        Maximum number of returns in a pixel, the strongest.

    Raises
    ------
    InputError
        A share outside 0..1, a negative signal-to-noise, or no return allowed.
    """

    signal_to_noise: float = 5.0
    min_scene_fraction: float = 0.05
    min_time_bin_fraction: float = 0.12
    min_pixel_fraction: float = 0.2
    max_returns: int = 4

    def __post_init__(self) -> None:
        if not self.signal_to_noise >= 0:
            raise InputError(
                f"the signal-to-noise limit must not be negative, got {self.signal_to_noise}"
            )
        for share in (self.min_scene_fraction, self.min_time_bin_fraction, self.min_pixel_fraction):
            if not 0 <= share <= 1:
                raise InputError(f"a share must lie between 0 and 1, got {share}")
        if not 1 <= self.max_returns <= 255:
            raise InputError(f"a pixel can have 1 to 255 returns, got {self.max_returns}")

    def find_significant(
        self, pixel: NDArray[np.int64], time: FloatArray, intensity: FloatArray, pulse_width: float
    ) -> NDArray[np.bool_]:
        """Say which candidates are strong enough.

        Parameters
        ----------
        pixel : (n,) int array
            Pixel number of each candidate.
        time : (n,) array
            Its instant, s.
        intensity : (n,) array
            Its brightness with the fall-off with range undone.
        pulse_width : float
            Instants that differ by less than this, s, are the same.

        Returns
        -------
        (n,) bool array
        """
        strong = np.zeros(pixel.size, dtype=bool)
        if pixel.size == 0:
            return strong
        # the compiler takes as long to import as all else
        from tofclip.lidar.candidate_loops import mark_strong

        strongest, needed, axis = self._find_brightest(pixel, time, intensity, pulse_width, time)
        of_pixel = self.min_pixel_fraction * strongest
        mark_strong(pixel, time, intensity, axis, of_pixel, needed, strong)
        return strong

    def compute_least_intensity(
        self,
        pixel: NDArray[np.int64],
        time: FloatArray,
        intensity: FloatArray,
        pulse_width: float,
        at: FloatArray,
    ) -> FloatArray:
        """Return what the scene and its other returns at the same instant ask of a return.

        Parameters
        ----------
        pixel, time, intensity, pulse_width
            As for `find_significant`; at least one candidate.
        at : (m,) array
            Instants, s.

        Returns
        -------
        (m,) float64 array
            Brightness with the fall-off with range undone.
        """
        _, needed, (start, per_second) = self._find_brightest(
            pixel, time, intensity, pulse_width, at
        )
        wanted = ((at - start) * per_second + 0.5).astype(np.int64)
        least: FloatArray = needed.take(wanted)
        return least

    def _find_brightest(
        self,
        pixel: NDArray[np.int64],
        time: FloatArray,
        intensity: FloatArray,
        width: float,
        at: FloatArray,
    ) -> tuple[FloatArray, FloatArray, tuple[float, float]]:
        """What a return is compared with.

        `pixel, time, intensity`: as for `find_significant`; at least one candidate; `width`: of a
        pulse, s; `at` (m,): instants of interest, s. Returns `strongest` (pixels,): largest
        intensity of each pixel, 0 where there is no candidate; `needed` (slots,): what the scene
        and its brightest return within a pulse's width ask of each instant; `axis`: first slot's
        instant, s, and how many slots there are in a second.
        """
        # the compiler takes as long to import as all else
        from tofclip.lidar.candidate_loops import raise_maxima

        start, end = min(time.min(), at.min()), max(time.max(), at.max())
        axis = float(start), SLOTS_PER_WIDTH / width
        strongest = np.zeros(int(pixel.max()) + 1)
        brightest = np.zeros(int((end - start) * axis[1] + 0.5) + 1)
        raise_maxima(pixel, time, intensity, axis, strongest, brightest)
        around = scipy.ndimage.maximum_filter1d(brightest, 2 * SLOTS_PER_WIDTH + 1)
        scene = find_quantile_value(strongest[strongest > 0], SCENE_BRIGHTNESS_QUANTILE)
        least = self.min_scene_fraction * scene
        return strongest, np.maximum(least, self.min_time_bin_fraction * around), axis


def find_quantile_value(values: NDArray[np.floating], fraction: float) -> float:
    """Return a quantile as `numpy.quantile` does, which looks for two numbers at once, by a way that
    takes ten times as long.

    `values` (n,): at least one.
    """
    place = fraction * (values.size - 1)
    before = int(place)
    ordered = np.partition(values, before)
    value = float(ordered[before])
    above = float(ordered[before + 1 :].min(initial=np.inf))
    return value + (place - before) * (above - value) if place > before else value
