"""Which candidates count as returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError

BRIGHT_QUANTILE = 0.999  # the scene's brightness is that of its brightest pixels, but not of a single glint


@dataclass(frozen=True)
class Detection:
    """What counts as a return.

    Parameters
    ----------
    signal_to_noise : float
        Least response of the matched filter, in standard deviations of the pixel's background.
    share_of_scene : float
        Least intensity relative to the brightest returns of the scene: leaves out the faint streaks that recovery
        from few views leaves around bright objects.
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
    share_of_pixel: float = 0.2
    most_returns: int = 4

    def __post_init__(self) -> None:
        if not self.signal_to_noise >= 0:
            raise InputError(f"the signal-to-noise limit must not be negative, got {self.signal_to_noise}")
        for share in (self.share_of_scene, self.share_of_pixel):
            if not 0 <= share <= 1:
                raise InputError(f"a share must lie between 0 and 1, got {share}")
        if not 1 <= self.most_returns <= 255:
            raise InputError(f"a pixel can have 1 to 255 returns, got {self.most_returns}")

    def significant(self, pixel: NDArray[np.int64], intensity: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Say which candidates are strong enough.

        Parameters
        ----------
        pixel : (n,) int array
            Pixel number of each candidate.
        intensity : (n,) array
            Brightness with the fall-off with range undone.
        """
        if pixel.size == 0:
            return np.zeros(0, dtype=bool)
        strongest = np.zeros(int(pixel.max()) + 1)
        np.maximum.at(strongest, pixel, intensity)
        scene = np.quantile(strongest[strongest > 0], BRIGHT_QUANTILE)
        strong: NDArray[np.bool_] = intensity >= np.maximum(
            self.share_of_scene * scene, self.share_of_pixel * strongest[pixel]
        )
        return strong
