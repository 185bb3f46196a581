"""A shot of a sensor whose pixels look at the scene themselves: photons counted in time for each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.errors import InputError, ShapeError
from tofclip.lidar.photons.image import PhotonImage
from tofclip.lidar.pulse import Pulse
from tofclip.units import require_credible_bin_width


@dataclass(frozen=True)
class PhotonCube:
    """Histograms of a picture, as an instrument counted them.

    Parameters
    ----------
    counts : (bins, rows, columns) array
        Photons, not negative; of any number type.
    times : (bins,) float64 array
        Middle of each bin, s after the laser's pulse; evenly spaced.
    camera : Camera, optional
        Where the pixels look; `Camera.pinhole` where only that is known.
    pulse : Pulse, optional
        How a return at one instant shows in successive bins, where the instrument knows.
    sampled : bool
        Whether a bin shows one instant, as a picture behind a gate does, not all up to the next bin.
    source : str
        Where it came from, for messages.
    provenance : mapping
        How it came about.

    Raises
    ------
    ShapeError, InputError
        Not a cube, a time axis of another length, or one that is not even or not credible.
    """

    counts: NDArray[Any]
    times: NDArray[np.float64]
    camera: Camera | None = None
    pulse: Pulse | None = None
    sampled: bool = False
    source: str = "histograms"
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.counts.ndim != 3 or self.counts.size == 0:
            raise ShapeError(f"{self.source}: counts", "(bins, rows, columns)", self.counts.shape)
        if self.times.shape != self.counts.shape[:1] or self.times.size < 2:
            raise ShapeError(f"{self.source}: times", self.counts.shape[:1], self.times.shape)
        steps = np.diff(self.times)
        if not (steps.min() > 0 and np.ptp(steps) < 1e-3 * self.bin_width):
            raise InputError(f"{self.source}: the bins of histograms are to be equally long")
        require_credible_bin_width(self.bin_width)

    @property
    def bin_width(self) -> float:
        """Duration of a bin, s."""
        return float(self.times[-1] - self.times[0]) / (self.times.size - 1)

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns."""
        _, rows, columns = self.counts.shape
        return rows, columns

    @property
    def histograms(self) -> NDArray[np.float32]:
        """Photons (pixels, bins), pixels in raster order."""
        flat = self.counts.reshape(self.times.size, -1).T
        return np.ascontiguousarray(flat, dtype=np.float32)

    def to_image(self) -> PhotonImage:
        """Return the photons as events, sorted by pixel."""
        image = PhotonImage.from_cube(np.moveaxis(self.counts, 0, -1), self.bin_width)
        return replace(image, sampled=self.sampled)
