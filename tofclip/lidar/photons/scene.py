"""What a picture's photons are made of: the response to a return, and the background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofclip.lidar.photons.photon_image import PhotonImage
from tofclip.lidar.photons.response import BinnedResponse

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
