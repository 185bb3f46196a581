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
        if pixel.size == 0:
            return np.zeros(0, dtype=bool)
        strongest = np.zeros(int(pixel.max()) + 1)
        np.maximum.at(strongest, pixel, intensity)
        scene = np.quantile(strongest[strongest > 0], SCENE_BRIGHTNESS_QUANTILE)
        needed = np.maximum(
            self.min_scene_fraction * scene, self.min_pixel_fraction * strongest[pixel]
        )
        np.maximum(
            needed,
            self.min_time_bin_fraction * _find_local_maximum(time, intensity, pulse_width),
            out=needed,
        )
        strong: NDArray[np.bool_] = intensity >= needed
        return strong


def _find_local_maximum(time: FloatArray, intensity: FloatArray, width: float) -> FloatArray:
    """Largest intensity among the candidates within `width` of each instant, to a quarter of a
    width.
    """
    slot = np.round((time - time.min()) / (width / SLOTS_PER_WIDTH)).astype(np.intp)
    brightest = np.zeros(int(slot.max()) + 1)
    np.maximum.at(brightest, slot, intensity)
    around: FloatArray = scipy.ndimage.maximum_filter1d(brightest, 2 * SLOTS_PER_WIDTH + 1)[slot]
    return around
