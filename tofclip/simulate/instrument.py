"""The simulated instrument: lenslets with a baseline, a sweep, and a detector that counts photons."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.errors import InputError


@dataclass(frozen=True)
class StreakDetector:
    """The streak tube's screen, read out in photons.

    Parameters
    ----------
    rows : int
        Rows of the streak image.
    bin_width : float
        Duration of a row, s.
    peak_photons : float
        Expected signal of the brightest streak pixel; sets the exposure.
    background_photons : float
        Expected background of every streak pixel.
    full_scale_photons : float
        Reading at which a pixel saturates.
    """

    rows: int = 576
    bin_width: float = 20e-12
    peak_photons: float = 2000.0
    background_photons: float = 2.0
    full_scale_photons: float = 65535.0

    def __post_init__(self) -> None:
        if not (self.rows >= 1 and self.bin_width > 0):
            raise InputError(
                f"a detector needs rows and a positive bin width, got {self.rows} and {self.bin_width}"
            )
        if not (
            self.peak_photons > 0 and self.background_photons >= 0 and self.full_scale_photons > 0
        ):
            raise InputError(
                "peak and full scale must be positive numbers of photons, the background not negative"
            )

    @property
    def row_times(self) -> NDArray[np.float64]:
        """Instant of each row's middle on the streak's own time axis, s; the first is 0."""
        times: NDArray[np.float64] = np.arange(self.rows) * np.float64(self.bin_width)
        return times

    def expose(
        self, signal: NDArray[np.float64], noise: np.random.Generator
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Draw one shot: measurements in photons, and which of them saturated.

        Parameters
        ----------
        signal : (rows, columns) array
            Expected signal, photons.
        noise : numpy.random.Generator

        Returns
        -------
        counts : float32 array
            Photons, none above full scale.
        saturated : bool array
        """
        # Background is light as well, so that it brings photon noise of its own.
        photons = noise.poisson(signal + self.background_photons)
        saturated = photons >= self.full_scale_photons
        return np.minimum(photons, self.full_scale_photons).astype(np.float32), saturated


@dataclass(frozen=True)
class Instrument:
    """A camera with what only a simulation has to know of it.

    Parameters
    ----------
    camera : Camera
        Geometry, gains, sweep, pulse, time zero, lenslet pitch and focus distance. View k stands at
        ``x = lenslet_pitch * view_positions[k]``.
    detector : StreakDetector
    rays_per_pixel_side : int
        A picture pixel is sampled by the square of this number of rays.
    """

    camera: Camera
    detector: StreakDetector = field(default_factory=StreakDetector)
    rays_per_pixel_side: int = 4

    def __post_init__(self) -> None:
        if not self.rays_per_pixel_side >= 1:
            raise InputError(f"the number of rays must be positive, got {self.rays_per_pixel_side}")

    def viewpoint(self, position: float) -> NDArray[np.float64]:
        """Where the view at `position` view steps stands, m."""
        return np.array([self.camera.lenslet_pitch * position, 0.0, 0.0])

    def pixel_grid(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rays of a picture: X and Y from the optical axis in pixels, flat, sub-pixel by sub-pixel
        in raster order.
        """
        (rows, columns), (axis_row, axis_column) = (
            self.camera.image_shape,
            self.camera.optical_axis_px,
        )
        y, x = np.meshgrid(
            self._samples(rows) - axis_row, self._samples(columns) - axis_column, indexing="ij"
        )
        return x.ravel(), y.ravel()

    def _samples(self, pixels: int) -> NDArray[np.float64]:
        side = self.rays_per_pixel_side
        # Middles of the sub-pixels; pixel centres are whole numbers, hence the half taken off.
        samples: NDArray[np.float64] = (np.arange(pixels * side) + 0.5) / side - 0.5
        return samples

    def directions(
        self, x: NDArray[np.float64], y: NDArray[np.float64], position: float = 0.0
    ) -> NDArray[np.float64]:
        """Directions (n, 3), with z = 1, in which the view at `position` sees its picture points
        (x, y).

        A view's picture is laid so that a point at the focus distance appears at the same place in
        all views.

        Parameters
        ----------
        x, y : (n,) float64 array
            Picture points in pixels from the centre.
        position : float
            Of the view, in view steps.

        Returns
        -------
        (n, 3) float64 array
        """
        focal = self.camera.focal_length_px
        # Turned towards the point on the axis at the focus distance, where all views coincide.
        aside = self.camera.lenslet_pitch * position / self.camera.focus_distance
        return np.stack([x / focal - aside, y / focal, np.ones_like(x)], axis=-1)
