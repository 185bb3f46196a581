"""Which candidates count as returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from tofclip.errors import InputError

FloatArray = NDArray[np.float64]

SLOTS_PER_WIDTH = 4
BRIGHT_QUANTILE = 0.999  # the scene's brightness is that of its brightest pixels, but not of a single glint


@dataclass(frozen=True)
class Detection:
    """What counts as a return.

    Parameters
    ----------
    signal_to_noise : float
        Least response of the matched filter, in standard deviations of the pixel's background.
    share_of_scene : float
        Least intensity relative to the brightest returns of the scene.
    share_of_instant : float
        Least intensity relative to the brightest return of any pixel at the same instant, within a pulse width:
        leaves out the streaks that recovery from few views draws across a frame around its bright objects.
    share_of_pixel : float
        Least intensity relative to the pixel's strongest return: leaves out echoes inside the instrument.
    most_returns : int
        At most so many returns in a pixel, the strongest.

    Raises
    ------
    InputError
        A share outside 0..1, a negative signal-to-noise, or no return allowed.
    """

    signal_to_noise: float = 5.0
    share_of_scene: float = 0.05
    share_of_instant: float = 0.12
    share_of_pixel: float = 0.2
    most_returns: int = 4

    def __post_init__(self) -> None:
        if not self.signal_to_noise >= 0:
            raise InputError(f"the signal-to-noise limit must not be negative, got {self.signal_to_noise}")
        for share in (self.share_of_scene, self.share_of_instant, self.share_of_pixel):
            if not 0 <= share <= 1:
                raise InputError(f"a share must lie between 0 and 1, got {share}")
        if not 1 <= self.most_returns <= 255:
            raise InputError(f"a pixel can have 1 to 255 returns, got {self.most_returns}")

    def significant(
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
        """
        if pixel.size == 0:
            return np.zeros(0, dtype=bool)
        strongest = np.zeros(int(pixel.max()) + 1)
        np.maximum.at(strongest, pixel, intensity)
        scene = np.quantile(strongest[strongest > 0], BRIGHT_QUANTILE)
        needed = np.maximum(self.share_of_scene * scene, self.share_of_pixel * strongest[pixel])
        np.maximum(needed, self.share_of_instant * _brightest_around(time, intensity, pulse_width), out=needed)
        strong: NDArray[np.bool_] = intensity >= needed
        return strong


def _brightest_around(time: FloatArray, intensity: FloatArray, width: float) -> FloatArray:
    """Largest intensity among the candidates within `width` of each instant, to a quarter of a width."""
    slot = np.round((time - time.min()) / (width / SLOTS_PER_WIDTH)).astype(np.intp)
    brightest = np.zeros(int(slot.max()) + 1)
    np.maximum.at(brightest, slot, intensity)
    around: FloatArray = maximum_filter1d(brightest, 2 * SLOTS_PER_WIDTH + 1)[slot]
    return around
